"""The second opinion on a plan: verdicts from the motion and the equations, and whether the record fits them.

From the file the checker takes data alone: the motion (time, alpha, beta, theta), the targets, the wall, the
numbers of the robot, the samples' differences from it, and which frames were solved. Shapes, margins, clearances
and lost samples it finds by itself: tubes by shooting (tubes.py), the wall by nearest points (walls.py). What the
file records of the same quantities is then compared with what was found (records.py).

What it cannot check: whether a frame is a KKT point. It counts the frames that are marked as solved, and asks that
their residuals are small enough. A robot under a load is not covered.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.check.plan_file import PlanFile
from ctr_nlp.check.tubes import (
    Array,
    NominalMotion,
    RobotShape,
    Settle,
    compute_body,
    compute_stability_margins,
    integrate,
    move_nominal,
    move_samples,
    read_tubes,
    replace_by_dominant,
)
from ctr_nlp.check.walls import (
    FIELD_ERROR_MM,
    MEASURED_MM,
    MeasuredWall,
    find_deepest_contact,
    measure_left,
    read_walls,
)

YES, NO, NOT_COVERED = "yes", "no", "not covered"
VERDICTS = "solved", "arrives", "follows", "stable", "within_limits", "within_wall", "holds"
"""Names of the verdicts, those of ``plan.verdicts``."""
DEVIATIONS = "curvature", "bending_stiffness", "torsional_ratio", "curved_length", "motor_zero"
"""What samples differ in, in the order of the file's ``draws_parts``."""
THRESHOLDS = {"arrival_tolerance": 2.0, "error_allowed": 2.0, "contact_allowed": 0.5, "share": 0.95}
"""Those of a plan whose options do not name them: mm, and the share of samples that must hold."""
SAMPLE_CONTACT_MM = 1.0
"""Contact allowed to samples, unless the nominal robot is allowed more."""
OTHER_BRANCH_RAD = 1.0
"""A sample whose tips are turned by more against each other than the nominal robot's is on another branch."""
MARGIN_SLACK = 0.005
"""By how much the stability margin may fall short of the one that was asked for."""
BIFURCATION_MARGIN = 1e-3
"""A margin this small is that of a bifurcation, whatever was asked for."""
MAX_KKT_MM2 = 1e-2
"""Largest KKT residual of a solved frame, mm^2 per rad or mm."""
LIMIT_SLACK = 1e-5
"""rad or mm by which positions and steps from frame to frame may exceed a limit."""
SUBSTEPS = 10
SAMPLE_SUBSTEPS = 4
SIGMA = np.linspace(0, 1, 101)
DETOUR = "The robot arrives, but not along the path."
GROUP = 250
"""Shapes whose clearances are found at once."""


class Finding(NamedTuple):
    """Finding of the checker on one matter.

    Attributes
    ----------
    word : str
        ``"yes"``, ``"no"`` or ``"not covered"``.
    number : float or None
        The figure that decides; None where there is none.
    distance : float or None
        Of the number from its threshold, in its unit; negative beyond it.
    why : str
        A sentence with the place and the limit, or the reason why the matter is not covered.
    """

    word: str
    number: float | None = None
    distance: float | None = None
    why: str = ""


@dataclass(eq=False)
class CheckResult:
    """Result of a check: findings by name, and the figures behind them.

    Attributes
    ----------
    file : PlanFile
        What was checked.
    findings : dict of str to Finding
        Seven verdicts under the names of ``plan.verdicts``, and findings on the record (``records.RECORDS``).
    shape, e2 : ndarray
        Shapes (T, 101, 3) and errors (T,) on the elastic model, mm; NaN where the robot has no equilibrium.
    margin, clearance : ndarray
        Stability margins (T, 10) and clearance (T, 10, 101), mm, at sub-steps, of which the last is the frame.
    tip_direction : ndarray
        Unit tangents (T, 3) at the tip.
    snaps : list of int
        Frames, from 1, on the way to which the robot snaps.
    lost, missed, pressed : ndarray of bool
        Samples (n,) that snap or are on another branch, do not arrive, or touch the wall by more than they may.
    sample_tips, sample_contact, sample_e2 : ndarray
        Last tips (n, 3), deepest contacts (n,) and errors (n, T), mm; NaN where a sample is lost.
    """

    file: PlanFile
    findings: dict[str, Finding]
    shape: Array
    e2: Array
    margin: Array
    clearance: Array
    tip_direction: Array
    snaps: list[int]
    lost: Array
    missed: Array
    pressed: Array
    sample_tips: Array
    sample_contact: Array
    sample_e2: Array

    @property
    def tip_degrees(self) -> float:
        """Angle between tip and target in the last frame."""
        own, wanted = self.tip_direction[-1], self.file.arrays["target_direction"][-1]
        return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(own, wanted)), own @ wanted)))

    @property
    def sample_tip(self) -> Array:
        """Distances (n,) of the samples' last tips from the target's end, mm."""
        return np.asarray(np.linalg.norm(self.sample_tips - self.file.arrays["target"][-1, -1], axis=-1))


