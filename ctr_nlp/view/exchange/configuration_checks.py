"""Checks whether a robot can take configurations, and in which other order or unit of columns it could.

Values are first held against what no robot does: ten turns of a tube, lengths beyond a tube, a wrong order of
tips. Values that pass may still be in another unit. They are refused only where they are far beyond the robot's
limits, or far from the lengths of the target, and another reading of the columns fits both.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.paths.problem import Problem
from ctr_nlp.robot import Robot
from ctr_nlp.robot.checks import MAX_MOTOR_ANGLES_RAD
from ctr_nlp.robot.units import between, did_you_mean, suggest_angle, suggest_length
from ctr_nlp.typing import Array

CONFIGURATION_LENGTH_TOLERANCE_MM = 1e-6
"""Rounding error, mm, by which lengths beta may leave their range or order."""
MAX_TILT_RAD = 2 * math.pi
"""Largest tilt, rad: no base tilts by more than a turn."""
MIN_DEGREES_RAD = 4 * math.pi
"""Numbers up to two turns are not taken for degrees where only limits speak against them, rad."""
FAR_BEYOND_FACTOR = 5.0
"""A position or speed this many times beyond its limit is likely in another unit, rather than too fast."""
FITTING_LIMIT_FACTOR = 1.05
"""How far another reading may use the limits of positions and speeds, as a part of them."""
MAX_LENGTH_MISMATCH, FITTING_LENGTH_MISMATCH = 0.5, 0.15
"""Median part by which the robot may differ from the target's length: beyond the first, another reading that stays
below the second counts.
"""


class Reading(NamedTuple):
    """Another reading of the columns: what would have to be true, and the configurations (T, 2d + 2) then."""

    conditions: tuple[str, ...]
    q: Array


Change = tuple[str | None, Callable[[Array, Robot], Array]]
"""What would have to be true, None for nothing, and the function of q and the robot that undoes it."""


def check_configurations(q: Array, problem: Problem) -> None:
    """Raise OptionError where the tubes of a problem's robot cannot take configurations, or likely should not.

    q: (T, 2d + 2), rad and mm, one row for each frame of the problem.
    """
    robot = problem.robot
    _check_finite(q, robot)
    fault = _find_fault(q, robot)
    if fault is not None:
        raise OptionError(fault + _would_fit(_best_readings(_possible_readings(q, robot), problem)))
    doubt = _find_doubt(q, problem)
    if doubt is None:
        return
    # A doubt alone refuses nothing: a motion may be too fast, and a robot too short.
    fitting = [
        reading
        for reading in _possible_readings(q, robot)
        if _keeps_limits(reading.q, problem) and _fits_lengths(reading.q, problem)
    ]
    if fitting:
        raise OptionError(doubt + _would_fit(fitting))


def _check_finite(q: Array, robot: Robot) -> None:
    """Raise OptionError where an entry of q (T, 2d + 2) is not finite."""
    for frame, column in np.argwhere(~np.isfinite(q)):
        raise OptionError(f"{robot.axes[column]} in frame {frame + 1} is {q[frame, column]}; it must be finite")


def _find_fault(q: Array, robot: Robot) -> str | None:
    """Return what no such robot does in q (T, 2d + 2), as a message on the first frame; None for nothing."""
    for frame, row in enumerate(q, start=1):
        fault = _find_angle_fault(row, frame, robot) or _find_length_fault(row, frame, robot)
        if fault:
            return fault
    # All lengths below 1 mm make no motion of a longer robot, but are usual lengths in metres.
    longest = robot.split(q)[1].max()
    if longest < 1.0 < robot.reach:
        return f"beta is at most {longest:g} mm in all frames; lengths must be in mm: are these in metres?"
    return None


def _find_angle_fault(row: Array, frame: int, robot: Robot) -> str | None:
    """Return the message on an angle that no drive turns by in one row of q (2d + 2,); None for none."""
    # alpha is never wrapped, since a full turn of one tube is not the identity on the elastic model.
    for axis, value in zip(robot.axes, row, strict=True):
        kind = axis.partition("_")[0]
        if kind == "beta":
            continue
        most = MAX_MOTOR_ANGLES_RAD["alpha"] if kind == "alpha" else MAX_TILT_RAD
        if abs(value) > most * (1 + 1e-9):
            meant = did_you_mean(suggest_angle(value, between(-most, most)))
            turns = ", ten turns" if kind == "alpha" else ""
            allowed = f"[-{most:.4g}, {most:.4g}] rad{turns}"
            return f"{axis} in frame {frame} is {value:g} rad; it must lie in {allowed}{meant}"
    return None


def _find_length_fault(row: Array, frame: int, robot: Robot) -> str | None:
    """Return the message on a length that the tubes cannot have in one row of q (2d + 2,); None for none."""
    beta = robot.split(row)[1]
    slack = CONFIGURATION_LENGTH_TOLERANCE_MM
    for i, (value, tube) in enumerate(zip(beta, robot.tubes, strict=True), start=1):
        if not -slack <= value <= tube.length + slack:
            # Papers often give the position of a tube's base, beta - L <= 0, instead of beta.
            based = -tube.length <= value < 0
            meant = "; is it the position of the tube's base, beta - length?" if based else ""
            meant = meant or did_you_mean(suggest_length(value, between(1e-9, tube.length)))
            return f"beta_{i} in frame {frame} is {value:g} mm; it must lie in [0, {tube.length:g}]{meant}"
    for i in (np.flatnonzero(np.diff(beta) < -slack) + 1).tolist():
        return (
            f"beta_{i} in frame {frame} is {beta[i - 1]:g} mm and exceeds beta_{i + 1}, {beta[i]:g} mm; "
            "tube 1 is the outermost, and no tube may extend beyond one inside it"
        )
    if not beta[-1] > 0:
        return f"beta_{robot.d} in frame {frame} is 0 mm; something of the robot must be out"
    return None


def _find_doubt(q: Array, problem: Problem) -> str | None:
    """Return why q (T, 2d + 2) is likely in another order or unit; None for no reason."""
    robot = problem.robot
    angles = np.array([not axis.startswith("beta") for axis in robot.axes])
    share = np.where(angles, _limit_shares(q, problem), 0.0)
    large = abs(q).max(axis=0) > MIN_DEGREES_RAD
    column = int((share * large).argmax())
    if (share * large)[column] > FAR_BEYOND_FACTOR:
        return (
            f"{robot.axes[column]} is up to {abs(q[:, column]).max():g} rad and uses {share[column]:.3g} times "
            f"its limits of position and speed in {problem.duration:g} s"
        )
    off = _length_mismatch(q, problem)
    if off > MAX_LENGTH_MISMATCH:
        return (
            f"beta_{robot.d} ends at {robot.split(q)[1][-1, -1]:g} mm, and the target has "
            f"{np.asarray(problem.target.lengths)[-1]:g} mm"
        )
    return None


def _limit_shares(q: Array, problem: Problem) -> Array:
    """Return by what part each column (2d + 2,) of q uses its limits of position, about their middle, or speed."""
    robot = problem.robot
    endless = ~(np.isfinite(robot.lower) & np.isfinite(robot.upper))
    lower, upper = (np.where(endless, 0.0, limit) for limit in (robot.lower, robot.upper))
    half = np.where(endless, np.inf, (upper - lower) / 2)
    off = abs(q - (lower + upper) / 2).max(axis=0)
    # A range of one value, as of a base that cannot tilt, is kept or not.
    position = np.divide(off, half, out=np.where(off > 0, np.inf, 0.0), where=half > 0)
    speed = abs(np.diff(q, axis=0)).max(axis=0, initial=0.0) / (problem.dt * robot.speed)
    return np.asarray(np.maximum(position, speed))


def _length_mismatch(q: Array, problem: Problem) -> float:
    """Return the median part by which the robot's length in q (T, 2d + 2) differs from the target's."""
    lengths = np.asarray(problem.target.lengths)
    return float(np.median(abs(problem.robot.split(q)[1][:, -1] / np.maximum(lengths, 1e-9) - 1)))


def _fits_lengths(q: Array, problem: Problem) -> bool:
    """Return whether the robot is about as long as the target in q (T, 2d + 2)."""
    return _length_mismatch(q, problem) <= FITTING_LENGTH_MISMATCH


def _would_fit(readings: list[Reading]) -> str:
    """Return the end of a message with the readings of the fewest conditions; empty without any."""
    if not readings:
        return ""
    fewest = min(len(each.conditions) for each in readings)
    told = [" and ".join(each.conditions) for each in readings if len(each.conditions) == fewest]
    return f"; the configurations would fit if {', or if '.join(told[:3])}"


def _best_readings(readings: list[Reading], problem: Problem) -> list[Reading]:
    """Return the readings that keep the robot's limits and are as long as the target, as far as any does."""
    kept = [each for each in readings if _keeps_limits(each.q, problem)] or readings
    return [each for each in kept if _fits_lengths(each.q, problem)] or kept


