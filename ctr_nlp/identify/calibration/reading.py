"""Measurements from CSV files.

Columns, in any order; angles in rad, lengths in mm, unless the name ends with another unit, as in alpha_1_deg and
tip_x_m (measurement_columns.py); empty cells and nan mean that a value was not measured:

    alpha_1 ..  beta_1 ..       the configuration, of every tube; theta_x, theta_y: 0 where there is no such column
    time_s                      of a motion; without it poses were measured one by one
    force_x  force_y  force_z   what pulls at the tip, N, as a weight that hangs there, in the axes of the robot's
                                base; without these columns nothing does
    tip_x  tip_y  tip_z         the tip
    tip_qw tip_qx tip_qy tip_qz the rotation from axes at the tip, z along the robot, to the sensor's, a quaternion
    p1_x   p1_y   p1_z   p1_sigma or p1_s   a point of the shape at arc length s, or at sigma = s / beta_d; p2_x ..
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import MeasurementError, suggest_names
from ctr_nlp.identify.calibration.measurement_columns import (
    Column,
    TextTable,
    parse_column,
    parse_number,
    read_text_table,
)
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.models.loads.load import MAX_LOAD_FORCE_N as MOST_FORCE
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import checked_path
from ctr_nlp.typing import Array

TIP_COLUMNS = "tip_x", "tip_y", "tip_z"
QUATERNION = "tip_qw", "tip_qx", "tip_qy", "tip_qz"
THETA = "theta_x", "theta_y"
FORCE_COLUMNS = "force_x", "force_y", "force_z"
TIME = "time_s"
POINT = re.compile(r"p([1-9]\d*)_(x|y|z|sigma|s)")
QUATERNION_LENGTH_TOLERANCE = 0.05
"""By how much the length of a quaternion may differ from 1: rounding, or a mean of several."""


class _Table(NamedTuple):
    """A file of measurements: its name, its columns and their values (T, columns), and the line of each row."""

    path: Path
    names: tuple[str, ...]
    values: Array
    lines: tuple[int, ...]

    def columns(self, names: Sequence[str]) -> Array:
        """Return the values (T, n) of the columns of n names; NaN for columns that are not there."""
        found = np.full((len(self.values), len(names)), np.nan)
        for k, name in enumerate(names):
            if name in self.names:
                found[:, k] = self.values[:, self.names.index(name)]
        return found


def read_measurements(path: str | Path | Sequence[str | Path], robot: Robot) -> Measurements:
    r"""Read the observations of one CSV file, or of several, each of which is a recording.

    Parameters
    ----------
    path : str, Path or sequence of these
        Files with the columns at the top of this module: the configuration, alpha in rad and beta in mm; and any
        of tip, rotation at the tip, points of the shape in mm, time_s in s and forces at the tip in N.
    robot : Robot
        The robot, whose axes name the columns of the configuration.

    Returns
    -------
    Measurements
        Without copies of an observation, which ``repeated`` counts.

    Raises
    ------
    MeasurementError
        A file cannot be read, a column is missing or unknown, or a value cannot be; the message names file, line,
        column and value.

    Examples
    --------
    >>> import tempfile
    >>> import ctr_nlp as ctr
    >>> robot = ctr.Robot((ctr.Tube(90, 60, 1 / 130, 3.0, 2.4),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "measured.csv")
    ...     _ = path.write_text("alpha_1,beta_1,tip_x,tip_y,tip_z\n0,40,0.1,6.1,39.4\n1,40,-5,3.2,39.4\n")
    ...     measured = read_measurements(path, robot)
    >>> len(measured), measured.tip[0].tolist()
    (2, [0.1, 6.1, 39.4])
    """
    paths = [path] if isinstance(path, str | Path) else list(path)
    if not paths:
        raise MeasurementError("no file of measurements is given; at least one is needed")
    tables = [_table(checked_path(MeasurementError, each), robot) for each in paths]
    most = max(max(_points(table), default=0) for table in tables)
    found = [_observations(table, robot, number, most) for number, table in enumerate(tables)]
    names = ("q", "tip", "direction", "points", "sigma", "time", "recording", "force", "line")
    arrays: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in found]) for name in names}
    together = Measurements(**arrays, files=tuple(table.path.name for table in tables))
    if np.isfinite(together.time).any() and not together.has_times:
        without = next(t.path for t, one in zip(tables, found, strict=True) if not one.has_times)
        raise MeasurementError(f"{without} has no {TIME} in some rows, and others have it; give it everywhere")
    together.check(robot)
    return together.distinct()


def _table(path: Path, robot: Robot) -> _Table:
    """Read a file; raise MeasurementError where it is no table of measurements of the robot."""
    text = read_text_table(path)
    columns = _columns(path, text.header, robot)
    factors = np.array([column.factor for column in columns])
    values = np.array([_row(path, n, text, row) for n, row in text.rows]) * factors
    return _Table(path, tuple(column.name for column in columns), values, tuple(n for n, _ in text.rows))


def _columns(path: Path, header: Sequence[str], robot: Robot) -> list[Column]:
    """Return the columns of a header; raise MeasurementError for one that is missing, unknown or there twice."""
    needed = robot.axes[: 2 * robot.d]
    known = (*robot.axes, TIME, *FORCE_COLUMNS, *TIP_COLUMNS, *QUATERNION)
    found = list[Column]()
    unknown = list[str]()
    for number, text in enumerate(header, 1):
        if not text:
            raise MeasurementError(
                f"column {number} of {path} has no name; name it, or leave it out (row numbers of pandas: "
                "index=False)"
            )
        column = parse_column(text, known)
        if column is None:
            unknown.append(text)
            continue
        if any(column.name == other.name for other in found):
            raise MeasurementError(f"{path} has the column {column.name!r} twice")
        found.append(column)
    names = [column.name for column in found]
    missing = [name for name in needed if name not in names]
    if missing and not unknown:
        raise MeasurementError(f"{path} has no column {missing[0]}; it must have {', '.join(needed)}")
    if unknown:
        without = f", and no column {missing[0]}" if missing else ""
        raise MeasurementError(
            f"{path} has a column {unknown[0]!r}, which is unknown{without}; known are "
            f"{', '.join(known)} and, for points of the shape, p1_x, p1_y, p1_z with p1_sigma or p1_s, "
            "p2_x ..; names may end with a unit, as "
            f"tip_x_mm{suggest_names(unknown[0].lower(), known)}"
        )
    return found


def _row(path: Path, line: int, text: TextTable, row: Sequence[str]) -> list[float]:
    """Return the numbers of a row, NaN where a cell is empty; line: its number in the file, for messages."""
    if len(row) != len(text.header):
        count = len(text.header)
        raise MeasurementError(f"line {line} of {path} has {len(row)} cells; the first line names {count}")
    found = []
    for name, cell in zip(text.header, row, strict=True):
        try:
            value = parse_number(cell, text.has_decimal_comma)
        except ValueError:
            value = math.inf
        if math.isinf(value):
            raise MeasurementError(f"{name} in line {line} of {path} is {cell!r}; it must be a number, or empty")
        found.append(value)
    return found


def _points(table: _Table) -> list[int]:
    """Return the numbers, from 1, of the points for which a table has columns."""
    return sorted({int(match[1]) for name in table.names if (match := POINT.fullmatch(name))})


def _observations(table: _Table, robot: Robot, recording: int, most: int) -> Measurements:
    """Return the observations of a table; recording: its number, from 0; most: largest number of points in any."""
    q = table.columns(robot.axes)
    absent = [k for k, name in enumerate(robot.axes) if name in THETA and name not in table.names]
    q[:, absent] = 0.0
    for row, axis in np.argwhere(~np.isfinite(q)):
        raise MeasurementError(
            f"{robot.axes[axis]} in line {table.lines[row]} of {table.path} is empty; every configuration "
            "must be known"
        )
    points = np.full((len(q), most, 3), np.nan)
    sigma = np.full((len(q), most), np.nan)
    for number in _points(table):
        points[:, number - 1] = table.columns([f"p{number}_{axis}" for axis in "xyz"])
        sigma[:, number - 1] = _places(table, number, points[:, number - 1], robot.split(q)[1][:, -1])
    time = table.columns([TIME])[:, 0]
    seen = (table.columns(TIP_COLUMNS), _directions(table), points, sigma)
    line = np.array(table.lines, dtype=int)
    return Measurements(q, *seen, time, np.full(len(q), recording), force=_forces(table), line=line)


def _forces(table: _Table) -> Array:
    """Return the forces at the tip (T, 3), N, of a table; 0 along axes that have no column."""
    found = table.columns(FORCE_COLUMNS)
    found[:, [name not in table.names for name in FORCE_COLUMNS]] = 0.0
    for row, axis in np.argwhere(~np.isfinite(found)):
        raise MeasurementError(
            f"{FORCE_COLUMNS[axis]} in line {table.lines[row]} of {table.path} is empty; write 0 where nothing "
            f"pulls"
        )
    for row in np.flatnonzero(np.linalg.norm(found, axis=1) > MOST_FORCE):
        raise MeasurementError(
            f"{', '.join(FORCE_COLUMNS)} in line {table.lines[row]} of {table.path} are {found[row].tolist()} "
            f"N; they "
            f"must be at most {MOST_FORCE:g} N together. A weight of a gram pulls with 0.00981 N"
        )
    return found


def _places(table: _Table, number: int, points: Array, reach: Array) -> Array:
    """Return the position of a measured point on the robot, as sigma (T,); NaN where it is missing.

    number: of the point, from 1. points: (T, 3), measured positions in mm. reach: (T,), beta_d in mm.
    """
    sigma, s = table.columns([f"p{number}_sigma", f"p{number}_s"]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(np.isfinite(sigma), sigma, s / reach)
    for row in np.flatnonzero(np.isfinite(points).any(axis=1)):
        where = f"in line {table.lines[row]} of {table.path}"
        if not np.isfinite(found[row]):
            raise MeasurementError(f"p{number} {where} has neither p{number}_sigma nor p{number}_s; one is needed")
        if not 0 <= found[row] <= 1 + 1e-9:
            told = f"sigma is {sigma[row]:g}" if np.isfinite(sigma[row]) else f"s is {s[row]:g} mm"
            raise MeasurementError(
                f"p{number}_{told} {where}; the point must lie on the robot, sigma in [0, 1] and s in "
                f"[0, {reach[row]:g}] mm{_explain_places(sigma, s, reach)}"
            )
    return np.asarray(found)


def _explain_places(sigma: Array, s: Array, reach: Array) -> str:
    """Return the end of a message: a unit with which all places (T,) of a point lie on the robot; "" if none.

    sigma, s: as given, mm. reach: (T,), beta_d in mm.
    """
    for unit, factor in (("percent", 0.01), ("mm from the base", 1 / reach)):
        if np.isfinite(sigma).any() and np.nanmax(sigma * factor) <= 1:
            return f"; is sigma in {unit}?"
    for unit, factor in (("cm", 10.0), ("m", 1000.0)):
        if np.isfinite(s).any() and np.nanmax(s / (reach * factor)) <= 1:
            return f"; are extensions beta in {unit}?"
    return ""


def _directions(table: _Table) -> Array:
    """Return the unit tangents at the tip, (T, 3): the z axis rotated by the measured quaternions of a table."""
    quaternions = table.columns(QUATERNION)
    size = np.linalg.norm(quaternions, axis=1)
    for row in np.flatnonzero(abs(size - 1) > QUATERNION_LENGTH_TOLERANCE):
        raise MeasurementError(
            f"{', '.join(QUATERNION)} in line {table.lines[row]} of {table.path} are {quaternions[row].tolist()}, "
            f"of length {size[row]:.3g}; a quaternion of a rotation has length 1"
        )
    # The third column of the rotation matrix: where z, which runs along the robot, points.
    w, x, y, z = (quaternions / size[:, None]).T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
