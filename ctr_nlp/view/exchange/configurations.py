"""Read configurations from files of other programs, and make the plan that moves a robot through them."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import DEFAULT_MODEL, Model, model_named
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import checked_path, plain_floats
from ctr_nlp.typing import Array
from ctr_nlp.view.exchange.configuration_checks import check_configurations
from ctr_nlp.view.exchange.mat import read_mat_variables

CONFIGURATION_SUFFIXES = (".mat", ".csv")
TIME = "time_s"
MAX_RELATIVE_STEP_DEVIATION = 1e-6
"""Largest deviation of a frame's time from even steps, as a part of a step."""
CONFIGURATION_ROWS_TEXT = (
    "(T, 2d + 2), a row a frame: alpha_1..d in rad, beta_1..d in mm, theta_x and theta_y in rad"
)
NO_SHAPE = "the model finds no shape for the configuration"


@dataclass(frozen=True)
class Configurations:
    """Configurations of a motion, one a frame, read from a file.

    Attributes
    ----------
    q : (T, 2d + 2) array
        One row a frame: alpha_1..d in rad, beta_1..d in mm, theta_x and theta_y in rad, eq. (5) of the paper.
    duration : float or None
        Time for all frames, s; None where the file has no times.
    """

    q: Array
    duration: float | None


def read_configurations(path: str | Path) -> Configurations:
    r"""Read configurations from a file of another program.

    Parameters
    ----------
    path : str or Path
        A ``.mat`` file of MATLAB up to version 7 with a variable q (T, 2d + 2), whose columns are alpha_1..d in
        rad, beta_1..d in mm, theta_x and theta_y in rad, and optionally time (T,) in s. Or a ``.csv`` file with
        one row a frame under a header with the columns alpha_1_rad.., beta_1_mm.., theta_x_rad and theta_y_rad, in
        any order, and optionally time_s. Times are those of a plan: evenly spaced, the first of them one step
        after 0.

    Returns
    -------
    Configurations
        Configurations and duration. :func:`plan_through` checks whether a robot can take them.

    Raises
    ------
    OptionError
        The file cannot be read, or a field has a wrong name, shape or value; the message names file, field and
        value, and says what is allowed.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "motion.csv")
    ...     header = "alpha_1_rad,beta_1_mm,theta_x_rad,theta_y_rad,time_s"
    ...     _ = path.write_text(f"{header}\n0,50,0,0,0.5\n0.1,60,0,0,1.0\n")
    ...     found = read_configurations(path)
    >>> found.q.shape, found.duration
    ((2, 4), 1.0)
    """
    path = checked_path(OptionError, path)
    suffix = path.suffix.lower()
    if suffix not in CONFIGURATION_SUFFIXES:
        raise OptionError(f"configurations {path} are in no known kind of file; its name must end in .mat or .csv")
    try:
        q, time = _of_mat(path) if suffix == ".mat" else _of_csv(path)
        return Configurations(q, None if time is None else _duration(time, len(q)))
    except OSError as error:
        raise OptionError(f"configurations {path} cannot be read: {error}") from error
    except OptionError as error:
        raise OptionError(f"configurations {path}: {error}") from error


def plan_through(problem: Problem, q: Array, model: str | Model = DEFAULT_MODEL, source: str = "") -> Plan:
    """Make the plan that moves a problem's robot through given configurations.

    Nothing is optimised, so that objective, KKT residual and solve times of the plan are NaN; shapes, errors,
    margins and verdicts are those of the robot moved through `q`.

    Parameters
    ----------
    problem : Problem
        Robot and target.
    q : (T, 2d + 2) array
        One row for each frame of the problem; rad, mm and rad. The tubes must be able to have these lengths;
        limits of the robot's drives are not checked here but by the plan's verdicts. Numbers far beyond them that
        fit in another unit or order of columns are refused, and so are lengths that fit the target only then.
    model : str or Model
        The kinematic model on which the robot is moved.
    source : str
        Where `q` comes from, for ``plan.options["source"]``.

    Returns
    -------
    Plan
        Frames in which the model finds no shape count as failed.

    Raises
    ------
    OptionError
        `q` has another shape, the tubes cannot take a configuration (the message names its frame, and the unit or
        order of columns in which they could), or the model does not describe the robot.
    LoadError
        The model's load cannot be applied to the robot.

    Examples
    --------
    >>> from ctr_nlp.problems import named_problem
    >>> problem = named_problem("arc", frames=3)
    >>> plan = plan_through(problem, np.tile([0, 0, 0, 20, 40, 60, 0, 0], (3, 1)), model="dominant")
    >>> plan.shape.shape, bool(plan.success.all())
    ((3, 101, 3), True)
    """
    described = model_named(model)
    robot = problem.robot
    described.check_planning(robot)
    q = _numbers("q", q)
    _check_shape(q, robot, problem.frames)
    check_configurations(q, problem)
    simulator = Simulator(robot, described)
    unknown = np.full(problem.frames, np.nan)
    known = np.asarray(np.isfinite(simulator(q).shape).all(axis=(1, 2)))
    meta = {
        "formulation": "configurations",
        "model": described.name,
        "solver": "another program",
        "options": {"source": source},
        "interrupted": False,
        "contact_weight": None,
        "failures": {str(frame): NO_SHAPE for frame in (np.flatnonzero(~known) + 1).tolist()},
    }
    return plan_from_configurations(
        problem,
        q,
        meta,
        success=known,
        solve_time=unknown,
        objective=unknown,
        kkt=unknown,
        simulator=simulator,
    )


