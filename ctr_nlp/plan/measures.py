"""Measures of a motion: its errors, its contacts, and how much of its limits it uses.

Errors are those of section IV of the paper, on 101 uniform sigma: e1(sigma) = |C(sigma) - C_target(sigma)| in a
frame, e2 = sqrt(mean over sigma of e1^2), the square root of the distance of eq. (8), and e3 the root mean square
of e2 over frames; all in mm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ctr_nlp.paths.lumen import Lumen, outermost_tube_index
from ctr_nlp.paths.target import QUADRATURE, SIGMA_GRID
from ctr_nlp.paths.walls import LUMEN_NAME, Walls
from ctr_nlp.plan.plan_data import PlanData
from ctr_nlp.support.flag_runs import find_flag_runs
from ctr_nlp.typing import Array

MAX_ARRIVAL_ANGLE_DEG = 90.0
"""Largest angle, degrees, between the tip and the target's end at which a robot may have come along the path."""
MAX_SHORTCUT_PART, MIN_SHORTCUT_MM = 0.1, 5.0
"""Part of the path's length by which a robot that came along it may be shorter, or away from it in the root mean
square, and the length, mm, that short paths allow instead.
"""


def rms_over_sigma(distance: Array) -> Array:
    """Return the root mean square over sigma of `distance` (.., 101) in mm, with trapezoidal weights."""
    return np.sqrt(distance**2 @ QUADRATURE)


def e1(plan: PlanData) -> Array:
    """Return the distance (T, 101) in mm between shape and target of a plan at the same sigma."""
    return np.linalg.norm(plan.shape - plan.target, axis=-1)


def nearest_target_distances(plan: PlanData) -> Array:
    """Return the distance (T, 101) in mm from each point of a plan's shapes to the nearest point of the target."""
    return np.array(
        [_distances_to_polyline(shape, target) for shape, target in zip(plan.shape, plan.target, strict=True)]
    )


def _distances_to_polyline(points: Array, line: Array) -> Array:
    """Return the distances (n,) from points (n, 3) to the polyline through line (m, 3), all in mm."""
    start = line[:-1]
    span = np.diff(line, axis=0)
    # Squared lengths; the floor keeps a segment whose ends coincide from dividing by 0.
    length = np.maximum((span**2).sum(-1), 1e-30)
    through = points @ span.T - (start * span).sum(-1)
    along = np.clip(through / length, 0.0, 1.0)
    # |p - a - t v|^2 of every pair of point p and segment a + t v, less |p|^2, which all segments share: products
    # of matrices instead of an (n, m, 3) array. Their rounding may exchange segments that are equally near, so
    # that the distance itself is computed directly below.
    apart = along * (along * length - 2 * through) - 2 * points @ start.T + (start**2).sum(-1)
    best = apart.argmin(axis=1)
    found = points - start[best] - along[range(len(points)), best, None] * span[best]
    return np.linalg.norm(found, axis=-1)


def follow_the_leader_deviation(plan: PlanData) -> Array:
    """Return the largest distance (T,) in mm from each shape of a plan to the last known shape.

    It is 0 in follow-the-leader motion, where the body passes where the tip has been, whatever the target. NaN
    where a shape is not known.
    """
    known = np.flatnonzero(plan.reached_frames)
    if not known.size:
        return np.full(len(plan.time), np.nan)
    last = plan.shape[known[-1]]
    return np.array([_distances_to_polyline(shape, last).max() for shape in plan.shape])


def e3(plan: PlanData) -> float | None:
    """Return the root mean square of e2 over the frames of a plan whose shape is known, mm; None without any."""
    return root_mean_square(rms_over_sigma(e1(plan)))


