"""Measurements of a robot: its configurations, and the values that a sensor measured of its shape at each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace

import numpy as np

from ctr_nlp.exceptions import MeasurementError, RobotError
from ctr_nlp.robot import Robot
from ctr_nlp.robot.checks import check_angle
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags, Index

MAX_NAMED_MISTAKES = 3
"""Largest number of possible mistakes that a message names."""
MIN_REACH_PART = 0.01
"""Part of the robot's length below which even the largest extension of all measurements is rather in metres."""
EXTENSION_TOLERANCE_MM = 1e-3
"""mm by which recorded extensions may miss their order and the tubes' lengths: rounding."""


@dataclass(frozen=True, eq=False)
class Measurements(ReadOnlyValue):
    """T observations of a robot: its configurations, and the values that a sensor measured of its shape at each.

    Missing values are NaN. Points and directions are in the sensor's axes, which are those of the robot's base or
    unknown.

    Parameters
    ----------
    q : (T, 2d + 2) array
        Commanded configurations; rad, mm and rad.
    tip : (T, 3) array
        The tip, mm.
    direction : (T, 3) array
        Unit tangents at the tip.
    points : (T, n, 3) array
        Points of the shape, mm; single coordinates may be NaN.
    sigma : (T, n) array
        Their positions on the robot: arc length over beta_d, in [0, 1].
    time : (T,) array
        Time, s; NaN where poses were measured one by one.
    recording : (T,) array of int
        Number of the recording, from 0. Each has its own pose of the sensor, and its own time.
    repeated : int
        Number of further copies of these observations that were given.
    force : (T, 3) or (3,) array
        Known forces at the tip in the axes of the robot's base, N, such as weights that hang there; one for all
        observations is repeated. 0 by default.
    line : (T,) array of int
        Line of the file that an observation was read from, from 1; 0, the default, where it is from no file.
    files : tuple of str
        Name of the file of every recording; empty where they are from no files.

    Raises
    ------
    MeasurementError
        Arrays do not fit each other, a force is not known, or nothing was measured.
    """

    q: Array
    tip: Array
    direction: Array
    points: Array
    sigma: Array
    time: Array
    recording: Index
    repeated: int = 0
    force: Array = field(default_factory=lambda: np.zeros(3))
    line: Index = field(default_factory=lambda: np.zeros(0, dtype=int))
    files: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.q)
        if not len(self.line):
            object.__setattr__(self, "line", np.zeros(count, dtype=int))
        if self.force.shape == (3,):
            object.__setattr__(self, "force", np.tile(self.force, (count, 1)))
        wanted = {
            **dict.fromkeys(("tip", "direction", "force"), (count, 3)),
            **dict.fromkeys(("time", "recording", "line"), (count,)),
            "points": (*self.sigma.shape, 3),
            "sigma": (count, self.sigma.shape[-1]),
        }
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise MeasurementError(
                    f"{name} of measurements has shape {getattr(self, name).shape}, not {shape}"
                )
        if not np.isfinite(self.force).all():
            row = int(np.flatnonzero(~np.isfinite(self.force).all(axis=1))[0])
            raise MeasurementError(
                f"the force of observation {row + 1} is {self.force[row].tolist()} N; it must be known, and is 0 "
                "where nothing hangs at the tip"
            )
        if not count:
            raise MeasurementError("there are no measurements; at least one observation is needed")
        if not self.observed_mask.any():
            raise MeasurementError("nothing was measured: no tip, no direction and no point has a value")
        super().__post_init__()

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, chosen: Flags | Index | slice) -> Measurements:
        """Return the chosen observations: an index array, a mask (T,) or a slice."""
        arrays = {
            f.name: getattr(self, f.name)[chosen] for f in fields(self) if f.name not in ("repeated", "files")
        }
        return replace(self, **arrays)

    @property
    def observed_mask(self) -> Flags:
        """Mask (T,) of the observations in which anything of the shape was measured."""
        flat = np.concatenate([self.tip, self.direction, self.points.reshape(len(self.q), -1)], axis=1)
        return np.asarray(np.isfinite(flat).any(axis=1))

    @property
    def has_times(self) -> bool:
        """Whether these are motions, at known times, instead of poses measured one by one."""
        return bool(np.isfinite(self.time).all())

    @property
    def has_tip_force(self) -> bool:
        """Whether a force acts at the tip in any observation."""
        return bool(self.force.any())

    @property
    def fresh(self) -> Flags:
        """Mask (T,) of the observations whose motion before is unknown.

        These are the first of every recording, and all where no time is known.
        """
        if not self.has_times:
            return np.ones(len(self), dtype=bool)
        return np.asarray(np.diff(self.recording, prepend=-1) != 0)

    @property
    def recordings(self) -> int:
        """Number of recordings."""
        return int(self.recording.max()) + 1

    def place_of(self, row: int) -> str:
        """Name an observation for messages.

        Parameters
        ----------
        row : int
            Index of the observation, from 0.

        Returns
        -------
        str
            Its line in the file, with the file's name if there are several, or its number, from 1.
        """
        if not self.line[row]:
            return f"observation {row + 1}"
        of_file = f" of {self.files[int(self.recording[row])]}" if len(self.files) > 1 else ""
        return f"line {self.line[row]}{of_file}"

    def check(self, robot: Robot) -> None:
        """Check that a robot can have been at all configurations.

        Parameters
        ----------
        robot : Robot
            The robot.

        Raises
        ------
        MeasurementError
            `q` has another number of columns; an entry is not finite, an angle was likely given in degrees, or
            extensions break their order or exceed a tube's length; or a point lies beyond the robot's ends. The
            message names the observation, from 1.
        """
        if self.q.shape[1] != len(robot.axes):
            raise MeasurementError(
                f"q of measurements has {self.q.shape[1]} columns; it must have {len(robot.axes)}: "
                f"{', '.join(robot.axes)}"
            )
        for row in range(len(self)):
            if wrong := _find_wrong_value(robot, self.q[row], self._where(row)):
                raise MeasurementError(_join_explanation(wrong, _explain_configurations(robot, self.q)))
        self._check_extension_unit(robot)
        for row, (sigma, points) in enumerate(zip(self.sigma, self.points, strict=True), start=1):
            known = np.isfinite(points).any(axis=1)
            if known.any() and not ((sigma[known] >= 0) & (sigma[known] <= 1 + 1e-9)).all():
                raise MeasurementError(
                    f"observation {row}: a point lies at sigma {sigma[known].tolist()}; it must lie in [0, 1]"
                )

    def _where(self, row: int) -> str:
        """Return the end of "beta_1 ..": in which line of the file, or of which observation, from 0."""
        return f"in {self.place_of(row)}" if self.line[row] else f"of {self.place_of(row)}"

    def _check_extension_unit(self, robot: Robot) -> None:
        """Raise MeasurementError where even the largest extension is so small that it must be in another unit."""
        reach = float(self.q[:, 2 * robot.d - 1].max())
        length = robot.tubes[-1].length
        if reach >= MIN_REACH_PART * length or len(self) < 2:
            return
        millimetres = np.array(self.q)
        millimetres[:, robot.d : 2 * robot.d] *= 1000
        if all(_find_wrong_value(robot, row) is None for row in millimetres):
            places = np.vstack([self.tip, self.points.reshape(-1, 3)])
            known = places[np.isfinite(places).all(axis=1)]
            # The distance of any two points, in whatever axes, is at most twice what lies outside of the base.
            also = len(known) > 1 and float(np.ptp(known, axis=0).max()) <= 2 * reach
            raise MeasurementError(
                f"beta_{robot.d} is at most {reach:.3g} mm in {len(self)} rows, and the robot is {length:g} mm "
                f"long: are extensions{' and measured points' if also else ''} in m? Give all lengths in mm, or "
                "name the unit in the columns, as in beta_1_m"
            )

    def distinct(self) -> Measurements:
        """Return the observations without copies, each recording in the order of time.

        Returns
        -------
        Measurements
            ``repeated`` counts the copies that were left out.

        Raises
        ------
        MeasurementError
            Two different observations of one recording have the same time, or an angle of a motion jumps by more
            than half a turn from one to the next.
        """
        order = np.lexsort((np.where(np.isfinite(self.time), self.time, 0.0), self.recording))
        columns = [
            *(self.recording[:, None], self.time[:, None], self.q, self.force, self.tip, self.direction),
            *(self.sigma, self.points.reshape(len(self), -1)),
        ]
        table = np.hstack(columns)
        # NaN is not equal to itself; infinity, which nothing measured is, stands for it.
        _, first = np.unique(np.where(np.isfinite(table), table, math.inf), axis=0, return_index=True)
        kept = order[np.isin(order, first)]
        found = self[kept]
        same = np.flatnonzero((np.diff(found.time) <= 0) & (np.diff(found.recording) == 0))
        if len(same):
            at = found.time[same[0]]
            raise MeasurementError(f"two different observations of one recording have the time {at:g} s")
        found._check_turns()
        return replace(found, repeated=self.repeated + len(self) - len(kept))

    def _check_turns(self) -> None:
        """Raise MeasurementError where an angle of a motion jumps by more than half a turn."""
        # On the elastic model one tube's full turn is not the identity: a wrapped angle is another equilibrium.
        # The slice is d to 2d, with 2d + 2 columns.
        jumps = abs(np.diff(self.q, axis=0)) > math.pi
        jumps[:, self.q.shape[1] // 2 - 1 : -2] = False  # extensions, mm
        for row, axis in np.argwhere(jumps & ~self.fresh[1:, None])[:1]:
            (before, after), (begin, end) = self.q[row : row + 2, axis], self.time[row : row + 2]
            name = f"alpha_{axis + 1}" if axis < self.q.shape[1] - 2 else "theta"
            raise MeasurementError(
                f"{name} goes from {before:.4g} to {after:.4g} rad between {begin:g} and {end:g} s: is it "
                "wrapped? Unwrap angles: a full turn of a tube changes the robot's shape"
            )


def _find_wrong_value(robot: Robot, q: Array, where: str = "") -> str | None:
    """Return a message on the first entry of q (2d + 2,) that a robot cannot have; None where it can be there.

    where: names the observation, for the message.
    """
    for axis, value in zip(robot.axes, q, strict=True):
        if not math.isfinite(value):
            return f"{axis} {where} is {value}; it must be a number, in rad or mm"
        if not axis.startswith("beta"):
            try:
                check_angle(f"{axis} {where} is {value:g} rad, and it", axis, value)
            except RobotError as error:
                return str(error)
    beta = robot.split(q)[1]
    before = 0.0
    for i, (value, tube) in enumerate(zip(beta, robot.tubes, strict=True), start=1):
        if not before - EXTENSION_TOLERANCE_MM <= value <= tube.length + EXTENSION_TOLERANCE_MM:
            least = f"beta_{i - 1}, {before:g}" if i > 1 else "0"
            return (
                f"beta_{i} {where} is {value:g} mm; it must lie between {least} mm and the tube's length, "
                f"{tube.length:g} mm"
            )
        before = value
    if beta[-1] <= 0:
        return f"beta_{robot.d} {where} is {beta[-1]:g} mm; it must be positive"
    return None


def _explain_configurations(robot: Robot, q: Array) -> str:
    """Return the end of a message: mistakes without which a robot can be at all q (T, 2d + 2); "" if none."""
    if len(q) < 2:
        return ""  # any wrong value of a single row can be made right by some change
    likely = [
        words
        for words, changed in _possible_mistakes(robot, q)
        if all(_find_wrong_value(robot, row) is None for row in changed)
    ]
    if not likely:
        return ""
    return f"all {len(q)} rows would be possible if {', or if '.join(likely[:MAX_NAMED_MISTAKES])}"


def _join_explanation(message: str, explanation: str) -> str:
    """Return a message with an explanation after it; explanation: a clause, or "" for none."""
    if not explanation:
        return message
    return f"{message} A{explanation[1:]}" if message.endswith("?") else f"{message}; {explanation}"


def _possible_mistakes(robot: Robot, q: Array) -> Iterator[tuple[str, Array]]:
    """Yield usual mistakes in q (T, 2d + 2): in words, and q without it."""
    d = robot.d
    turns = np.r_[0:d, 2 * d : q.shape[1]]
    slides = slice(d, 2 * d)
    for words, columns, factor in (
        ("angles were in degrees", turns, math.pi / 180),
        ("extensions were in micrometres", slides, 0.001),
        ("extensions were counted as negative numbers", slides, -1.0),
    ):
        changed = np.array(q)
        changed[:, columns] *= factor
        yield words, changed
    for words, order in (
        ("the columns alpha and beta were exchanged", [*range(d, 2 * d), *range(d)]),
        ("tubes were numbered from the innermost one", [*range(d)[::-1], *range(d, 2 * d)[::-1]]),
        *(
            (f"the columns of tubes {i + 1} and {j + 1} were exchanged", _exchange_tubes(d, i, j))
            for i in range(d)
            for j in range(i + 1, d)
        ),
        *(
            (f"the columns beta_{i + 1} and beta_{j + 1} were exchanged", _exchange_tubes(d, i, j, False))
            for i in range(d)
            for j in range(i + 1, d)
        ),
    ):
        changed = np.array(q)
        changed[:, : 2 * d] = q[:, order]
        yield words, changed
    changed = np.array(q)
    changed[:, slides] = np.cumsum(q[:, slides], axis=1)
    yield "each beta was how far a tube comes out of the one around it", changed


def _exchange_tubes(d: int, i: int, j: int, angles: bool = True) -> list[int]:
    """Return the order of the 2d columns alpha, beta with tubes i and j exchanged; angles: alpha, too."""
    order = list(range(2 * d))
    for first in (0, d) if angles else (d,):
        order[first + i], order[first + j] = first + j, first + i
    return order
