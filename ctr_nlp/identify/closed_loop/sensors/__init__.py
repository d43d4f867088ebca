"""Sensors: measurement functions of a shape, and their derivatives.

Each sensor measures at points of the robot of its own. Its values come in groups that are right or wrong together,
such as the three coordinates of a point.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.typing import Array, Index


class SensedShape(NamedTuple):
    """A robot's shape at n points, and its slopes over k variables.

    points (n, 3): in mm. tangents (n, 3): unit vectors. of_points, of_tangents (k, n, 3): their slopes. length: of
    the robot, mm, which does not depend on the variables.
    """

    points: Array
    tangents: Array
    of_points: Array
    of_tangents: Array
    length: float


class Sensor(ABC):
    """One sensor.

    sigma (n,): points at which it measures. noise (m,): standard deviations of its values, in their units. group:
    number of consecutive values that are right or wrong together.
    """

    group = 3

    @property
    @abstractmethod
    def sigma(self) -> Array:
        """Points (n,) at which the sensor measures, from 0 at the insertion point to 1 at the tip."""

    @property
    @abstractmethod
    def noise(self) -> Array:
        """Standard deviations (m,) of the values."""

    @abstractmethod
    def values(self, shape: SensedShape) -> Array:
        """Return the values (m,) that the sensor would measure of a shape without noise."""

    @abstractmethod
    def slopes(self, shape: SensedShape) -> Array:
        """Return the derivatives (m, k) of the values over the variables of the shape's slopes."""


class Sensors:
    """Several sensors as one.

    sigma (n,), noise (m,): of all. value_groups: indices (groups, size) of values that are right or wrong
    together, an array for every size of groups.
    """

    def __init__(self, *sensors: Sensor) -> None:
        if not sensors or not all(isinstance(each, Sensor) for each in sensors):
            raise OptionError(f"sensors are {sensors!r:.80}; give one Sensor or more")
        self._sensors = sensors
        counts = [len(each.sigma) for each in sensors]
        ends = np.cumsum(counts)
        self._places = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
        self.sigma = np.concatenate([each.sigma for each in sensors])
        self.noise = np.concatenate([each.noise for each in sensors])
        begins = np.cumsum([0, *(len(each.noise) for each in sensors)])
        rows: dict[int, list[Index]] = {}
        for each, begin in zip(sensors, begins, strict=False):
            own = begin + np.arange(len(each.noise)).reshape(-1, each.group)
            rows.setdefault(each.group, []).append(own)
        self.value_groups = [np.concatenate(some) for some in rows.values()]

    def __len__(self) -> int:
        """Number of values in a reading."""
        return len(self.noise)

    def _parts(self, shape: SensedShape) -> list[SensedShape]:
        points, tangents, of_points, of_tangents, length = shape
        return [
            SensedShape(points[at], tangents[at], of_points[:, at], of_tangents[:, at], length)
            for at in self._places
        ]

    def values(self, shape: SensedShape) -> Array:
        """Return the values (m,) that all sensors would measure of a shape without noise."""
        return np.concatenate([s.values(part) for s, part in zip(self._sensors, self._parts(shape), strict=True)])

    def slopes(self, shape: SensedShape) -> Array:
        """Return the derivatives (m, k) of the values over the variables of the shape's slopes."""
        return np.concatenate([s.slopes(part) for s, part in zip(self._sensors, self._parts(shape), strict=True)])


class Reading(NamedTuple):
    """A reading of all sensors: values (m,), NaN where one is missing, with their time stamp, s."""

    time: float
    values: Array
