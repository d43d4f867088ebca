"""The second opinion on a plan: verdicts from the motion and the equations, and whether the record fits them.

From the file the checker takes data alone: the motion (time, alpha, beta, theta), the targets, the wall, the
numbers of the robot, the samples' differences from it, and which frames were solved. Shapes, margins, clearances
and lost samples it finds by itself: tubes by shooting (tubes.py) and continuation (motions.py), margins from the
energy (stability.py), the wall by nearest points (walls.py). What the file records of the same quantities is then
compared with what was found (records.py).

A motion that begins deployed (a reversed plan, a later part of a plan) begins on the branch, among those that
turning from aligned tubes leads to, whose shape is nearest to the recorded one.

What it cannot check: whether a frame is a KKT point. It counts the frames that are marked as solved, and asks that
their residuals are small enough. A robot under a load, or one that leans on a wall, is not covered.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.check.motions import Follower, find_ways, move_nominal
from ctr_nlp.check.plan_file import PlanFile
from ctr_nlp.check.shapes import compute_body
from ctr_nlp.check.stability import compute_stability_margins
from ctr_nlp.check.tubes import Array, Tubes, integrate, read_tubes
from ctr_nlp.check.walls import measure_clearance

YES, NO, NOT_COVERED = "yes", "no", "not covered"
VERDICTS = "solved", "arrives", "follows", "stable", "within_limits", "within_wall", "holds"
"""Names of the verdicts, those of ``plan.verdicts``."""
SHAPE_VERDICTS = "arrives", "follows", "stable", "within_wall", "holds"
"""Verdicts that depend on the model."""
DEVIATIONS = "curvature", "bending_stiffness", "torsional_ratio", "curved_length", "motor_zero", "rotation_lag"
"""What samples differ in, in the order of the file's ``draws_parts``, and the play of ``draws_lags``."""
THRESHOLDS = {"arrival_tolerance": 2.0, "error_allowed": 2.0, "contact_allowed": 0.5, "stability_margin": 0.1}
THRESHOLDS |= {"share": 0.95}
"""Those of a plan whose options do not name them: mm, the share of samples that must hold, the least margin."""
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
SAMPLE_PART = 0.25
"""Of the way from frame to frame, that samples are moved in one step."""
SIGMA = np.linspace(0, 1, 101)
DETOUR = "The robot arrives, but not along the path."
SAME_SHAPE_MM = 0.01
"""Root mean square distance of shapes on one branch, at most."""
GROUP = 250
"""Shapes that are found at once."""
PLACES_MM = 1.0
"""At most, between the places along a robot whose contact is found."""
SAMPLE_TOLERANCE_MM = 0.15
"""By how much tips, errors and contacts of samples may differ: samples are moved in coarser steps."""


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


def judge(allowed: Any, number: float | None = None, distance: float | None = None, why: str = "") -> Finding:
    """Return the finding yes where something is allowed, and no where it is not."""
    return Finding(YES if allowed else NO, number, distance, why)


@dataclass(eq=False)
class CheckResult:
    """Result of a check: findings by name, and the figures behind them, empty where nothing was found.

    Attributes
    ----------
    file : PlanFile
        What was checked.
    findings : dict of str to Finding
        Seven verdicts under the names of ``plan.verdicts``, and findings on the record (``records.RECORDS``).
    snaps : list of int
        Frames, from 1, on the way to which the robot snaps.
    moved, borderline : int
        Samples that were moved, and those that keep or miss a limit by no more than records may differ.
    shape, e2 : ndarray
        Shapes (T, 101, 3) and errors (T,) on the elastic model, mm; NaN where the robot has no equilibrium.
    margin, clearance : ndarray
        Stability margins (T, 10) and clearance (T, 10, 101), mm, at sub-steps, of which the last is the frame.
    deepest : ndarray
        Deepest contacts (W,) with the walls, mm, negative where the robot is clear of one by that much.
    tip_degrees : float
        Angle between tip and target in the last frame.
    samples : dict of str to ndarray
        Of n simulated robots: ``lost``, ``missed`` and ``pressed`` (n,), whether they snap or change their branch,
        do not arrive, or touch the wall by more than they may; last ``tips`` (n, 3), deepest ``contacts`` (n,),
        -inf without walls, and ``errors`` (n, T), mm, NaN where a sample is lost. Empty where none were moved.
    """

    file: PlanFile
    findings: dict[str, Finding]
    snaps: list[int] = field(default_factory=list)
    moved: int = 0
    borderline: int = 0
    shape: Array = field(default_factory=lambda: np.empty(0))
    e2: Array = field(default_factory=lambda: np.empty(0))
    margin: Array = field(default_factory=lambda: np.empty(0))
    clearance: Array = field(default_factory=lambda: np.empty(0))
    deepest: Array = field(default_factory=lambda: np.empty(0))
    tip_degrees: float = np.nan
    samples: dict[str, Array] = field(default_factory=dict)