def _of_mat(path: Path) -> tuple[Array, Array | None]:
    """Read q (T, 2d + 2) and the times (T,), or None, from a MATLAB file; raise OptionError."""
    held = read_mat_variables(path, "q")
    if "q" not in held:
        raise OptionError(
            f"it has no variable q, only {', '.join(held) or 'nothing'}; it must have q, {CONFIGURATION_ROWS_TEXT}"
        )
    q = _numbers("q", held["q"])
    if q.ndim != 2 or not len(q) or q.shape[1] < 4 or q.shape[1] % 2:
        raise OptionError(f"q has shape {q.shape}; it must be {CONFIGURATION_ROWS_TEXT}")
    return q, _numbers("time", held["time"]).ravel() if "time" in held else None


def _of_csv(path: Path) -> tuple[Array, Array | None]:
    """Read q (T, 2d + 2) and the times (T,), or None, from a CSV file; raise OptionError."""
    try:
        # Spreadsheets begin a file with a byte order mark; utf-8-sig drops it.
        with open(path, newline="", encoding="utf-8-sig") as file:
            lines = [(n, row) for n, row in enumerate(csv.reader(file), start=1) if any(map(str.strip, row))]
    except (UnicodeDecodeError, csv.Error) as error:
        raise OptionError(f"it is no table: {error}") from error
    if len(lines) < 2:
        raise OptionError("it holds no rows; it must have a header and a row for each frame")
    header = [name.strip() for name in lines[0][1]]
    wanted = _columns(max(1, sum(name.startswith("alpha_") for name in header)))
    _check_header(header, wanted)
    values = np.array([_row(line, header, row) for line, row in lines[1:]])
    q = values[:, [header.index(name) for name in wanted]]
    return q, values[:, header.index(TIME)] if TIME in header else None


def _columns(tubes: int) -> list[str]:
    """Return the names of a table's columns for a robot of `tubes` tubes, in the order of q."""
    count = range(1, tubes + 1)
    return [*(f"alpha_{i}_rad" for i in count), *(f"beta_{i}_mm" for i in count), "theta_x_rad", "theta_y_rad"]


def _check_header(header: list[str], wanted: list[str]) -> None:
    """Raise OptionError for a column that is missing, unknown, in another unit or there twice."""
    for name in header:
        if header.count(name) > 1:
            raise OptionError(f"it has the column {name!r} twice")
        if name in (*wanted, TIME):
            continue
        other = next(
            (right for right in wanted if re.fullmatch(rf"{right.rpartition('_')[0]}(_\w+)?", name)), None
        )
        if other is not None:
            raise OptionError(f"it has a column {name!r}; it must be named {other}, and be in that unit")
        raise OptionError(f"it has a column {name!r}, which is unknown; known are {', '.join([*wanted, TIME])}")
    missing = [name for name in wanted if name not in header]
    if missing:
        raise OptionError(f"it has no column {missing[0]}; it must have {', '.join(wanted)}")


def _row(line: int, header: list[str], row: list[str]) -> list[float]:
    """Return the numbers of one row of a table; line: its number in the file, for messages."""
    if len(row) != len(header):
        raise OptionError(f"line {line} has {len(row)} cells; the header has {len(header)}")
    found = []
    for name, cell in zip(header, row, strict=True):
        try:
            found.append(float(cell))
        except ValueError:
            raise OptionError(f"{name} in line {line} is {cell!r}; it must be a number") from None
    return found


def _numbers(name: str, value: Any) -> Array:
    """Return a value as an array of floats; raise OptionError, with `name`, where it contains anything else."""
    try:
        return plain_floats(value)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{name} holds {getattr(value, 'dtype', type(value))}; it must be numbers") from error


def _check_shape(q: Array, robot: Robot, frames: int) -> None:
    """Raise OptionError where q is not (frames, 2d + 2)."""
    width = len(robot.axes)
    if q.shape != (frames, width):
        turned = "; it seems to be transposed" if q.ndim == 2 and q.shape[0] == width != q.shape[1] else ""
        raise OptionError(
            f"q has shape {q.shape}; for {frames} frames of a robot of {robot.d} tubes it must be "
            f"({frames}, {width}), {', '.join(_columns(robot.d))}{turned}"
        )


def _duration(time: Array, frames: int) -> float:
    """Return the duration, s, of frames at times (T,), s; raise OptionError unless these are even steps from 0."""
    if time.shape != (frames,):
        raise OptionError(f"time has shape {time.shape}; it must have one value for each of {frames} frames")
    # Frame j = 1..T is at j dt, as in a plan; the motion takes T dt.
    step = time[0]
    if (
        not (math.isfinite(step) and step > 0)
        or abs(time - step * np.arange(1, frames + 1)).max() > MAX_RELATIVE_STEP_DEVIATION * step
    ):
        raise OptionError(
            f"time runs from {time[0]:g} to {time[-1]:g} s; frames must be even steps apart, the first of them "
            "one step after 0: leave time out and give the duration"
        )
    return float(step * frames)