def examine_motion(file: PlanFile, samples: int = 0, settle: Settle | None = None) -> CheckResult:
    """Find the seven verdicts on the motion of a plan.

    Parameters
    ----------
    file : PlanFile
        The plan.
    samples : int
        How many simulated robots are moved: the first ones in the file, or where it has none robots drawn from the
        tolerances.
    settle : callable, optional
        Finds where a robot comes to rest after a snap. Without it, what follows a snap is not covered.

    Returns
    -------
    CheckResult
        With the verdicts alone.
    """
    arrays, meta = file.arrays, file.meta
    q: Array = np.concatenate([arrays["alpha"], arrays["beta"], arrays["theta"]], axis=1)
    limits = _judge_limits(meta["robot"], q, float(arrays["time"][0]))
    drawn = _take_samples(file, samples)
    found = _make_empty_result(file, len(q), 0 if drawn is None else len(drawn[0]))
    found.findings.update(solved=_judge_solved(file), within_limits=limits)
    why = ""
    beta, length = arrays["beta"], np.array([tube["length"] for tube in meta["robot"]["tubes"]])
    if not np.isfinite(q).all():
        why = "Frames have no configuration."
    elif max((-beta).max(), (beta - length).max(), -np.diff(beta, axis=1).min(initial=0.0)) > LIMIT_SLACK:
        why = "Tubes are further out than they are long, or out of order."
    elif meta.get("load", meta.get("planned_load")) is not None:
        why = "The robot is under a load, which the checker's equations do not have."
    elif meta.get("reversed") or meta.get("stretch", {}).get("first", 1) > 1:
        why = "The motion does not begin where the robot enters: its equilibrium there depends on what was before."
    if why:
        uncovered = Finding(NOT_COVERED, why=why)
        found.findings.update(dict.fromkeys(("arrives", "follows", "stable", "within_wall", "holds"), uncovered))
        return found
    walls = read_walls(arrays, meta)
    nominal = move_nominal(read_tubes(meta["robot"]), q, SUBSTEPS, settle)
    found.findings.update(_judge_shapes(found, _measure(found, nominal, walls), walls))
    if drawn is not None and not np.isfinite(nominal.tip_angles).all():
        found.findings["holds"] = Finding(NOT_COVERED, why="Samples are compared with the robot, which snaps.")
    elif drawn is None:
        why = "Samples under a tip force or of other tolerances than uniform ones." if samples else "No samples."
        found.findings["holds"] = Finding(NOT_COVERED, why=why)
    else:
        found.findings["holds"] = _judge_samples(found, q, nominal.tip_angles[:, -1], walls, drawn, settle)
    return found


def _make_empty_result(file: PlanFile, frames: int, samples: int) -> CheckResult:
    """Return a result in which nothing is known yet, for so many frames and samples."""
    return CheckResult(
        file,
        findings={},
        shape=np.full((frames, len(SIGMA), 3), np.nan),
        e2=np.full(frames, np.nan),
        margin=np.full((frames, SUBSTEPS), np.nan),
        clearance=np.full((frames, SUBSTEPS, len(SIGMA)), np.nan),
        tip_direction=np.full((frames, 3), np.nan),
        snaps=[],
        lost=np.zeros(samples, dtype=bool),
        missed=np.zeros(samples, dtype=bool),
        pressed=np.zeros(samples, dtype=bool),
        sample_tips=np.full((samples, 3), np.nan),
        sample_contact=np.full(samples, np.nan),
        sample_e2=np.full((samples, frames), np.nan),
    )