def examine_motion(file: PlanFile, samples: int = 0) -> CheckResult:
    """Find the seven verdicts on the motion of a plan.

    Parameters
    ----------
    file : PlanFile
        The plan.
    samples : int
        How many simulated robots are moved: the first ones in the file, or where it has none robots drawn from the
        tolerances.

    Returns
    -------
    CheckResult
        With the verdicts alone.
    """
    why = _find_reason_not_covered(file)
    findings = dict.fromkeys(VERDICTS, Finding(NOT_COVERED, why=why))
    findings |= {"solved": _judge_solved(file), "within_limits": _judge_limits(file)}
    if why:
        return CheckResult(file, findings)
    deployed = file.meta.get("reversed") or is_later_part(file)
    turns = _find_whole_turns(file, file.q[0]) if deployed else np.zeros_like(file.q[0])
    found = measure_motion(file, findings, file.tubes, file.q + turns)
    found.findings.update(_judge_shapes(found))
    drawn, recorded = _take_samples(file, samples), len(file.arrays.get("draws_parts", ()))
    if not samples:
        why = f"The file's {recorded} samples were not simulated." if recorded else "No samples were simulated."
    elif drawn is None:
        why = "Samples under a tip force or of other tolerances than uniform ones."
    elif found.snaps:
        why = "Samples are compared with the robot, which snaps."
    elif turns.any():
        why = "The robot begins on another branch than the one that samples are turned to."
    else:
        return _judge_samples(found, _move_samples(file, *drawn))
    found.findings["holds"] = Finding(NOT_COVERED, why=why)
    return found


def is_later_part(file: PlanFile) -> bool:
    """Return whether a plan is a later part of another one, so that the way to its first frame is not known."""
    return bool(file.meta.get("stretch", {}).get("first", 1) > 1)


def _find_reason_not_covered(file: PlanFile) -> str:
    """Return why the equations do not describe the motion of a plan; empty where they do."""
    beta = file.arrays["beta"]
    if not np.isfinite(file.q).all():
        return "Frames have no configuration."
    if min(beta.min(), (file.tubes.length.T - beta).min(), np.diff(beta).min(initial=0.0)) < -LIMIT_SLACK:
        return "Tubes are further out than they are long, or out of order."
    if file.meta.get("load", file.meta.get("planned_load")) is not None:
        return "The robot is under a load, which the checker's equations do not have."
    if "wall_contact" in file.meta:
        return "The robot leans on a wall that gives, whose forces the checker's equations do not have."
    return ""


def _find_whole_turns(file: PlanFile, q: Array) -> Array:
    """Return the whole turns (2d + 2,), rad, added to q (2d + 2,) by which a robot is turned to a recorded shape.

    Tubes that are turned there from alignment by a whole turn more or less may be on another branch. Of those that
    do not snap on the way, the one counts whose shape is nearest to that of the first frame.
    """
    d = len(file.tubes.zero)
    turns = 2 * np.pi * np.array([(*each, 0) for each in itertools.product((0, -1, 1), repeat=d - 1)]).T
    follower = Follower(file.tubes.repeat(turns.shape[1]))
    ways = find_ways(q[None], turns.shape[1])
    ways[1, :d] += turns
    list(follower.move(ways, longest=0.05))
    rows = np.flatnonzero(~follower.snapped)
    if not len(rows):
        return np.zeros_like(q)
    body = compute_body(follower.twist(rows), np.repeat(q[-2:, None], len(rows), axis=1))
    away = np.nan_to_num(measure_errors(body.interpolate(SIGMA), file.arrays["shape"][0]))
    nearest = np.flatnonzero(away <= away.min() + SAME_SHAPE_MM)[0]  # no turns where these lead there as well
    return np.concatenate([turns[:, rows[nearest]], np.zeros(d + 2)])