def root_mean_square(values: Array) -> float | None:
    """Return the root mean square of the finite ones of `values` (T,); None without any."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else None


def tip_angle(plan: PlanData) -> Array:
    """Return the angle (T,) in rad between the tip's direction and the target's in each frame of a plan."""
    # Not the arccos of the scalar product: near 0 it has only half the digits.
    cross = np.linalg.norm(np.cross(plan.tip_direction, plan.target_direction), axis=-1)
    return np.arctan2(cross, (plan.tip_direction * plan.target_direction).sum(-1))


class TipArrival(NamedTuple):
    """How a motion ends: where its tip is in the last frame, seen from the target's end.

    distance: mm from the target's end. angle_deg: between the directions of tip and target, degrees. short: by how
    many mm the robot is shorter than its target; negative where it is longer.
    """

    distance: float
    angle_deg: float
    short: float


def arrival(plan: PlanData) -> TipArrival | None:
    """Return how a plan ends; None where the robot's shape in the last frame is not known."""
    if not plan.reached_frames[-1]:
        return None
    target = plan.target[-1]
    length = float(np.linalg.norm(np.diff(target, axis=0), axis=-1).sum())
    distance = float(np.linalg.norm(plan.shape[-1, -1] - target[-1]))
    return TipArrival(distance, float(np.degrees(tip_angle(plan)[-1])), length - float(plan.beta[-1, -1]))


def describe_shortcut(plan: PlanData, tolerance: float) -> str | None:
    """Return how a robot whose tip is at the target's end got there by another way than along the path.

    plan: whose last frame counts. tolerance: distance from the target's end that is allowed, mm; who allows more
    than a shortcut is long is not told of it. None where the robot lies along the path, or its last shape is not
    known.
    """
    end = arrival(plan)
    if end is None:
        return None
    length = float(np.linalg.norm(np.diff(plan.target[-1], axis=0), axis=-1).sum())
    allowed = max(MAX_SHORTCUT_PART * length, MIN_SHORTCUT_MM)
    if tolerance > allowed:
        return None
    away = float(rms_over_sigma(e1(plan))[-1])
    if end.angle_deg > MAX_ARRIVAL_ANGLE_DEG:
        return f"it points {end.angle_deg:.0f}° away from the direction of the path"
    if end.short > allowed:
        return f"the robot is {end.short:.0f} mm shorter than the path of {length:.0f} mm"
    if away > allowed:
        return f"the robot's body is {away:.0f} mm away from the path (e2)"
    return None


class LargestError(NamedTuple):
    """The worst frame: its e2 in mm and number, from 1; and e3 over all frames, mm."""

    e2: float
    frame: int
    e3: float


def largest_error(plan: PlanData) -> LargestError | None:
    """Return the frame of a plan with the largest e2, of those whose shape is known; None without any."""
    e2 = rms_over_sigma(e1(plan))
    overall = root_mean_square(e2)
    if overall is None:
        return None
    frame = int(np.nanargmax(e2))
    return LargestError(float(e2[frame]), frame + 1, overall)


def points_in_file(plan: PlanData, points: Array) -> Array:
    """Return points (.., 3) mm of a plan's robot frame in the coordinates of the target's file."""
    back = np.linalg.inv(plan.to_robot)
    return np.asarray(points @ back[:3, :3].T + back[:3, 3])


def describe_place(plan: PlanData, point: Array) -> str:
    """Write a point (3,), mm, and in which coordinates it is; point: in those of the plan's file, or without one
    in the robot's base frame.
    """
    # Adding 0 turns -0 into 0.
    numbers = ", ".join(f"{x:.1f}" for x in np.round(point, 1) + 0.0)
    space = plan.meta["problem"].get("space")
    named = {None: "", "xyz": " in the file's axes"}.get(space, f" in {space}")
    return f"({numbers}) mm{named}"


class DeepestPoint(NamedTuple):
    """The point of a robot that is nearest to a wall, or deepest in it, over a whole motion.

    depth: mm beyond the wall; negative is clearance. when: "in frame" or "on the way to frame". frame: its number,
    from 1. tube: number of the outermost tube there, from 1. arc_length: mm along the robot from the insertion
    point. point: (3,) mm of the body in that frame, in the coordinates of the target's file; on the way to a frame
    the body is near it.
    """

    depth: float
    when: str
    frame: int
    tube: int
    arc_length: float
    point: Array