def _keeps_limits(q: Array, problem: Problem) -> bool:
    """Return whether q (T, 2d + 2) keeps the limits of positions and speeds."""
    return bool(_limit_shares(q, problem).max() <= FITTING_LIMIT_FACTOR)


def _possible_readings(q: Array, robot: Robot) -> list[Reading]:
    """Return other readings of q (T, 2d + 2) that a robot's tubes can take, each motion once, simplest first."""
    found = list[Reading]()
    for each in sorted(_readings(q, robot), key=lambda reading: len(reading.conditions)):
        known = any(np.array_equal(each.q, other.q) for other in found)
        if not known and not np.array_equal(each.q, q) and _find_fault(each.q, robot) is None:
            found.append(each)
    return found


def _readings(q: Array, robot: Robot) -> Iterator[Reading]:
    """Yield other readings of q (T, 2d + 2): each order of columns, with each unit and meaning."""
    for changes in itertools.product(_LAYOUTS, _LENGTH_UNITS, _ANGLE_UNITS, _MEANINGS):
        conditions = tuple(what for what, _ in changes if what is not None)
        if not conditions:
            continue
        read = q
        for _, change in changes:
            read = change(read, robot)
        yield Reading(conditions, read)


def _as_given(q: Array, robot: Robot) -> Array:
    """Return q (T, 2d + 2) unchanged. robot: not used."""
    return q