def measure_motion(file: PlanFile, findings: dict[str, Finding], tubes: Tubes, q: Array) -> CheckResult:
    """Return a result with what is found of tubes that move through q (T, 2d + 2), without verdicts on it."""
    walls, d = file.walls, len(tubes.zero)
    places, rates, snaps = move_nominal(tubes, q)
    known = np.isfinite(rates).all(axis=-1)
    points, tips = np.full((*known.shape, len(SIGMA), 3), np.nan), np.full((*known.shape, 3), np.nan)
    margin, clearance = np.full(known.shape, np.nan), np.full(points.shape[:-1], np.nan)
    deepest = np.full(len(walls), -np.inf)
    frames, steps = np.nonzero(known)
    for first in range(0, len(frames), GROUP):
        chosen = frames[first : first + GROUP], steps[first : first + GROUP]
        alpha, beta, theta = np.split(places[chosen].T, [d, 2 * d])
        twist = integrate(tubes.repeat(len(beta[0])), alpha, beta, rates[chosen].T, sensitivities=False)
        body = compute_body(twist, theta)
        points[chosen], tips[chosen] = body.interpolate(SIGMA), body.tangents[-1]
        if np.isfinite(tubes.torsional).all():  # others do not twist, so that they have no margin
            margin[chosen] = compute_stability_margins(twist)
        # Where an outer tube ends between two points, the first of them has the least of itself and that end.
        ends, radius = (beta[:-1] / beta[-1]).T, twist.tubes.radius
        before = np.minimum((ends * (len(SIGMA) - 1) + 1e-9).astype(int), len(SIGMA) - 2)
        along = np.concatenate([points[chosen], body.interpolate(ends)], axis=1)
        clear = measure_clearance(walls, along, np.hstack([find_radius(beta, radius), radius[:-1].T]))
        np.minimum.at(clear, (np.arange(len(clear))[:, None], before), clear[:, len(SIGMA) :])
        clearance[chosen] = clear[:, : len(SIGMA)]
        for k, wall in enumerate(walls):
            clear = measure_clearance([wall], *body.find_places(PLACES_MM), known=-deepest[k])
            deepest[k] = max(deepest[k], -clear.min())
    shape, tip, wanted = points[:, -1], tips[-1, -1], file.arrays["target_direction"][-1]
    degrees = float(np.degrees(np.arctan2(np.linalg.norm(np.cross(tip, wanted)), tip @ wanted)))
    e2 = measure_errors(shape, file.arrays["target"])
    return CheckResult(file, findings, snaps, 0, 0, shape, e2, margin, clearance, deepest, degrees)


def find_radius(beta: Array, radius: Array) -> Array:
    """Return the radius (n, 101), mm, of the outermost tube at uniform sigma.

    beta, radius (d, n): extensions and radii of tubes, mm.
    """
    outermost = (SIGMA * beta[-1][:, None] > beta[:-1, :, None] + 1e-9).sum(axis=0)
    return np.take_along_axis(radius.T, outermost, axis=1)


def measure_errors(shape: Array, target: Array) -> Array:
    """Return e2 (..,), mm: the root mean square distance of shapes (.., 101, 3) from targets, by trapezoids."""
    weights = np.ones(len(SIGMA))
    weights[[0, -1]] = 0.5
    return np.asarray(np.sqrt(((shape - target) ** 2).sum(axis=-1) @ weights / weights.sum()))


def threshold(file: PlanFile, name: str) -> float:
    """Return a threshold among the options of a plan, or its default; 0 where the option asks for none."""
    return float(file.meta.get("options", {}).get(name, THRESHOLDS[name]) or 0.0)


def _judge_shapes(found: CheckResult) -> dict[str, Finding]:
    """Return the verdicts on shapes and margins."""
    file, target = found.file, found.file.arrays["target"][-1]
    tip = float(np.linalg.norm(found.shape[-1, -1] - target[-1]))
    arrives = _judge_at_most(tip, threshold(file, "arrival_tolerance"), "mm from the target's end")
    length = float(np.linalg.norm(np.diff(target, axis=0), axis=1).sum())
    detour_mm = max(0.1 * length, 5.0)
    short = length - float(file.arrays["beta"][-1, -1])
    detour = found.tip_degrees > 90 or max(short, found.e2[-1]) > detour_mm
    if arrives.word == YES and detour and threshold(file, "arrival_tolerance") <= detour_mm:
        arrives = arrives._replace(word=NO, why=DETOUR)
    unit = "mm e2" + (f" in frame {found.e2.argmax() + 1}" if np.isfinite(found.e2).all() else "")
    return {
        "arrives": arrives,
        "follows": _judge_at_most(float(found.e2.max()), threshold(file, "error_allowed"), unit),
        "stable": _judge_stability(found.margin, found.snaps, threshold(file, "stability_margin")),
        "within_wall": _judge_contact(found),
    }


