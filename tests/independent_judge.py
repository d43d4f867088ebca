"""A second opinion on plans: verdicts from the equations and from a saved plan.npz, without code of the library.

From the file the judge takes data alone: the motion (time, alpha, beta, theta), the targets, the lumen, the
numbers of the robot, the samples' differences from it, and which frames were solved. Shapes, margins, clearances
and lost samples it finds by itself: tubes by shooting (independent_tubes.py), the wall by brute force.
Definitions: DESIGN, "Verdicts".

What it cannot judge: whether a frame is a KKT point. It counts the frames that the file marks as solved, and asks
that their residuals are small enough.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from independent_tubes import Body, body_of, move_nominal, move_samples, stability_margins, tubes_of
from scipy.spatial import cKDTree

YES, NO, NOT_CHECKED = "yes", "no", "NOT CHECKED"
ARRIVAL_MM = 2.0
ERROR_MM = 2.0
CONTACT_MM = 0.5
SAMPLE_CONTACT_MM = 1.0
SHARE = 0.95
OTHER_BRANCH_RAD = 1.0
"""A sample whose tips are turned by more against each other than the nominal robot's is on another branch."""
MARGIN_SLACK = 0.005
"""By how much the stability margin may fall short of the one that was asked for."""
BIFURCATION_MARGIN = 1e-3
"""A margin this small is that of a bifurcation, whatever was asked for."""
KKT_MM2 = 1e-2
"""Largest KKT residual of a solved frame, mm^2 per rad or mm."""
LIMIT_SLACK = 1e-5
"""rad or mm by which positions and steps from frame to frame may exceed a limit."""
SUBSTEPS = 10
SAMPLE_SUBSTEPS = 4
SIGMAS = 101
WALL_SPACING_MM = 0.1
"""Between the points of a lumen's path."""
BODY_SPACING_MM = 0.5
"""At most, between the places along the body whose clearance is found."""
GROUP = 250
"""Shapes whose clearances are found at once."""


class Finding(NamedTuple):
    """Word and number of one verdict. distance: of the number from its threshold, in its unit, or None."""

    word: str
    number: float | None
    distance: float | None = None


@dataclass(eq=False)
class Judgement:
    """What the judge finds of a plan: seven findings, and the figures behind them.

    shape (T, 101, 3) mm; e2 (T,) mm; margin (T, 10), at sub-steps of which the last is the frame; NaN: unknown.
    lost, missed, pressed (n,): samples that snap or are on another branch, do not arrive, or touch the wall by
    more than they may. sample_tip, sample_contact (n,): mm from the target's end, and the deepest contact; NaN of
    samples that are lost.
    """

    findings: dict[str, Finding]
    shape: np.ndarray
    margin: np.ndarray
    e2: np.ndarray
    tip_degrees: float
    snaps: list[int]
    lost: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=bool))
    missed: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=bool))
    pressed: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=bool))
    sample_tip: np.ndarray = field(default_factory=lambda: np.empty(0))
    sample_contact: np.ndarray = field(default_factory=lambda: np.empty(0))


def judge(path: str | Path) -> Judgement:
    """Judge a saved plan.

    Samples are those of the file's ``draws_parts`` and ``draws_lags``; without them no robots as built are judged.
    """
    with np.load(path, allow_pickle=False) as data:
        file = {name: data[name] for name in data.files}
    meta = json.loads(str(file["meta"]))
    robot, options = meta["robot"], meta.get("options", {})
    q = np.concatenate([file["alpha"], file["beta"], file["theta"]], axis=1)
    target = file["target"]
    wall = Wall(file["lumen"]) if "lumen" in file else None

    nominal = move_nominal(tubes_of(robot), q, SUBSTEPS)
    known = np.isfinite(nominal.rates).all(axis=-1)
    shape = np.full((*q[:, :1].shape, SIGMAS, 3), np.nan)[:, 0]
    tangent = np.full((len(q), 3), np.nan)
    margin = np.full(known.shape, np.nan)
    depth = np.full(known.shape, np.nan)
    places = np.argwhere(known)
    for first in range(0, len(places), GROUP):
        group = places[first : first + GROUP]
        chosen = np.zeros_like(known)
        chosen[tuple(group.T)] = True
        twist, theta = nominal.twists(chosen)
        body = body_of(twist, theta)
        margin[chosen] = stability_margins(twist)
        if wall is not None:
            depth[chosen] = wall.deepest(body)
        at_frame = group[:, 1] == SUBSTEPS - 1
        frames = group[at_frame, 0]
        whole = Body(*(each[:, at_frame] for each in (body.s, body.points, body.tangents, body.radius)))
        shape[frames] = whole.at(np.linspace(0, 1, SIGMAS) * whole.s[-1][:, None])
        tangent[frames] = whole.tangents[-1]

    tip, degrees = _arrival(shape[-1, -1], tangent[-1], target[-1, -1], file["target_direction"][-1])
    weights = np.full(SIGMAS, 1.0)
    weights[[0, -1]] = 0.5
    e2 = np.sqrt(((shape - target) ** 2).sum(axis=-1) @ weights / weights.sum())
    findings = {
        "solved": _solved(file, meta),
        "arrives": _arrives(tip, degrees, shape[-1], target[-1], float(e2[-1])),
        "follows": _at_most(float(e2.max()), ERROR_MM),
        "stable": _stable(margin, nominal.snaps, options.get("stability_margin")),
        "within_limits": _within_limits(robot, q, float(file["time"][0])),
        "within_wall": Finding(NOT_CHECKED, None) if wall is None else _at_most(float(depth.max()), CONTACT_MM),
        "holds": Finding(NOT_CHECKED, None),
    }
    found = Judgement(findings, shape, margin, e2, degrees, nominal.snaps)
    if "draws_parts" in file:
        _judge_samples(found, file, robot, q, nominal.tip_angles[:, -1], wall)
    return found