def _measure(found: CheckResult, nominal: NominalMotion, walls: list[MeasuredWall]) -> Array:
    """Fill in shapes, margins and clearances of a motion, and return the deepest contacts (T, 10, W), mm."""
    known = np.isfinite(nominal.rates).all(axis=-1)
    depth = np.full((*known.shape, len(walls)), np.nan)
    found.snaps.extend(nominal.snaps)
    for chosen, twist, body in _compute_bodies(nominal, known):
        points = body.interpolate(SIGMA * body.s[-1][:, None])
        found.margin[chosen] = compute_stability_margins(twist)
        if walls:
            depth[chosen] = np.stack([find_deepest_contact(wall, body, exactly=False) for wall in walls], axis=1)
            found.clearance[chosen] = measure_clearance(walls, points, twist.beta, twist.tubes.radius)
        frames, substeps = np.nonzero(chosen)
        at_frame = substeps == SUBSTEPS - 1
        found.shape[frames[at_frame]] = points[at_frame]
        found.tip_direction[frames[at_frame]] = body.tangents[-1, at_frame]
    # The deepest place is measured at the triangles, among those that the smooth surface leaves in question.
    for k, wall in enumerate(walls):
        question = np.asarray(
            known & (depth[..., k] >= np.nanmax(depth[..., k], initial=-np.inf) - FIELD_ERROR_MM)
        )
        for chosen, _, body in _compute_bodies(nominal, question):
            depth[chosen, k] = find_deepest_contact(wall, body)
    found.e2[:] = measure_errors(found.shape, found.file.arrays["target"])
    return depth


def _compute_bodies(nominal: NominalMotion, known: Any) -> Iterator[tuple[Array, Any, RobotShape]]:
    """Yield groups of places (T, 10) of a motion among those that are `known`, with their twists and bodies."""
    places = np.argwhere(known)
    for first in range(0, places.shape[0], GROUP):
        chosen = np.zeros_like(known)
        chosen[tuple(places[first : first + GROUP].T)] = True
        twist, theta = nominal.twists(chosen)
        yield chosen, twist, compute_body(twist, theta)


def measure_clearance(walls: list[MeasuredWall], points: Array, beta: Array, radius: Array) -> Array:
    """Return the clearance (n, 101), mm, of points (n, 101, 3) at uniform sigma.

    beta (d, n), radius (d, n): extensions and radii of tubes, mm. The outermost tube at a place counts.
    """
    ends = beta[:-1, :, None] + 1e-9
    outermost = (SIGMA * beta[-1][:, None] > ends).sum(axis=0)
    return measure_left(walls, points, np.take_along_axis(radius.T, outermost, axis=1))


def measure_errors(shape: Array, target: Array) -> Array:
    """Return e2 (..,), mm: the root mean square distance of shapes (.., 101, 3) from targets, by trapezoids."""
    weights = np.ones(len(SIGMA))
    weights[[0, -1]] = 0.5
    return np.asarray(np.sqrt(((shape - target) ** 2).sum(axis=-1) @ weights / weights.sum()))


def threshold(file: PlanFile, name: str) -> float:
    """Return a threshold among the options of a plan, or its default."""
    return float(file.meta.get("options", {}).get(name, THRESHOLDS[name]))


def sample_contact_allowed(file: PlanFile) -> float:
    """Return how deep a sample may be in a wall, mm."""
    return max(SAMPLE_CONTACT_MM, threshold(file, "contact_allowed"))


def _judge_shapes(found: CheckResult, depth: Array, walls: list[MeasuredWall]) -> dict[str, Finding]:
    """Return the verdicts on shapes and margins; depth (T, 10, W): deepest contacts with the walls, mm."""
    file = found.file
    asked = file.meta.get("options", {}).get("stability_margin")
    target = file.arrays["target"]
    tip = float(np.linalg.norm(found.shape[-1, -1] - target[-1, -1]))
    arrives = _judge_at_most(tip, threshold(file, "arrival_tolerance"), "mm from the target's end")
    length = float(np.linalg.norm(np.diff(target[-1], axis=0), axis=1).sum())
    detour_mm = max(0.1 * length, 5.0)
    short = length - float(file.arrays["beta"][-1, -1])
    detour = found.tip_degrees > 90 or short > detour_mm or found.e2[-1] > detour_mm
    if arrives.word == YES and detour and threshold(file, "arrival_tolerance") <= detour_mm:
        arrives = arrives._replace(word=NO, why=DETOUR)
    worst = _judge_at_most(float(found.e2.max()), threshold(file, "error_allowed"), "mm e2")
    frame = "" if worst.number is None else f" in frame {int(found.e2.argmax()) + 1}"
    within_wall = Finding(NOT_COVERED, why="The file has no wall.")
    if walls:
        # Tissue around a lumen gives a little; what is to be kept out of is not to be touched.
        allowed = [0.0 if wall.kept_out else threshold(file, "contact_allowed") for wall in walls]
        deepest = np.asarray(depth.max(axis=(0, 1)))
        first = int(np.argmax(np.nan_to_num(deepest - np.array(allowed), nan=np.inf)))
        within_wall = _judge_at_most(float(deepest[first]), allowed[first], "mm of contact")
    return {
        "arrives": arrives,
        "follows": worst._replace(why=worst.why + frame),
        "stable": _judge_stability(found.margin, found.snaps, asked),
        "within_wall": within_wall,
    }


