"""Where a robot is: how far its tip has to go, and its tip and deepest contact in the coordinates of the scan."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.anatomy.branch import transform_points
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import option
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.orientation import OPPOSITE_DIRECTIONS, axis_directions, has_patient_directions

DIRECTION_WORDS = {
    "R": "right",
    "L": "left",
    "A": "anterior",
    "P": "posterior",
    "S": "superior",
    "I": "inferior",
}


class WayToGo(NamedTuple):
    """How far the tip is from the target's last end in each frame: distance (T,), mm, and angle_deg (T,)."""

    distance: Array
    angle_deg: Array


def way_to_go(plan: Plan) -> WayToGo:
    """Return how far the tip is from the end of a plan's last target in each frame; NaN where it has no shape."""
    end = plan.target_direction[-1]
    cross = np.linalg.norm(np.cross(plan.tip_direction, end), axis=-1)
    angle = np.arctan2(cross, plan.tip_direction @ end)
    return WayToGo(np.linalg.norm(plan.shape[:, -1] - plan.target[-1, -1], axis=-1), np.degrees(angle))


def arrival_tolerance(plan: Plan) -> float:
    """Return the distance from the target's end, mm, at which the tip of a plan counts as arrived."""
    return float(option(plan, "arrival_tolerance"))


def coordinates(plan: Plan) -> dict[str, Any]:
    """Return the names of the axes of a plan's coordinates, and points in them for the page.

    ``name`` says which coordinates they are; ``axes`` has for each axis its letters at both ends and its direction
    in the robot's frame; ``tip`` has the tip in each frame, and ``nearest`` the body's point that is nearest to
    the wall or deepest in it, mm, None where it is not known; ``depth`` its contact, mm, negative for clearance.
    """
    space = plan.meta["problem"].get("space") or ""
    patient = has_patient_directions(space)
    letters = [(letter, OPPOSITE_DIRECTIONS[letter]) for letter in space] if patient else [(x, "") for x in "xyz"]
    # Without a file the plan's own frame is the only one there is.
    to_robot = plan.to_robot if space else np.eye(4)
    assumed = ", assumed" if plan.meta["problem"].get("space_assumed") else ""
    name = f"{space}{assumed}" if patient else "the file's axes" if space else "the robot's base frame"
    depth, nearest = _nearest_to_wall(plan)
    return {
        "name": name,
        "axes": [
            {"letters": ends, "word": DIRECTION_WORDS.get(ends[0], ends[0]), "direction": along}
            for ends, along in zip(letters, np.round(axis_directions(to_robot), 5).tolist(), strict=True)
        ],
        "tip": _written(to_robot, plan.shape[:, -1]),
        "nearest": _written(to_robot, nearest),
        "depth": [round(float(value), 2) if np.isfinite(value) else None for value in depth],
    }


def _nearest_to_wall(plan: Plan) -> tuple[Array, Array]:
    """Return the contact (T,), mm, negative for clearance, and the body's point (T, 3) there; NaN if not known."""
    frames = len(plan.time)
    if plan.clearance is None:
        return np.full(frames, np.nan), np.full((frames, 3), np.nan)
    least = plan.clearance.min(axis=1)
    sample = np.where(np.isfinite(plan.clearance), plan.clearance, np.inf).argmin(axis=1)
    return -least, np.where(np.isfinite(least)[:, None], plan.shape[np.arange(frames), sample], np.nan)


def _written(to_robot: Array, points: Array) -> list[list[float] | None]:
    """Return points (n, 3) of the robot's frame in the coordinates of the file, mm with one decimal."""
    found = transform_points(points, np.asarray(np.linalg.inv(to_robot)))
    return [np.round(point, 1).tolist() if np.isfinite(point).all() else None for point in found]


class PrintedFrame(NamedTuple):
    """Frame, from 0, that is printed, and what it is chosen for."""

    name: str
    frame: int


def printed_frames(plan: Plan, e2: Array) -> list[PrintedFrame]:
    """Choose the frames of a plan that are printed: first, middle, largest e2 and last of those with a shape.

    e2: error of the frames (T,), mm.
    """
    known = np.flatnonzero(plan.reached_frames)
    if not known.size:
        return []
    worst = int(np.nanargmax(np.where(plan.reached_frames, e2, np.nan)))
    chosen = {
        "first frame": int(known[0]),
        "middle frame": int(known[len(known) // 2]),
        "largest error e2": worst,
        "last frame": int(known[-1]),
    }
    return [PrintedFrame(name, frame) for name, frame in chosen.items()]