def _judge_samples(found: Judgement, file: dict, robot: dict, q, nominal_tips, wall: Wall | None) -> None:
    """Move samples of the robot through q, and find which of them hold."""
    tubes, lags = tubes_of(robot, file["draws_parts"]), np.asarray(file["draws_lags"], dtype=float).T
    count, frames = lags.shape[1], len(q)
    end = file["target"][-1, -1]
    tip, contact, away = np.full(count, np.nan), np.zeros(count), np.zeros(count, dtype=bool)

    def each_frame(frame, rows, twist, tips) -> None:
        own = nominal_tips[frame] - nominal_tips[frame, -1]
        # Not "more than", so that robots count as lost where the nominal one has no shape to compare with.
        away[rows] |= ~(abs(tips - tips[-1:] - own[:, None]) <= OTHER_BRANCH_RAD).all(axis=0)
        last = frame == frames - 1
        if wall is None and not last:
            return
        body = body_of(twist, np.repeat(q[frame, -2:, None], len(rows), axis=1))
        if wall is not None:
            contact[rows] = np.maximum(contact[rows], wall.deepest(body))
        if last:
            tip[rows] = np.linalg.norm(body.points[-1] - end, axis=-1)

    snapped = move_samples(tubes, lags, q, each_frame, SAMPLE_SUBSTEPS)
    found.lost = (snapped > 0) | away
    tip[found.lost] = contact[found.lost] = np.nan
    found.sample_tip, found.sample_contact = tip, contact
    found.missed = ~found.lost & ~(tip <= ARRIVAL_MM)
    found.pressed = ~found.lost & (contact > SAMPLE_CONTACT_MM)
    share = float((~(found.lost | found.missed | found.pressed)).mean())
    found.findings["holds"] = Finding(YES if share >= SHARE else NO, share, share - SHARE)


def _arrival(tip, tangent, end, direction) -> tuple[float, float]:
    """Distance of the tip from the target's end, mm, and the angle between their directions, degrees."""
    sine = np.linalg.norm(np.cross(tangent, direction))
    return float(np.linalg.norm(tip - end)), float(np.degrees(np.arctan2(sine, tangent @ direction)))


def _arrives(tip: float, degrees: float, body, target, e2: float) -> Finding:
    """Whether the tip is at the target's end, and the body lies along the target, not across a detour."""
    length, own = (np.linalg.norm(np.diff(points, axis=0), axis=1).sum() for points in (target, body))
    allowed = max(0.1 * length, 5.0)
    if tip <= ARRIVAL_MM and (degrees > 90 or length - own > allowed or e2 > allowed):
        return Finding(NO, tip, ARRIVAL_MM - tip)
    return _at_most(tip, ARRIVAL_MM)


def _at_most(number: float, allowed: float) -> Finding:
    """Yes where a number is at most what is allowed; a NaN is not checked."""
    if not np.isfinite(number):
        return Finding(NOT_CHECKED, None)
    return Finding(YES if number <= allowed else NO, number, allowed - number)


def _solved(file: dict, meta: dict) -> Finding:
    """Whether all frames are marked as solved, with small residuals."""
    good = file["success"] & (file["kkt"] <= KKT_MM2)
    interpolated = len(meta.get("interpolated", []))
    if (~file["success"]).sum() > interpolated or (file["success"] & ~good).any():
        return Finding(NO, float(good.sum()))
    return Finding(NOT_CHECKED if interpolated else YES, float(good.sum()))


def _stable(margin: np.ndarray, snaps: list[int], asked: float | None) -> Finding:
    """Whether a robot keeps the margin asked for at (T, 10) places of a motion, and does not snap."""
    least = float(np.nanmin(margin))
    threshold = max(BIFURCATION_MARGIN, 0.0 if asked is None else asked - MARGIN_SLACK)
    if snaps:
        return Finding(NO, least)
    if not np.isfinite(margin).all():
        return Finding(NOT_CHECKED, least)
    return Finding(YES if least >= threshold else NO, least, least - threshold)