def _judge_at_most(number: float, allowed: float, unit: str) -> Finding:
    """Return yes where a number is at most what is allowed; a NaN is not covered."""
    if not np.isfinite(number):
        return Finding(NOT_COVERED, why="The robot snaps before, or has no equilibrium.")
    return judge(number <= allowed, number, allowed - number, f"{number:.3g} {unit}; {allowed:g} mm is allowed")


def _judge_contact(found: CheckResult) -> Finding:
    """Return whether the deepest contact with each wall is allowed, by the wall that leaves least."""
    if not found.file.walls:
        return Finding(NOT_COVERED, why="The file has no wall.")
    # Tissue around a lumen gives a little; what is to be kept out of is not to be touched.
    given = threshold(found.file, "contact_allowed")
    allowed = np.array([0.0 if wall.kept_out else given for wall in found.file.walls])
    first = (found.deepest - allowed).argmax()
    depth = float(found.deepest[first]) if np.isfinite(found.clearance).all() else np.nan
    within = _judge_at_most(depth, float(allowed[first]), "mm of contact")
    if depth < 0:
        # Contact is never negative; what is left to the wall has words of its own.
        why = f"no contact, {-depth:.2g} mm clear; {allowed[first]:g} mm of contact is allowed"
        within = within._replace(number=0.0, why=why)
    return within


def _judge_solved(file: PlanFile) -> Finding:
    """Return whether all frames are marked as solved, with small residuals."""
    success, kkt = file.arrays["success"], file.arrays["kkt"]
    interpolated = len(file.meta.get("interpolated", []))
    number = float((success & (kkt <= MAX_KKT_MM2)).sum())
    if (~success).sum() > interpolated or (success & (kkt > MAX_KKT_MM2)).any():
        return Finding(NO, number, why="Frames are not solved, or their KKT residual is large.")
    if interpolated or np.isnan(kkt).any():
        return Finding(NOT_COVERED, number, why="Frames have no KKT residual: no program solved them.")
    return Finding(YES, number, why="All frames are marked as solved, with small KKT residuals.")


def _judge_stability(margin: Array, snaps: list[int], asked: float) -> Finding:
    """Return whether a robot keeps the margin asked for at (T, 10) places of a motion, and does not snap."""
    least = float(np.nanmin(margin)) if np.isfinite(margin).any() else None
    if snaps or least is None:
        return Finding(NO, least, why=f"The robot snaps on the way to frame {snaps[0]}.")
    left = least - max(BIFURCATION_MARGIN, asked - MARGIN_SLACK)
    frame = margin.min(axis=1).argmin() + 1
    return judge(left >= 0, least, left, f"The least margin is around frame {frame}.")


def _judge_limits(file: PlanFile) -> Finding:
    """Return whether positions and steps of a motion are allowed; the number is the largest part of a rate, %.

    distance: how much is left to the limit that a motion exceeds by most, or comes nearest to, rad or mm a frame.
    """
    tubes, limits = (file.meta["robot"][name] for name in ("tubes", "limits"))
    q, d, dt = file.q, len(tubes), float(file.arrays["time"][0])
    if not np.isfinite(q).all():
        return Finding(NOT_COVERED, why="Frames have no configuration.")
    ends = [(0.0, tube["curved_length" if np.any(tube["curvature"]) else "length"]) for tube in tubes]
    limits = limits | {"beta": limits.get("beta") or ends}

    def read_limits(name: str, *columns: int) -> Array:
        """Limits of alpha, beta and theta (2d + 2, ..); what is unlimited is written as text."""
        axes = ("alpha", d), ("beta", d), ("theta", 2)
        given = [(np.array(limits.get(axis + name, "inf"), dtype=object), count) for axis, count in axes]
        return np.concatenate([np.broadcast_to(x, (n, *columns)) for x, n in given]).astype(float)

    lower, upper = read_limits("", 2).T
    growth = np.diff(q[:, d : 2 * d], axis=1)
    gaps = np.diff([tube["length"] for tube in tubes]) - growth
    outer, inner = (np.array([tube[f"{side}_diameter"] for tube in tubes]) for side in ("outer", "inner"))
    gap = limits.get("carriage_gap")
    left = {"range": np.minimum(q - lower, upper - q), "order of tubes": growth}
    left |= {"fit of tubes in each other": inner[:-1] - outer[1:]}
    left |= {"gap between carriages": gaps - (-np.inf if gap is None else gap)}
    used = 0.0
    for order, name in enumerate(("speed", "acceleration"), 1):
        bound, change = read_limits(f"_{name}") * dt**order, abs(np.diff(q, n=order, axis=0))
        left[name] = bound - change
        used = max(used, float((change / bound).max(initial=0.0)))
    least, tightest = min((float(values.min(initial=np.inf)), name) for name, values in left.items())
    least += LIMIT_SLACK
    return judge(least >= 0, 100 * used, least, f"The {tightest} comes nearest to its limit.")