def _judge_at_most(number: float, allowed: float, unit: str) -> Finding:
    """Return yes where a number is at most what is allowed; a NaN is not covered."""
    if not np.isfinite(number):
        return Finding(NOT_COVERED, why="The robot snaps before, or has no equilibrium.")
    return Finding(YES if number <= allowed else NO, number, allowed - number, f"{allowed:g} {unit} allowed")


def _judge_solved(file: PlanFile) -> Finding:
    """Return whether all frames are marked as solved, with small residuals."""
    success, kkt = file.arrays["success"], file.arrays["kkt"]
    large = success & (kkt > MAX_KKT_MM2)
    interpolated = len(file.meta.get("interpolated", []))
    number = float((success & ~large).sum())
    if (~success).sum() > interpolated or large.any():
        return Finding(NO, number, why="Frames are not solved, or their KKT residual is large.")
    if interpolated or np.isnan(kkt).any():
        return Finding(NOT_COVERED, number, why="Frames have no KKT residual.")
    return Finding(YES, number, why="All frames are marked as solved, with small KKT residuals.")


def _judge_stability(margin: Array, snaps: list[int], asked: float | None) -> Finding:
    """Return whether a robot keeps the margin asked for at (T, 10) places of a motion, and does not snap."""
    least = float(np.nanmin(margin)) if np.isfinite(margin).any() else None
    least_allowed = max(BIFURCATION_MARGIN, 0.0 if asked is None else float(asked) - MARGIN_SLACK)
    if snaps:
        return Finding(NO, least, why=f"The robot snaps on the way to frame {snaps[0]}.")
    if least is None or not np.isfinite(margin).all():
        return Finding(NOT_COVERED, least, why="The robot has no equilibrium somewhere.")
    frame = int(margin.min(axis=1).argmin()) + 1
    word = YES if least >= least_allowed else NO
    return Finding(word, least, least - least_allowed, f"The least margin is around frame {frame}.")


def _judge_limits(robot: dict[str, Any], q: Array, dt: float) -> Finding:
    """Return whether all of q (T, 2d + 2) is allowed; the number is the largest part of a rate used, %.

    distance: how much is left to the limit that a motion exceeds by most, or comes nearest to, rad or mm a frame.
    """
    tubes, limits = robot["tubes"], robot["limits"]
    d = len(tubes)
    beta, step = q[:, d : 2 * d], np.diff(q, axis=0)
    beta_limits = limits.get("beta")
    if beta_limits is None:
        straight = [not np.any(tube["curvature"]) for tube in tubes]
        ends = [t["length"] if s else t["curved_length"] for t, s in zip(tubes, straight, strict=True)]
        beta_limits = [(0.0, end) for end in ends]
    pairs = [
        *np.broadcast_to(_read_numbers(limits["alpha"]), (d, 2)),
        *np.broadcast_to(_read_numbers(beta_limits), (d, 2)),
        *np.broadcast_to(_read_numbers(limits["theta"]), (2, 2)),
    ]
    lower, upper = np.array(pairs).T
    left = {
        "range": np.min([q - lower, upper - q]),
        "order of tubes": np.min(np.diff(beta, axis=1), initial=np.inf),
    }
    if limits.get("carriage_gap") is not None:
        gaps = np.diff([tube["length"] for tube in tubes]) - np.diff(beta, axis=1)
        left["gap between carriages"] = np.min(gaps, initial=np.inf) - limits.get("carriage_gap")
    used = 0.0
    for order, name in ((1, "speed"), (2, "acceleration")):
        sizes = (("alpha", d), ("beta", d), ("theta", 2))
        most = [np.broadcast_to(_read_numbers(limits.get(f"{axis}_{name}", np.inf)), size) for axis, size in sizes]
        bound = np.concatenate(most) * dt**order
        change = abs(np.diff(step, n=order - 1, axis=0))
        if change.size:
            left[name] = np.min(bound - change)
            used = max(used, float((change / bound).max()))
    tightest = min(left, key=lambda name: left[name])
    least = float(left[tightest]) + LIMIT_SLACK
    if not np.isfinite(q).all():
        return Finding(NOT_COVERED, why="Frames have no configuration.")
    return Finding(YES if least >= 0 else NO, 100 * used, least, f"The {tightest} comes nearest to its limit.")


