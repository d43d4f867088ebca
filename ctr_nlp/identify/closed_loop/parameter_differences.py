"""Differences of a robot from its nominal parameters, as one vector z (k,) with a prior.

Entries are parts of curvatures and stiffnesses, lengths in mm, motors' zeros in rad, a force at the tip in N, and
lags (play) in rad. The prior has the mean and the covariance of the robot's tolerances; measurements change both
(observer.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.closed_loop.prediction import NUMBERS_CHANGED_BY_PART, TUBE_PARTS
from ctr_nlp.robot import Robot, Tolerances
from ctr_nlp.robot.samples import RobotSamples, build_calibrated_robot, perturb_robot
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.typing import Array, Index

MOTOR_ZERO_NAME, ROTATION_LAG_NAME = DEVIATION_NAMES[-1], "rotation_lag"
"""The names of a motor's zero and of a tube's lag behind it."""
FORCE_COMPONENT_NAMES = "force_x", "force_y", "force_z"
"""Components of the force at the tip, N, in the axes of the base; they belong to no tube."""
NO_TUBE = -1
"""Stands for the number of a tube where there is none."""


@dataclass(frozen=True, eq=False)
class ParameterDifferences:
    """The k differences of a robot whose tolerances are not 0: of tubes, then zeros, a force at the tip, and lags.

    robot: the nominal one. entries: tube, from 0, and name of each, as in robot/tolerances.py, or one of
    FORCE_COMPONENT_NAMES. mean (k,), covariance (k, k): of the prior, in parts, mm, rad and N.
    """

    robot: Robot
    entries: tuple[tuple[int, str], ...]
    mean: Array
    covariance: Array

    @classmethod
    def of(cls, robot: Robot, tolerances: Tolerances | None = None) -> ParameterDifferences:
        """Build the differences that tolerances allow; None for the robot's own tolerances.

        A lag is uniform between 0 and its tolerance; a force at the tip has the size of its tolerance and any
        direction. Raises RobotError, and OptionError where all tolerances are 0.
        """
        allowed = robot.tolerances if tolerances is None else tolerances
        d = robot.d
        bands = allowed.bands(robot.tubes)
        lags = allowed.max_backlash(d)
        root = allowed.covariance_root(robot.tubes)
        order = [(i, k) for k in range(len(DEVIATION_NAMES)) for i in range(d) if bands[i, k] > 0]
        rows = [i * len(DEVIATION_NAMES) + k for i, k in order]
        late = np.flatnonzero(lags)
        force = FORCE_COMPONENT_NAMES * (allowed.tip_force > 0)
        forces = ((NO_TUBE, name) for name in force)
        places = (
            *((i, DEVIATION_NAMES[k]) for i, k in order),
            *forces,
            *((int(i), ROTATION_LAG_NAME) for i in late),
        )
        if not places:
            raise OptionError("tolerances of the robot are all 0; give at least one, so that it can be estimated")
        covariance = np.zeros((len(places), len(places)))
        covariance[: len(rows), : len(rows)] = (root @ root.T)[np.ix_(rows, rows)]
        # F^2 / 3 along each axis is the covariance of forces of size F from all sides; l^2 / 12 the variance of a
        # uniform lag, l / 2 its mean.
        others = np.concatenate([np.full(len(force), allowed.tip_force**2 / 3), lags[late] ** 2 / 12])
        covariance[len(rows) :, len(rows) :] = np.diag(others)
        return cls(robot, places, np.concatenate([np.zeros(len(rows) + len(force)), lags[late] / 2]), covariance)

    def __len__(self) -> int:
        return len(self.entries)

    @cached_property
    def tube_parts(self) -> tuple[tuple[int, str], ...]:
        """Tube (from 0) and name of the differences that change numbers of tubes; they are first in the vector."""
        return tuple(place for place in self.entries if place[1] in TUBE_PARTS)

    @cached_property
    def zero_indices(self) -> tuple[Index, Index]:
        """Indices of motors' zeros in the vector, and their tubes, from 0."""
        return self._of(MOTOR_ZERO_NAME)

    @cached_property
    def lag_indices(self) -> tuple[Index, Index]:
        """Indices of lags in the vector, and their tubes, from 0."""
        return self._of(ROTATION_LAG_NAME)

    @cached_property
    def force_indices(self) -> Index:
        """Indices of the components of the force in the vector; empty where none may act."""
        return np.array(
            [k for k, (_, name) in enumerate(self.entries) if name in FORCE_COMPONENT_NAMES], dtype=int
        )

    def _of(self, name: str) -> tuple[Index, Index]:
        found = [(k, tube) for k, (tube, other) in enumerate(self.entries) if other == name]
        rows = np.array(found, dtype=int).reshape(-1, 2)
        return rows[:, 0], rows[:, 1]

    @cached_property
    def _effects(self) -> Array:
        """Derivatives (n, 8 d) of the tubes' numbers (d, 8), flat, over the n differences that change them."""
        found = np.zeros((len(self.tube_parts), *self.robot.numbers.shape))
        for k, (tube, name) in enumerate(self.tube_parts):
            for column in NUMBERS_CHANGED_BY_PART[name]:
                at = TUBE_NUMBER_NAMES.index(column)
                found[k, tube, at] = 1.0 if name == "curved_length" else self.robot.numbers[tube, at]
        return found.reshape(len(self.tube_parts), self.robot.numbers.size)

    def numbers(self, values: Array) -> Array:
        """Return the numbers (d, 8) of the tubes at `values` (k,): linear in these, not clipped as in samples."""
        change = values[: len(self.tube_parts)] @ self._effects
        return self.robot.numbers + change.reshape(self.robot.numbers.shape)

    def offsets(self, values: Array) -> Array:
        """Return the motors' zeros (d,), rad, at `values` (k,)."""
        found, (rows, tubes) = np.zeros(self.robot.d), self.zero_indices
        found[tubes] = values[rows]
        return found

    def lags(self, values: Array) -> Array:
        """Return the tubes' lags (d,), rad, at `values` (k,); at least 0."""
        found, (rows, tubes) = np.zeros(self.robot.d), self.lag_indices
        found[tubes] = np.maximum(values[rows], 0.0)
        return found

    @cached_property
    def derivative_indices(self) -> Index:
        """Indices (k,) of the differences among a PredictedShape's slopes: alpha, beta, theta, parts, force."""
        after = 2 * self.robot.d + 2
        freed = after + np.arange(len(self.tube_parts))
        force = after + len(self.tube_parts) + np.arange(len(self.force_indices))
        # A zero or a lag turns its tube as alpha does.
        return np.concatenate([freed, self.zero_indices[1], force, self.lag_indices[1]])

    def perturbed_robots(self, values: Array) -> RobotSamples:
        """Return the n robots at `values` (n, k), without forces."""
        parts = np.zeros((len(values), self.robot.d, len(DEVIATION_NAMES)))
        lags = np.zeros((len(values), self.robot.d))
        for k, (tube, name) in enumerate(self.entries):
            if name == ROTATION_LAG_NAME:
                lags[:, tube] = np.maximum(values[:, k], 0.0)
            elif name not in FORCE_COMPONENT_NAMES:
                parts[:, tube, DEVIATION_NAMES.index(name)] = values[:, k]
        return perturb_robot(self.robot, parts, lags)

    def robot_at(self, values: Array, covariance: Array) -> Robot:
        """Return the robot at `values` (k,), with a covariance (k, k) as its tolerances and limits of its tubes.

        Raises RobotError where no such tubes can be made.
        """
        d = self.robot.d
        among = [k for k, (_, name) in enumerate(self.entries) if name in DEVIATION_NAMES]
        places = [
            tube * len(DEVIATION_NAMES) + DEVIATION_NAMES.index(name)
            for tube, name in (self.entries[k] for k in among)
        ]
        parts = np.zeros(d * len(DEVIATION_NAMES))
        left = np.zeros((d * len(DEVIATION_NAMES), d * len(DEVIATION_NAMES)))
        parts[places] = values[among]
        left[np.ix_(places, places)] = covariance[np.ix_(among, among)]
        found = build_calibrated_robot(self.robot, parts.reshape(d, -1), left, 0.0)
        # Its alpha is that of the tubes, which is off the motors' by their zeros: the motors' limits move along.
        zeros = self.offsets(values)
        alpha = zip(self.robot.lower[:d] + zeros, self.robot.upper[:d] + zeros, strict=True)
        return replace(found, limits=replace(found.limits, alpha=tuple(alpha)))

    def values_by_name(self, values: Sequence[float]) -> dict[str, float]:
        """Return `values` (k,) by name, as "curvature of tube 1" or "force_x"."""
        names = [
            name if name in FORCE_COMPONENT_NAMES else f"{name} of tube {tube + 1}" for tube, name in self.entries
        ]
        return dict(zip(names, map(float, values), strict=True))