def _take_samples(file: PlanFile, count: int) -> tuple[Array, Array] | None:
    """Return differences (n, d, 5) and plays (n, d) of samples: the first in the file, or newly drawn ones.

    None without samples, or where they are under a force or not uniform within their tolerances.
    """
    tolerances, d = file.meta["robot"].get("tolerances"), len(file.meta["robot"]["tubes"])
    if not count or tolerances is None or tolerances["tip_force"]:
        return None
    if "draws_parts" in file.arrays:
        return file.arrays["draws_parts"][:count], file.arrays["draws_lags"][:count].astype(float)
    uniform = tolerances["distribution"] != "normal" and tolerances["covariance"] is None
    if not uniform or np.any(tolerances["diameter"]):
        return None
    random = np.random.default_rng(0)
    drawn = random.uniform(-1, 1, (count, d, len(DEVIATIONS))) * read_bands(tolerances, d)
    return drawn[..., :-1], abs(drawn[..., -1])


def read_bands(tolerances: dict[str, Any], d: int) -> Array:
    """Return half the widths (d, 6) of the bands of tolerances, in the order of `DEVIATIONS`."""
    return np.stack([np.broadcast_to(tolerances[name], d) for name in DEVIATIONS], axis=1)


def _move_samples(file: PlanFile, parts: Array, lags: Array) -> dict[str, Array]:
    """Return how samples fare that are moved through a plan, as ``CheckResult.samples`` before they are judged.

    parts, lags: differences (n, d, 5) and plays (n, d) of the samples.
    """
    q = file.q
    # The robot as described comes first: the others are compared with it, and it is left out of what is returned.
    parts, lags = (np.concatenate([np.zeros_like(each[:1]), each]) for each in (parts, lags))
    count, robots = len(parts), read_tubes(file.meta["robot"], parts)
    lost, contacts = np.zeros(count, dtype=bool), np.full(count, -np.inf)
    tips, errors = np.full((count, 3), np.nan), np.full((count, len(q)), np.nan)
    follower = Follower(robots, q[0, len(robots.zero) - 1], lags.T)
    for frame in follower.move(find_ways(q, count), SAMPLE_PART):
        rows = np.flatnonzero(~follower.snapped)
        apart = follower.angles - follower.angles[:, :1]
        lost |= (abs(apart - apart[-1:]) > OTHER_BRANCH_RAD).any(axis=0)
        body = compute_body(follower.twist(rows), np.repeat(q[frame, -2:, None], len(rows), axis=1))
        points = body.interpolate(SIGMA)
        errors[rows, frame], tips[rows] = measure_errors(points, file.arrays["target"][frame]), points[:, -1]
        clear = measure_clearance(file.walls, *body.find_places(PLACES_MM), known=-contacts[rows, None])
        contacts[rows] = np.maximum(contacts[rows], -clear.min(axis=1))
    lost |= follower.snapped
    tips[lost] = contacts[lost] = errors[lost] = np.nan
    return {"lost": lost[1:], "tips": tips[1:], "contacts": contacts[1:], "errors": errors[1:]}


def _judge_samples(found: CheckResult, samples: dict[str, Array]) -> CheckResult:
    """Return a result with samples that were moved: which of them fail, and whether enough of them hold."""
    file, kept = found.file, ~samples["lost"]
    away = np.linalg.norm(samples["tips"] - file.arrays["target"][-1, -1], axis=-1)
    arrival = threshold(file, "arrival_tolerance")
    press = max(SAMPLE_CONTACT_MM, threshold(file, "contact_allowed"))
    missed = kept & (~(away <= arrival) | (found.findings["arrives"].why == DETOUR))
    samples = samples | {"missed": missed, "pressed": kept & (samples["contacts"] > press)}
    near = np.minimum(abs(away - arrival), abs(np.nan_to_num(samples["contacts"]) - press)) <= SAMPLE_TOLERANCE_MM
    failed = [samples[name] for name in ("lost", "missed", "pressed")]
    share, needed = float((~np.any(failed, axis=0)).mean()), threshold(file, "share")
    lost, missing, pressing = (flags.sum() for flags in failed)
    why = f"{lost} of {len(kept)} are lost, {missing} miss, {pressing} press."
    findings = found.findings | {"holds": judge(share >= needed, share, share - needed, why)}
    borderline = int((kept & near).sum())
    return replace(found, findings=findings, moved=len(kept), borderline=borderline, samples=samples)