def _take_columns(order: Callable[[int], list[int]]) -> Callable[[Array, Robot], Array]:
    """Return the function that takes the columns of q in another order. order: of the number of tubes."""
    return lambda q, robot: q[:, order(robot.d)]


def _scale(kinds: tuple[str, ...], factor: float) -> Callable[[Array, Robot], Array]:
    """Return the function that scales the columns of q of some kinds ("alpha", "beta", "theta") by a factor."""

    def scale(q: Array, robot: Robot) -> Array:
        chosen = np.array([axis.partition("_")[0] in kinds for axis in robot.axes])
        return np.where(chosen, factor * q, q)

    return scale


def _from_base(q: Array, robot: Robot) -> Array:
    """Return q (T, 2d + 2) with the length of each tube of the robot added to its beta."""
    lengths = [tube.length for tube in robot.tubes]
    return q + np.concatenate([np.zeros(robot.d), lengths, np.zeros(2)])


_LAYOUTS: tuple[Change, ...] = (
    (None, _as_given),
    (
        "the columns of alpha and beta were exchanged",
        _take_columns(lambda d: [*range(d, 2 * d), *range(d), 2 * d, 2 * d + 1]),
    ),
    (
        "the tubes were numbered from the innermost one",
        _take_columns(lambda d: [*reversed(range(d)), *reversed(range(d, 2 * d)), 2 * d, 2 * d + 1]),
    ),
    (
        "columns went tube by tube, alpha_1, beta_1, alpha_2, ..",
        _take_columns(lambda d: [*range(0, 2 * d, 2), *range(1, 2 * d, 2), 2 * d, 2 * d + 1]),
    ),
    (
        "columns went tube by tube, beta_1, alpha_1, beta_2, ..",
        _take_columns(lambda d: [*range(1, 2 * d, 2), *range(0, 2 * d, 2), 2 * d, 2 * d + 1]),
    ),
    ("theta stood first", _take_columns(lambda d: [*range(2, 2 * d + 2), 0, 1])),
)
_MEANINGS: tuple[Change, ...] = (
    (None, _as_given),
    ("beta had the other sign", _scale(("beta",), -1.0)),
    ("beta were the position of each tube's base, beta - length", _from_base),
)
_LENGTH_UNITS: tuple[Change, ...] = (
    (None, _as_given),
    ("lengths were in metres", _scale(("beta",), 1e3)),
    ("lengths were in cm", _scale(("beta",), 10.0)),
    ("lengths were in µm", _scale(("beta",), 1e-3)),
)
_ANGLE_UNITS: tuple[Change, ...] = (
    (None, _as_given),
    ("angles were in degrees", _scale(("alpha", "theta"), math.pi / 180)),
    ("alpha were in degrees", _scale(("alpha",), math.pi / 180)),
)