def find_deepest_points(plan: PlanData) -> dict[str, DeepestPoint]:
    """Return the point where a plan's robot is deepest in each of its walls, by the wall's name.

    Walls from which no clearance is known are left out.
    """
    if plan.wall_clearance is None:
        (name,) = plan.wall.names if isinstance(plan.wall, Walls) else [LUMEN_NAME]
        each = {name: _find_deepest_point(plan, plan.clearance, plan.clearance_between)}
    else:
        assert isinstance(plan.wall, Walls)
        assert plan.wall_clearance_between is not None
        each = {
            name: _find_deepest_point(plan, plan.wall_clearance[:, k], plan.wall_clearance_between[:, k])
            for k, name in enumerate(plan.wall.names)
        }
    return {name: place for name, place in each.items() if place is not None}


def find_deepest_point(plan: PlanData) -> DeepestPoint | None:
    """Return the point where a plan's robot is deepest in any wall, in or between frames; None if unknown."""
    return _find_deepest_point(plan, plan.clearance, plan.clearance_between)


def _find_deepest_point(plan: PlanData, least: Array | None, between: Array | None) -> DeepestPoint | None:
    """Return the point where a robot is deepest in a wall; least, between: its clearance (T, 101) from it, mm.

    A point between frames counts only where it is deeper than those in frames by more than rounding.
    """
    if least is None or not np.isfinite(least).any():
        return None
    when = "in frame"
    if between is not None and np.nanmin(between) < np.nanmin(least) - 1e-6:
        least = between
        when = "on the way to frame"
    frame, sample = np.unravel_index(np.nanargmin(least), least.shape)
    tube = outermost_tube_index(plan.beta[frame][None], SIGMA_GRID)[0, sample]
    arc_length = float(SIGMA_GRID[sample] * plan.beta[frame, -1])
    point = points_in_file(plan, plan.shape[frame, sample])
    return DeepestPoint(-float(least[frame, sample]), when, int(frame) + 1, int(tube) + 1, arc_length, point)


class Contact(NamedTuple):
    """A run of frames in which the robot touches the wall, and its deepest point.

    first, last: the frames, from 1. depth: of the deepest point beyond the wall, mm; frame, tube: its frame and
    tube, from 1. arc_length: mm along the robot; path: mm along the path of the lumen, or else of the last target;
    both from the insertion point.
    """

    first: int
    last: int
    depth: float
    frame: int
    tube: int
    arc_length: float
    path: float


def contact_depths(plan: PlanData) -> Array:
    """Return the deepest contact (T,) in mm in each frame of a plan; 0 where nothing touches, NaN if unknown."""
    if plan.clearance is None:
        return np.full(len(plan.time), np.nan)
    return np.maximum(0.0, -plan.clearance.min(axis=1))


def contacts(plan: PlanData) -> list[Contact]:
    """Return all contacts of a plan with the wall, in order of time; an empty list where no wall is known."""
    if plan.clearance is None:
        return []
    deep = contact_depths(plan)
    path = Lumen(np.column_stack([plan.target[-1], np.ones(101)]) if plan.lumen is None else plan.lumen)
    found = []
    for first, stop in find_flag_runs(deep > 0):
        frame = first + int(deep[first:stop].argmax())
        sample = int(plan.clearance[frame].argmin())
        tube = outermost_tube_index(plan.beta[frame][None], SIGMA_GRID)[0, sample]
        # Lengths along the path count from the insertion point, the origin, wherever the lumen begins.
        ends = np.stack([np.zeros(3), plan.shape[frame, sample]])
        start, place = path.project(ends).length_before
        s = SIGMA_GRID[sample] * plan.beta[frame, -1]
        numbers = float(deep[frame]), frame + 1, int(tube) + 1, float(s), float(place - start)
        found.append(Contact(first + 1, stop, *numbers))
    return found