# --- limits ------------------------------------------------------------------------------------------------------


def _within_limits(robot: dict, q: np.ndarray, dt: float) -> Finding:
    """Whether all of q (T, 2d + 2) is allowed; the number is the largest part of a speed or acceleration used, %.

    distance: how much is left to the limit that a motion exceeds by most, or comes nearest to, rad or mm a frame.
    """
    tubes, limits = robot["tubes"], robot["limits"]
    d = len(tubes)
    beta, step = q[:, d : 2 * d], np.diff(q, axis=0)
    beta_limits = limits.get("beta")
    if beta_limits is None:
        beta_limits = [(0.0, tube["curved_length"]) for tube in tubes]
    pairs = [
        *np.broadcast_to(_numbers(limits["alpha"]), (d, 2)),
        *np.broadcast_to(_numbers(beta_limits), (d, 2)),
        *np.broadcast_to(_numbers(limits["theta"]), (2, 2)),
    ]
    lower, upper = np.array(pairs).T
    left = [np.min(q - lower), np.min(upper - q), np.min(np.diff(beta, axis=1), initial=np.inf)]
    if limits.get("carriage_gap") is not None:
        lengths = np.diff([tube["length"] for tube in tubes])
        left.append(np.min(lengths - np.diff(beta, axis=1) - limits["carriage_gap"]))
    used = 0.0
    for order, name in ((1, "speed"), (2, "acceleration")):
        most = np.concatenate(
            [
                np.broadcast_to(_numbers(limits[f"{axis}_{name}"]), size)
                for axis, size in (("alpha", d), ("beta", d), ("theta", 2))
            ]
        )
        change = abs(np.diff(step, n=order - 1, axis=0))
        if change.size:
            left.append(np.min(most * dt**order - change))
            used = max(used, float((change / (most * dt**order)).max()))
    least = float(min(left))
    return Finding(YES if least >= -LIMIT_SLACK else NO, 100 * used, least + LIMIT_SLACK)


def _numbers(value) -> np.ndarray:
    """Limits as arrays; files write what is unlimited as text."""
    return np.array(value, dtype=object).astype(float)


# --- the wall ----------------------------------------------------------------------------------------------------


class Wall:
    """The wall of a lumen: a path and a radius along it, from a table (N, 4) of x, y, z and radius, mm.

    The clearance of a place on the body is the radius at the nearest place of the path, less the distance to it,
    less the radius of the outermost tube there. The path is a polyline through the table's points, of which each
    part is divided finely, and the nearest place is looked for on the two parts beside the nearest point.
    """

    def __init__(self, table: np.ndarray) -> None:
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(table[:, :3], axis=0), axis=1))])
        keep = np.concatenate([[True], np.diff(along) > 1e-9])
        along, table = along[keep], table[keep]
        between = [
            np.linspace(a, b, max(2, int(np.ceil((b - a) / WALL_SPACING_MM)) + 1))[:-1]
            for a, b in itertools.pairwise(along)
        ]
        fine = np.concatenate([*between, along[-1:]])
        self._points = np.stack([np.interp(fine, along, table[:, k]) for k in range(3)], axis=-1)
        self._radius = np.interp(fine, along, table[:, 3])
        self._tree = cKDTree(self._points)

    def left(self, points: np.ndarray) -> np.ndarray:
        """Radius of the lumen less the distance to its path (..,), mm, at points (.., 3)."""
        nearest = self._tree.query(points)[1]
        best, radius = np.full(nearest.shape, np.inf), np.zeros(nearest.shape)
        for shift in (-1, 0):
            k = np.clip(nearest + shift, 0, len(self._points) - 2)
            start = self._points[k]
            span = self._points[k + 1] - start
            z = np.clip(((points - start) * span).sum(-1) / (span**2).sum(-1), 0.0, 1.0)
            distance = np.linalg.norm(points - start - z[..., None] * span, axis=-1)
            closer = distance < best
            best = np.where(closer, distance, best)
            radius = np.where(closer, self._radius[k] + z * (self._radius[k + 1] - self._radius[k]), radius)
        return radius - best

    def deepest(self, body: Body) -> np.ndarray:
        """Deepest contact (n,) of robots, mm; negative where a robot is clear of the wall, by that much."""
        lengths = np.diff(body.s, axis=0)
        parts = int(np.ceil(lengths.max() / BODY_SPACING_MM))
        # Both ends of every step: where a tube ends, the place counts for the wider tube as well.
        clearance = self.left(body.within_steps(np.linspace(0, 1, parts + 1))) - body.radius[:, None]
        return -np.where(lengths[:, None] > 0, clearance, np.inf).min(axis=(0, 1))
