"""Whether what a plan's file records fits its motion: digest, times, axes, shapes, margins, samples."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ctr_nlp.check import checker
from ctr_nlp.check.checker import NO, NOT_COVERED, SAMPLE_TOLERANCE_MM, CheckResult, Finding, judge
from ctr_nlp.check.motions import Settle
from ctr_nlp.check.plan_file import CheckError, PlanFile, read_plan_file
from ctr_nlp.check.tubes import Array
from ctr_nlp.check.walls import FIELD_ERROR_MM, FieldWall, LumenWall, measure_clearance

CLEARANCE_TOLERANCE_MM = 0.1
"""By how much recorded clearances may differ from those found, and points of the source from the lumen's path."""
TOLERANCES = {
    "shapes": (0.05, 0.0, " mm"),
    "margins": (0.002, 0.005, ""),
    "clearances": (CLEARANCE_TOLERANCE_MM, 0.0, " mm"),
}
"""By how much recorded values may differ from those found, the part of a value by which they may besides, unit."""
SAMPLE_SHARE = 0.02
"""Part of the samples, at least one, whose outcome may differ: near a fold it depends on the size of the steps."""
SAME_TIME = 1e-6
"""Part of the duration by which times may differ."""
BODY_TOLERANCE_MM = 1.0
"""By how much a path may leave the surface of a mask, whose voxels are about so large."""
DEEP_MM = 5.0
"""Contact beyond which clearances are not compared: the nearest place of the path is not unique there."""
NEAR_BIFURCATION = 0.01
"""A stability margin: from the first frame below it, the size of steps may decide on the branch."""
FALSE_ALARM = 1e-6
"""Probability that samples of the recorded tolerances fill their bands as little as they are found to."""
RECORDS = "digest", "times", "frames_of_reference", "shapes", "margins", "clearances", "samples", "tolerances"
"""Names of the findings on the record."""


def check_plan(
    path: str | Path, samples: int = 0, source: str | Path | None = None, settle: Settle | None = None
) -> CheckResult:
    """Check a plan's file: seven verdicts on its motion, and whether its record fits it.

    Parameters
    ----------
    path : str or Path
        A plan.npz.
    samples : int
        How many simulated robots are moved; 0 for none.
    source : str or Path, optional
        The centreline that the plan was made for, a table with the columns x_mm, y_mm and z_mm or a markups file
        of 3D Slicer, in the axes that ``to_robot`` maps from. Without it, these axes cannot be checked.
    settle : callable, optional
        Finds where a robot comes to rest after a snap. Without it, what follows a snap is not covered.

    Returns
    -------
    CheckResult
        Findings under the names of the seven verdicts and of `RECORDS`.

    Raises
    ------
    CheckError
        A file cannot be read, or is no plan.

    Examples
    --------
    >>> from ctr_nlp.check.records import CheckError, check_plan
    >>> try:
    ...     check_plan("missing.npz")
    ... except CheckError as error:
    ...     print("cannot be read" in str(error))
    True
    """
    file = read_plan_file(path)
    try:
        found = checker.examine_motion(file, samples, settle)
        recorded = [_check_digest(file), _check_times(file), _check_frames_of_reference(file, source)]
        recorded += [*_check_motion(found), _check_samples(found), _check_tolerances(file)]
    except (AttributeError, LookupError, TypeError, ValueError, ZeroDivisionError) as error:
        if isinstance(error, CheckError):
            raise
        raise CheckError(f"{path} is damaged, or no plan: {type(error).__name__}, {error}") from error
    found.findings.update(zip(RECORDS, recorded, strict=True))
    return found


def _check_digest(file: PlanFile) -> Finding:
    """Return whether the file's content is what its digest was computed of."""
    if file.digest is None:
        return Finding(NOT_COVERED, why="The file has no digest.")
    return judge(file.digest == file.content_digest, why=f"SHA-256 {file.content_digest[:12]}")


