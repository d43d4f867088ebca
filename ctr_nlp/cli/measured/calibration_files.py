"""Write a calibration to files: residuals, the next poses, and everything as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.identify.calibration.calibration import Calibration
from ctr_nlp.identify.calibration.outliers import by_place
from ctr_nlp.identify.calibration.parameters import LAGS
from ctr_nlp.identify.calibration.prediction import flat_measured
from ctr_nlp.identify.calibration.reading import FORCE_COLUMNS
from ctr_nlp.identify.calibration.residuals import errors, summary_of
from ctr_nlp.plan.backlash import BACKLASH_PARAMETER_NAMES as LAG_PARTS
from ctr_nlp.support.tables import columns_to_rows, write_csv
from ctr_nlp.support.value_checks import strict_json


def parameter_rows(found: Calibration) -> list[dict[str, Any]]:
    """Return a row for each parameter of the calibration `found`: name, unit, mean and sigma before and after, how
    well known.
    """
    columns = {
        "name": found.parameters.names,
        "unit": [one.unit for one in found.parameters.each],
        "before": found.parameters.mean.tolist(),
        "before_sigma": found.parameters.sigma.tolist(),
        "value": found.fit.values.tolist(),
        "sigma": found.fit.sigma.tolist(),
        "standing": list(found.standing),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def as_json(found: Calibration) -> dict[str, Any]:
    """Return everything of the calibration `found` that programs may read, for strict JSON."""
    noise = found.fit.noise
    measured = found.measured
    bases = [{"rotation": turn, "place": place} for turn, place in found.bases]
    told = {
        "model": found.model,
        "observations": len(measured),
        "repeated": measured.repeated,
        "retraced": len(found.repeated_poses),
        "recordings": measured.recordings,
        "parameters": parameter_rows(found),
        "covariance": found.fit.covariance,
        "untold": list(found.unidentified),
        "notes": list(found.notes),
        "outliers": _outlier_rows(found),
        "bases": bases,
        "noise": {
            "position_mm": _finite_or_none(noise.position),
            "direction_rad": _finite_or_none(noise.direction),
            "alike": noise.autocorrelation,
        },
        "errors_mm": error_summaries(found),
        "floor_mm": found.floor,
        "next": [{"q": q, "left": left} for q, left in zip(found.next_q, found.next_left, strict=True)],
    }
    plain: dict[str, Any] = strict_json(told)
    return plain


def error_summaries(found: Calibration) -> dict[str, Any]:
    """Return mean, 95 % quantile and largest error, mm, of the robots of `found`: nominal, fitted, and
    held out; of the last two also without outliers, if there are any.
    """
    kinds = {"described": found.nominal_residuals, "fitted": found.fit.residuals, "held_out": found.held_out}
    summaries = {name: summary_of(errors(residuals)) for name, residuals in kinds.items()}
    if found.outliers.any():
        left_out = np.repeat(found.outliers, 3, axis=1)
        for name in ("fitted", "held_out"):
            summaries[f"{name}_without_outliers"] = summary_of(errors(np.where(left_out, np.nan, kinds[name])))
    return summaries


def write_residuals(found: Calibration, path: Path) -> None:
    """Write a row for each observation of `found` to `path`: pose, measured less predicted values, errors
    in mm.
    """
    measured = found.measured
    axes = found.nominal.axes
    columns: dict[str, npt.NDArray[Any]] = {"recording": measured.recording + 1, "fold": found.fold + 1}
    columns |= {"line": measured.line} if measured.line.any() else {}
    columns |= {"time_s": measured.time} if measured.has_times else {}
    columns |= {axis: measured.q[:, k] for k, axis in enumerate(axes)}
    columns |= dict(zip(FORCE_COLUMNS, measured.force.T, strict=True)) if measured.has_tip_force else {}
    points = [f"p{k + 1}" for k in range(measured.sigma.shape[1])]
    names = [f"residual_{place}_{axis}" for place in ("tip", "tip_direction", *points) for axis in "xyz"]
    seen = np.flatnonzero(np.isfinite(flat_measured(measured)).any(axis=0))
    columns |= {names[k]: found.fit.residuals[:, k] for k in seen}
    places = ["tip", "tip_direction", *points]
    known = np.flatnonzero(np.isfinite(found.weights).any(axis=0))
    columns |= {f"weight_{places[k]}": found.weights[:, k] for k in known}
    columns |= {"error_mm": errors(found.fit.residuals), "error_held_out_mm": errors(found.held_out)}
    columns |= {"error_described_mm": errors(found.nominal_residuals)}
    write_csv(path, columns_to_rows(columns))


def write_next(found: Calibration, path: Path) -> None:
    """Write the proposed poses of `found` to `path`, in columns as measured ones, with the part of the doubt left
    after each.
    """
    columns: dict[str, npt.NDArray[Any]] = dict(zip(found.nominal.axes, found.next_q.T, strict=True))
    write_csv(path, columns_to_rows(columns | {"left": found.next_left}))


def robot_file_comment(found: Calibration) -> str:
    """Return the comment on top of the robot file of `found`: its origin, and the offsets of motors."""
    lines = [
        f"From {len(found.measured)} measured poses. The tolerances are what is left to doubt.",
        *(f"{sentence[0].upper()}{sentence[1:]}." for sentence in found.notes),
        *(f"Not known from them: {sentence}." for sentence in found.unidentified),
    ]
    parameters = found.parameters
    for k in parameters.columns("motor_zero"):
        value = found.fit.values[k]
        one = parameters.each[k]
        lines.append(f"Where the motor of tube {one.number} reads 0, alpha_{one.number} is {value:.4f} rad.")
    return "\n".join([*lines, *_lag_table(found)])


def _lag_table(found: Calibration) -> list[str]:
    """Return the table of a hardware file that compensates backlash and drag; nothing where none were
    estimated.
    """
    parameters = found.parameters
    if not parameters.columns(*LAGS):
        return []
    lag = parameters.lag(found.fit.values)
    told = (f"{name} = [{', '.join(f'{v:.5g}' for v in getattr(lag, name))}]" for name in LAG_PARTS)
    return [
        "What makes up for the lags of the tubes, in the hardware file that plans are played on:",
        "[lag]",
        *told,
    ]


def _outlier_rows(found: Calibration) -> list[dict[str, Any]]:
    """Return a row for each value of `found` that was left out of the fit: its place, and how far it is off."""
    measured = found.measured
    names = ["tip", "tip_direction", *(f"p{k + 1}" for k in range(measured.sigma.shape[1]))]
    residuals = by_place(found.fit.residuals)
    return [
        {
            "recording": int(measured.recording[row]) + 1,
            "line": int(measured.line[row]) or None,
            "observation": int(row) + 1,
            "value": names[place],
            "off": float(np.sqrt(np.nansum(residuals[row, place] ** 2))),
            "weight": float(found.weights[row, place]),
        }
        for row, place in np.argwhere(found.outliers)
    ]


def _finite_or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
