"""Measurements of a robot: its configurations, and the values that a sensor measured of its shape at each."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

import numpy as np

from ctr_nlp.exceptions import MeasurementError, RobotError
from ctr_nlp.robot import Robot
from ctr_nlp.robot.checks import check_angle
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags, Index

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

    def __post_init__(self) -> None:
        count = len(self.q)
        if self.force.shape == (3,):
            object.__setattr__(self, "force", np.tile(self.force, (count, 1)))
        wanted = {
            **dict.fromkeys(("tip", "direction", "force"), (count, 3)),
            **dict.fromkeys(("time", "recording"), (count,)),
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
        arrays = {f.name: getattr(self, f.name)[chosen] for f in fields(self) if f.name != "repeated"}
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
        lengths = np.array([tube.length for tube in robot.tubes])
        for row, q in enumerate(self.q, start=1):
            _check_configuration(robot, row, q, lengths)
        for row, (sigma, points) in enumerate(zip(self.sigma, self.points, strict=True), start=1):
            known = np.isfinite(points).any(axis=1)
            if known.any() and not ((sigma[known] >= 0) & (sigma[known] <= 1 + 1e-9)).all():
                raise MeasurementError(
                    f"observation {row}: a point lies at sigma {sigma[known].tolist()}; it must lie in [0, 1]"
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


def _check_configuration(robot: Robot, row: int, q: Array, lengths: Array) -> None:
    """Raise MeasurementError unless a robot of tubes of lengths (d,), mm, can be at q (2d + 2,).

    row: the observation's number, from 1, for messages.
    """
    where = f"of observation {row}"
    for axis, value in zip(robot.axes, q, strict=True):
        if not math.isfinite(value):
            raise MeasurementError(f"{axis} {where} is {value}; it must be a number, in rad or mm")
        if not axis.startswith("beta"):
            try:
                check_angle(f"{axis} {where} is {value:g} rad, and it", axis, value)
            except RobotError as error:
                raise MeasurementError(str(error)) from error
    beta = robot.split(q)[1]
    before = 0.0
    for i, (value, length) in enumerate(zip(beta, lengths, strict=True), start=1):
        if not before - EXTENSION_TOLERANCE_MM <= value <= length + EXTENSION_TOLERANCE_MM:
            least = f"beta_{i - 1}, {before:g}" if i > 1 else "0"
            raise MeasurementError(
                f"beta_{i} {where} is {value:g} mm; it must lie between {least} mm and the tube's length, "
                f"{length:g} mm"
            )
        before = value
    if beta[-1] <= 0:
        raise MeasurementError(f"beta_{robot.d} {where} is {beta[-1]:g} mm; it must be positive")