def _check_times(file: PlanFile) -> Finding:
    """Return whether frames are evenly spaced in time, and end after the duration of the problem."""
    time, problem, duration = file.arrays["time"], file.meta["problem"], file.meta["problem"].get("duration")
    uneven = float(abs(np.diff(time, prepend=0.0) - time[0]).max())
    if not uneven <= SAME_TIME * time[-1]:
        return Finding(NO, uneven, why="Frames are not evenly spaced in time.")
    if duration is None:
        return Finding(NOT_COVERED, why="The file has no duration of the problem.")
    late = float(time[-1] - duration)
    in_time = abs(late) <= SAME_TIME * time[-1] and problem.get("frames", len(time)) == len(time)
    return judge(in_time, late, why=f"{len(time)} frames end at {time[-1]:g} s; the problem takes {duration:g} s.")


def _check_frames_of_reference(file: PlanFile, source: str | Path | None) -> Finding:
    """Return whether targets, wall and source are in one frame of reference, and it is a rigid one."""
    arrays, problem = file.arrays, file.meta["problem"]
    # Earlier targets of a resampled plan are interpolated, and leave the path by a little.
    turn, target = arrays["to_robot"][:3, :3], arrays["target"][-1]
    mirrored = problem.get("space") == "LAS"  # axes of images that turn the other way round
    if abs(turn @ turn.T - np.eye(3)).max() > 1e-6 or (np.linalg.det(turn) < 0) != mirrored:
        return Finding(NO, float(np.linalg.det(turn)), why="to_robot scales or mirrors the axes of the file.")
    allowed = max(CLEARANCE_TOLERANCE_MM, 2 * float(problem.get("deviation") or 0.0))
    if "lumen" in arrays and "lumen_radius" in arrays:
        # On the path, the distance to the wall is the radius.
        off = float(abs(LumenWall(arrays["lumen"]).left(target) - arrays["lumen_radius"][-1]).max())
        if off > allowed:
            return Finding(NO, off, why=f"Targets are off the lumen's path, or radii differ, by {off:.2f} mm.")
    inside = [wall for wall in file.walls if not wall.kept_out]
    outside = max([-float(wall.left_exactly(target).min()) for wall in inside], default=0.0)
    if outside > max(allowed, BODY_TOLERANCE_MM if any(isinstance(wall, FieldWall) for wall in inside) else 0.0):
        return Finding(NO, outside, why=f"Targets are {outside:.2f} mm outside of the wall.")
    if source is None:
        return Finding(NOT_COVERED, why="Axes of the centreline's file; give it to have them checked.")
    points = _read_source(Path(source)) @ turn.T + arrays["to_robot"][:3, 3]
    spacing = float(np.linalg.norm(np.diff(points, axis=0), axis=1).max())
    off = float(-LumenWall(np.pad(points, ((0, 0), (0, 1)))).left(target).min())
    # Targets are curves through the points, which leave the lines between them by h^2 / (8 R), R at least 12 mm.
    why = f"The target is {off:.2f} mm from the points of {Path(source).name}."
    return judge(off <= allowed + spacing**2 / 96, off, why=why)


def _read_source(path: Path) -> Array:
    """Return the points (N, 3), mm, of a table with a header or a markups file of 3D Slicer, in its axes."""
    try:
        if path.suffix == ".json":
            points = json.loads(path.read_text(encoding="utf-8"))["markups"][0]["controlPoints"]
            return np.array([point["position"] for point in points], dtype=float)
        table = np.genfromtxt(path, delimiter=",", names=True)
        return np.column_stack([table[name] for name in ("x_mm", "y_mm", "z_mm")])
    except (OSError, LookupError, TypeError, ValueError) as error:
        wanted = "give a table with the columns x_mm, y_mm and z_mm, or a .mrk.json"
        raise CheckError(f"{path} cannot be read as a centreline: {error}; {wanted}") from error


