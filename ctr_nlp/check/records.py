"""Whether what a plan's file records fits its motion: digest, times, axes, shapes, margins, samples."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ctr_nlp.check import checker
from ctr_nlp.check.checker import NO, NOT_COVERED, SAMPLE_TOLERANCE_MM, YES, CheckResult, Finding, judge
from ctr_nlp.check.plan_file import CheckError, PlanFile, read_plan_file
from ctr_nlp.check.tubes import Array, make_dominant
from ctr_nlp.check.walls import FIELD_ERROR_MM, FieldWall, LumenWall

CLEARANCE_TOLERANCE_MM = 0.1
"""By how much recorded clearances may differ from those found, and points of the source from the lumen's path."""
SHAPE_TOLERANCE_MM = 0.05
"""By how much points of recorded shapes may differ from those found."""
MARGIN_TOLERANCE, MARGIN_TOLERANCE_PART = 0.002, 0.005
"""By how much recorded margins may differ from those found, and the part of a margin by which they may besides."""
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
TWISTING = {"elastic": True, "dominant": False}
"""Models that the checker knows, and whether their tubes twist."""
RECORDS = "digest", "times", "frames_of_reference", "shapes", "margins", "clearances", "samples", "tolerances"
"""Names of the findings on the record."""


def check_plan(path: str | Path, samples: int = 0, source: str | Path | None = None) -> CheckResult:
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
        found = checker.examine_motion(file, samples)
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
    time, problem = file.arrays["time"], file.meta["problem"]
    duration = problem.get("duration")
    end = float(time[-1] if duration is None else duration)
    away = float(abs(time - np.linspace(0, end, len(time) + 1)[1:]).max())
    fits = away <= SAME_TIME * end and problem.get("frames", len(time)) == len(time)
    if fits and duration is None:
        return Finding(NOT_COVERED, why="The file has no duration of the problem.")
    why = f"{len(time)} frames are {away:.3g} s at most from where they are even; the problem takes {end:g} s."
    return judge(fits, away, why=why)


def _check_frames_of_reference(file: PlanFile, source: str | Path | None) -> Finding:
    """Return whether targets, wall and source are in one frame of reference, and it is a rigid one."""
    arrays, problem = file.arrays, file.meta["problem"]
    # Earlier targets of a resampled plan are interpolated, and leave the path by a little.
    turn, target = arrays["to_robot"][:3, :3], arrays["target"][-1]
    mirrored = problem.get("space") == "LAS"  # axes of images that turn the other way round
    if abs(turn @ turn.T - np.eye(3)).max() > 1e-6 or (np.linalg.det(turn) < 0) != mirrored:
        return Finding(NO, float(np.linalg.det(turn)), why="to_robot scales or mirrors the axes of the file.")
    allowed = max(CLEARANCE_TOLERANCE_MM, 2 * float(problem.get("deviation") or 0.0))
    off = {}  # by which targets are further away than they may be, mm
    if "lumen" in arrays:
        # On the path, the distance to the wall is the radius; of targets without radii, it is positive.
        left = LumenWall(arrays["lumen"]).left(target)
        wanted = arrays["lumen_radius"][-1] if "lumen_radius" in arrays else np.maximum(left, 0.0)
        off["are off the lumen's path, or radii differ"] = abs(left - wanted).max() - allowed
    for wall in file.walls:
        if isinstance(wall, FieldWall) and not wall.kept_out:
            beyond = -wall.left_exactly(target).min()
            off["are outside of the wall"] = beyond - max(allowed, BODY_TOLERANCE_MM)
    if source is not None:
        points = _read_source(Path(source)) @ turn.T + arrays["to_robot"][:3, 3]
        spacing = np.linalg.norm(np.diff(points, axis=0), axis=1).max()
        away = -LumenWall(np.pad(points, ((0, 0), (0, 1)))).left(target).min()
        # Targets are curves through the points, which leave the lines between them by h^2 / (8 R), R >= 12 mm.
        off[f"are off the points of {Path(source).name}"] = away - allowed - spacing**2 / 96
    what, most = max(off.items(), key=lambda item: item[1], default=("", 0.0))
    if most > 0:
        return Finding(NO, float(most), why=f"Targets {what} by {most:.2f} mm more than they may.")
    if source is None:
        return Finding(NOT_COVERED, why="Axes of the centreline's file; give it to have them checked.")
    return Finding(YES, float(most), why="Targets lie on the points of the centreline's file.")


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


def _compare(name: str, recorded: Array, found: Array, allowed: Array | float, unit: str = "") -> Finding:
    """Return whether recorded values are those found, within what is allowed; frames are the first axis."""
    known = np.isfinite(found)
    if not known.any():
        return Finding(NOT_COVERED, why=f"No {name} were found to compare with.")
    # A recorded value that is missing where one was found is as far off as can be.
    away = np.nan_to_num(abs(recorded - found), nan=np.inf)[known]
    most = np.broadcast_to(allowed, found.shape)[known]
    worst = int((away - most).argmax())
    why = f"Recorded {name} differ by {away[worst]:.3g}{unit}, most in frame {np.nonzero(known)[0][worst] + 1}; "
    why += f"{most[worst]:.2g}{unit} is allowed."
    return judge(away[worst] <= most[worst], float(away[worst]), float(most[worst] - away[worst]), why)