def _read_numbers(value: Any) -> Array:
    """Return limits as arrays; files write what is unlimited as text."""
    return np.array(value, dtype=object).astype(float)


def _take_samples(file: PlanFile, count: int) -> tuple[Array, Array] | None:
    """Return differences (n, d, 5) and plays (n, d) of samples: the first in the file, or newly drawn ones.

    None without samples, or where they are under a force or not uniform within their tolerances.
    """
    robot = file.meta["robot"]
    tolerances, d = robot.get("tolerances"), len(robot["tubes"])
    if not count or tolerances is None or tolerances["tip_force"]:
        return None
    if "draws_parts" in file.arrays:
        return file.arrays["draws_parts"][:count], file.arrays["draws_lags"][:count].astype(float)
    others = (tolerances["distribution"] == "normal", tolerances["covariance"] is not None)
    if any(others) or np.any(tolerances["diameter"]):
        return None
    random = np.random.default_rng(0)
    bands = np.stack([np.broadcast_to(tolerances[name], d) for name in DEVIATIONS], axis=1)
    parts = random.uniform(-1, 1, (count, *bands.shape)) * bands
    return parts, random.uniform(0, 1, (count, d)) * tolerances["rotation_lag"]


def _judge_samples(
    found: CheckResult,
    q: Array,
    nominal_tips: Array,
    walls: list[MeasuredWall],
    drawn: tuple[Array, Array],
    settle: Settle | None,
) -> Finding:
    """Move samples through q (T, 2d + 2), fill in how they fare, and return whether enough of them hold.

    nominal_tips (T, d): angles of the nominal robot's tips, rad. drawn: differences and plays of the samples.
    """
    file, contact = found.file, found.sample_contact
    contact[:] = -np.inf if walls else np.nan

    def measure(frame: int, rows: Array, twist: Any, tips: Array) -> None:
        own = nominal_tips[frame] - nominal_tips[frame, -1]
        # Not "more than", so that robots count as lost where the nominal one has no shape to compare with.
        found.lost[rows] |= ~(abs(tips - tips[-1:] - own[:, None]) <= OTHER_BRANCH_RAD).all(axis=0)
        body = compute_body(twist, np.repeat(q[frame, -2:, None], len(rows), axis=1))
        points = body.interpolate(SIGMA * body.s[-1][:, None])
        found.sample_e2[rows, frame] = measure_errors(points, file.arrays["target"][frame])
        found.sample_tips[rows] = points[:, -1]
        for wall in walls:
            depth = find_deepest_contact(wall, body, exactly=False)
            # Only where it may be the deepest of a robot's motion, contact is measured at the triangles.
            question = depth > np.maximum(contact[rows], -MEASURED_MM) - FIELD_ERROR_MM
            if question.any():
                depth[question] = find_deepest_contact(wall, body.select(np.flatnonzero(question)))
            contact[rows] = np.maximum(contact[rows], np.where(question, depth, -MEASURED_MM))

    tubes = read_tubes(file.meta["robot"], drawn[0])
    found.lost[:] |= move_samples(tubes, drawn[1].T, q, measure, SAMPLE_SUBSTEPS, settle) > 0
    found.sample_tips[found.lost] = contact[found.lost] = found.sample_e2[found.lost] = np.nan
    arrived = found.sample_tip <= threshold(file, "arrival_tolerance")
    found.missed[:] = ~found.lost & ~(arrived & (found.findings["arrives"].why != DETOUR))
    found.pressed[:] = ~found.lost & (contact > sample_contact_allowed(file))
    share = float((~(found.lost | found.missed | found.pressed)).mean())
    needed = threshold(file, "share")
    why = f"{found.lost.sum()} of {len(contact)} are lost, {found.missed.sum()} miss, {found.pressed.sum()} press."
    return Finding(YES if share >= needed else NO, share, share - needed, why)


def compute_dominant_shapes(file: PlanFile) -> Array:
    """Return the shapes (T, 101, 3), mm, of a plan's motion on the dominant stiffness model."""
    alpha, beta, theta = (file.arrays[name].T for name in ("alpha", "beta", "theta"))
    tubes = read_tubes(file.meta["robot"]).repeat(alpha.shape[1])
    twist = integrate(tubes, alpha, beta, np.zeros_like(alpha), sensitivities=False)
    body: RobotShape = compute_body(replace_by_dominant(twist, alpha), theta)
    return body.interpolate(SIGMA * beta[-1][:, None])