def _compare(name: str, recorded: Array, found: Array) -> Finding:
    """Return whether recorded values are those found, within their tolerance; frames are the first axis."""
    tolerance, relative, unit = TOLERANCES[name]
    known = np.isfinite(found)
    if not known.any():
        return Finding(NOT_COVERED, why=f"No {name} were found to compare with.")
    # A recorded value that is missing where one was found is as far off as can be.
    away = np.where(known, np.nan_to_num(abs(recorded - found), nan=np.inf), 0.0)
    allowed = tolerance + relative * np.where(known, abs(found), 0.0)
    worst = np.unravel_index(int((away - allowed).argmax()), away.shape)
    largest, most = float(away[worst]), float(allowed[worst])
    frame = worst[0] + 1
    why = f"Recorded {name} differ by {largest:.3g}{unit}, most in frame {frame}; {most:.2g}{unit} is allowed."
    return judge(largest <= most, largest, most - largest, why)


def _check_motion(found: CheckResult) -> tuple[Finding, Finding, Finding]:
    """Return whether recorded shapes, margins and clearances are those of the motion."""
    arrays, evaluated = found.file.arrays, str(found.file.meta.get("evaluated", found.file.meta["model"]))
    why = "" if np.isfinite(found.margin).any() else found.findings["stable"].why
    shapes_on = {"elastic": lambda: found.shape, "dominant": lambda: checker.compute_dominant_shapes(found.file)}
    if evaluated not in shapes_on:
        why = f"The checker does not know the model {evaluated}."
    if why:
        return (Finding(NOT_COVERED, why=why),) * 3
    shape = shapes_on[evaluated]()
    margins = Finding(NOT_COVERED, why="The plan was evaluated on a model without margins.")
    if np.isfinite(arrays["stability"]).any():
        # Beyond the first bifurcation, chance decides where the robot goes on.
        near = np.flatnonzero(~(found.margin > NEAR_BIFURCATION).all(axis=1))
        first = min([len(shape), *near[:1], *(frame - 1 for frame in found.snaps)])
        shape = np.where(np.arange(len(shape))[:, None, None] < first, shape, np.nan)
        own = np.stack([found.margin[:, -1], find_least_on_way(found.file, found.margin)], axis=1)
        recorded = np.stack([arrays[name] for name in ("stability", "stability_between")], axis=1)
        margins = _compare("margins", recorded[:first], own[:first])
    return _compare("shapes", arrays["shape"], shape), margins, _check_clearances(found, shape)


def find_least_on_way(file: PlanFile, values: Array) -> Array:
    """Return the least (T, ..) of values (T, 10, ..) at sub-steps of the way to each frame, as plans record it."""
    if file.meta.get("reversed"):
        # The motion was planned forwards: the sub-steps between two frames include the later one, here the first.
        flat = values.reshape(-1, *values.shape[2:])
        values = np.concatenate([flat[:1], flat[:-1]]).reshape(values.shape)
    least = values.min(axis=1)
    if checker.is_later_part(file):
        least[0] = np.nan
    return least


def _check_clearances(found: CheckResult, shape: Array) -> Finding:
    """Return whether recorded clearances are those of shapes (T, 101, 3), mm, and of the way between frames."""
    arrays, walls = found.file.arrays, found.file.walls
    if not walls or "clearance" not in arrays:
        why = "The file has a wall, and no clearances." if walls else "The file has no wall."
        return Finding(NO if walls or "clearance" in arrays else NOT_COVERED, why=why)
    radius = checker.find_radius(arrays["beta"].T, found.file.tubes.repeat(len(shape)).radius)
    known = np.isfinite(shape).all(axis=(1, 2))
    own = np.full((len(shape), 2, shape.shape[1]), np.nan)
    own[known, 0] = measure_clearance(walls, shape[known], radius[known])
    recorded = np.stack([arrays["clearance"], arrays.get("clearance_between", arrays["clearance"])], axis=1)
    if np.isfinite(arrays["stability"]).any() and "clearance_between" in arrays:
        own[known, 1] = find_least_on_way(found.file, found.clearance)[known]
    # Deep in the wall the nearest place of the path may be another one.
    own[own < -DEEP_MM] = np.nan
    # Plans measure at the triangles where a point may be the nearest of its frame, elsewhere in the smooth field.
    least = np.nanmin(np.where(np.isnan(own), np.inf, own), axis=2, keepdims=True)
    aside = (own > least + CLEARANCE_TOLERANCE_MM) & (abs(own - recorded) < FIELD_ERROR_MM)
    own = np.where(aside & (recorded > least), recorded, own)
    return _compare("clearances", recorded, own)