def _check_motion(found: CheckResult) -> tuple[Finding, Finding, Finding]:
    """Return whether recorded shapes, margins and clearances are those of the motion."""
    file, arrays = found.file, found.file.arrays
    model = str(file.meta.get("evaluated", file.meta["model"]))
    why = "" if np.isfinite(found.margin).any() else found.findings["stable"].why
    if model not in TWISTING:
        why = f"The checker does not know the model {model}."
    if why:
        return (Finding(NOT_COVERED, why=why),) * 3
    if not TWISTING[model]:
        found = checker.measure_motion(file, {}, make_dominant(file.tubes), file.q)
    # From the first bifurcation or snap on, chance decides where the robot goes.
    known = np.logical_and.accumulate(np.isfinite(found.e2) & ~(found.margin <= NEAR_BIFURCATION).any(axis=1))

    def compare_both(name: str, values: Array) -> tuple[Array, Array]:
        """Recorded and found values (T, 2, ..) in frames, and the least on the way there."""
        own = np.stack([values[:, -1], find_least_on_way(file, values)], axis=1)
        own[~known] = np.nan
        # Older files have no clearances between frames.
        return np.stack([arrays[name], arrays.get(f"{name}_between", own[:, 1])], axis=1), own

    shape = np.where(known[:, None, None], found.shape, np.nan)
    shapes = _compare("shapes", arrays["shape"], shape, SHAPE_TOLERANCE_MM, " mm")
    margins = Finding(NOT_COVERED, why="The plan was evaluated on a model without margins.")
    if np.isfinite(arrays["stability"]).any():
        recorded, own = compare_both("stability", found.margin)
        margins = _compare("margins", recorded, own, MARGIN_TOLERANCE + MARGIN_TOLERANCE_PART * abs(own))
    if not file.walls or "clearance" not in arrays:
        why = "The file has a wall, and no clearances." if file.walls else "The file has no wall."
        word = NO if file.walls or "clearance" in arrays else NOT_COVERED
        return shapes, margins, Finding(word, why=why)
    recorded, own = compare_both("clearance", found.clearance)
    # Deep in the wall the nearest place of the path may be another one.
    own[own < -DEEP_MM] = np.nan
    # Plans measure at the triangles where a point may be the nearest of its frame, elsewhere in the smooth field.
    least = np.nanmin(np.where(np.isnan(own), np.inf, own), axis=2, keepdims=True)
    aside = (own > least + CLEARANCE_TOLERANCE_MM) & (recorded > least)
    allowed = np.where(aside, FIELD_ERROR_MM, CLEARANCE_TOLERANCE_MM)
    return shapes, margins, _compare("clearances", recorded, own, allowed, " mm")


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


def _check_samples(found: CheckResult) -> Finding:
    """Return whether the recorded results of samples are those found."""
    arrays, own, count = found.file.arrays, found.samples, found.moved
    if not count or "draws_parts" not in arrays:
        return Finding(NOT_COVERED, why=found.findings["holds"].why or "No recorded samples were moved.")
    recorded = arrays["draws_lost"][:count] > 0
    clearance = np.nan_to_num(arrays["draws_clearance"][:count])  # NaN without a wall
    apart = {
        "tips": np.linalg.norm(own["tips"] - arrays["draws_cloud"][-1, :count, -1], axis=-1),
        "contacts": abs(np.maximum(own["contacts"], 0.0) - np.maximum(-clearance, 0.0)),
        "errors": abs(own["errors"] - arrays["draws_e2"][:count]).max(axis=1),
    }
    wrong = {name: ~(values <= SAMPLE_TOLERANCE_MM) & ~own["lost"] & ~recorded for name, values in apart.items()}
    wrong["outcomes"] = own["lost"] != recorded
    off = int(np.any([*wrong.values()], axis=0).sum())
    reasons = ", ".join(f"{name} of {flags.sum()}" for name, flags in wrong.items() if flags.any())
    why = f"{off} of {count} samples differ: {reasons or 'none'}."
    return judge(off <= max(1, int(SAMPLE_SHARE * count)), float(off), why=why)


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
        # Of n normal samples the mean square is known to a part of sqrt(2 / n); what has no variance is 0.
        away = abs((parts[..., :-1] ** 2).mean(axis=0) - variance)
        wrong[:, :-1] = away > 6 * np.sqrt(2 / len(parts)) * variance
    names = [name for name, bad in zip(checker.DEVIATIONS, wrong.any(axis=0), strict=True) if bad]
    why = f"Samples do not have the tolerances of {', '.join(names)}." if names else "Samples fill the tolerances."
    return judge(not names, float(len(names)), why=why)