PLAN_LIMIT_TOLERANCE_RAD_OR_MM = 1e-5
"""rad or mm by which positions, and steps from frame to frame, may exceed their limits: what solvers leave."""


class LimitUse(NamedTuple):
    """Use of a limit.

    part: used part of the limit, 1 for all of it. exceeded: whether it is exceeded by more than
    PLAN_LIMIT_TOLERANCE_RAD_OR_MM. what: which limit, and in which frame.
    """

    part: float
    exceeded: bool
    what: str


def find_most_used_limit(plan: PlanData) -> LimitUse | None:
    """Return the limit that a plan exceeds most, or else the speed or acceleration that uses most of its limit.

    Positions count only where they exceed their limits, since tubes are meant to come out all the way: as 1 plus
    the excess as a part of the robot's reach, or of half a turn. None where the robot does not move.
    """
    found = [used for used in (*_rates(plan), *_positions(plan)) if used.part > 0]
    return max(found, key=lambda used: (used.exceeded, used.part), default=None)


def rate_parts(plan: PlanData, order: int) -> Array:
    """Return the speeds or accelerations of a plan as parts of their limits, (T - order, 2d + 2); 0 if unknown.

    order: 1 for speeds, 2 for accelerations.
    """
    limit = (plan.robot.speed, plan.robot.acceleration)[order - 1]
    return np.nan_to_num(np.abs(np.diff(plan.q, n=order, axis=0)) / plan.dt**order / limit)


def _rates(plan: PlanData) -> Iterator[LimitUse]:
    """Yield the speed and the acceleration that use most of their limits."""
    robot = plan.robot
    for order, name, limit in ((1, "speed", robot.speed), (2, "acceleration", robot.acceleration)):
        parts = rate_parts(plan, order)
        if parts.size:
            j, i = np.unravel_index(parts.argmax(), parts.shape)
            part = float(parts[j, i])
            exceeded = (part - 1) * float(limit[i]) * plan.dt**order > PLAN_LIMIT_TOLERANCE_RAD_OR_MM
            yield LimitUse(part, exceeded, f"{name} of {robot.axes[i]} on the way to frame {j + 1 + order}")


def _positions(plan: PlanData) -> Iterator[LimitUse]:
    """Yield the worst excess of each limit of position, order and carriage gap that is exceeded."""
    robot = plan.robot
    d = plan.robot.d
    reach = plan.robot.reach
    scale = np.where(np.char.startswith(robot.axes, "beta"), reach, math.pi)
    growth = np.diff(plan.beta, axis=1)
    between = [f"{i} and {i + 1}" for i in range(1, d)]
    kinds = [
        (robot.lower - plan.q, scale, [f"lower limit of {axis}" for axis in robot.axes]),
        (plan.q - robot.upper, scale, [f"upper limit of {axis}" for axis in robot.axes]),
        (-growth, np.full(d - 1, reach), [f"order of tubes {pair}" for pair in between]),
    ]
    if robot.carriage_gap is not None:
        # Carriages i and i + 1 are (L_{i+1} - beta_{i+1}) - (L_i - beta_i) apart.
        apart = np.diff([tube.length for tube in robot.tubes]) - growth
        gaps = [f"gap between carriages {pair}" for pair in between]
        kinds.append((robot.carriage_gap - apart, np.full(d - 1, reach), gaps))
    for excess, scales, names in kinds:
        beyond = np.nan_to_num(excess)
        if beyond.size and beyond.max() > PLAN_LIMIT_TOLERANCE_RAD_OR_MM:
            j, i = np.unravel_index(beyond.argmax(), beyond.shape)
            yield LimitUse(1 + float(beyond[j, i] / scales[i]), True, f"{names[i]} in frame {j + 1}")