def _check_samples(found: CheckResult) -> Finding:
    """Return whether the recorded results of samples are those found."""
    arrays, count = found.file.arrays, found.moved
    if not count or "draws_parts" not in arrays:
        return Finding(NOT_COVERED, why=found.findings["holds"].why or "No recorded samples were moved.")
    lost, recorded = found.samples["lost"], arrays["draws_lost"][:count] > 0
    contacts = np.maximum(found.samples["contacts"], 0.0) - np.maximum(-arrays["draws_clearance"][:count], 0.0)
    apart = {
        "tips": np.linalg.norm(found.samples["tips"] - arrays["draws_cloud"][-1, :count, -1], axis=-1),
        # Without a wall, contacts are NaN on both sides.
        "contacts": np.where(np.isnan(arrays["draws_clearance"][:count]), 0.0, abs(contacts)),
        "errors": abs(found.samples["errors"] - arrays["draws_e2"][:count]).max(axis=1),
    }
    wrong = {name: ~(lost | recorded) & ~(values <= SAMPLE_TOLERANCE_MM) for name, values in apart.items()}
    off = np.any([lost != recorded, *wrong.values()], axis=0)
    reasons = [f"{(lost != recorded).sum()} are lost in one view only"] * bool((lost != recorded).any())
    reasons += [f"{name} of {flags.sum()} differ" for name, flags in wrong.items() if flags.any()]
    why = f"{off.sum()} of {count} samples differ" + (f": {', '.join(reasons)}." if reasons else ".")
    return judge(off.sum() <= max(1, int(SAMPLE_SHARE * count)), float(off.sum()), why=why)


def _check_tolerances(file: PlanFile) -> Finding:
    """Return whether the samples' differences from the robot are those of its tolerances."""
    tolerances, d = file.meta["robot"].get("tolerances"), len(file.meta["robot"]["tubes"])
    if "draws_parts" not in file.arrays or tolerances is None:
        return Finding(NOT_COVERED, why="The file has no samples.")
    parts = np.concatenate([file.arrays["draws_parts"], file.arrays["draws_lags"][..., None]], axis=2)
    bands, largest = checker.read_bands(tolerances, d), abs(parts).max(axis=0)
    # Uniform samples stay within their bands, and the largest of n is less than a part x of a band with
    # probability x^n.
    wrong = (largest > bands * (1 + 1e-9)) | (largest < bands * FALSE_ALARM ** (1 / len(parts)))
    # Diameters change the stiffness, too.
    wrong[:, 1] &= ~(np.broadcast_to(tolerances["diameter"], d) > 0)
    if tolerances["covariance"] is not None or tolerances["distribution"] == "normal":
        variance = bands[:, :-1] ** 2 / 3
        if tolerances["covariance"] is not None:
            variance = np.diag(np.array(tolerances["covariance"])).reshape(d, -1)
        ratio = (parts[..., :-1] ** 2).mean(axis=0) / np.where(variance > 0, variance, np.nan)
        spread = 6 * np.sqrt(2 / len(parts))
        wrong[:, :-1] = (abs(ratio - 1) > spread) | ((variance <= 0) & (largest[:, :-1] > 0))
    names = [name for name, bad in zip(checker.DEVIATIONS, wrong.any(axis=0), strict=True) if bad]
    why = f"Samples do not have the tolerances of {', '.join(names)}." if names else "Samples fill the tolerances."
    return judge(not names, float(len(names)), why=why)
