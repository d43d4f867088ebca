"""Sensors: what each would measure of a shape, and how that changes as the shape does.

A sensor looks at places of the robot of its own. Its values come in groups that are right or wrong together, as
the three coordinates of a point.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.typing import Array, Index


class SensedShape(NamedTuple):
    """A robot's shape at n places, and its slopes over k variables.

    points (n, 3) mm, tangents (n, 3); of_points, of_tangents (k, n, 3). length: of the robot, mm, which the
    variables do not change.
    """

    points: Array
    tangents: Array
    of_points: Array
    of_tangents: Array
    length: float


class Sensor(ABC):
    """One sensor. sigma (n,): the places it looks at. noise (m,): standard deviations of its values, in their
    units.

    group: how many of its values, one after the other, are right or wrong together.
    """

    group = 3

    @property
    @abstractmethod
    def sigma(self) -> Array:
        """The places, from 0 at the insertion point to 1 at the tip."""

    @property
    @abstractmethod
    def noise(self) -> Array:
        """Standard deviations (m,)."""

    @abstractmethod
    def values(self, shape: SensedShape) -> Array:
        """Return the values (m,) that the sensor would measure without noise."""

    @abstractmethod
    def slopes(self, shape: SensedShape) -> Array:
        """Return the derivatives (m, k) of these values over the variables."""


class Sensors:
    """Several sensors as one. sigma (n,), noise (m,): of all.

    value_groups: the places (groups, size) of values that are right or wrong together, an array for every size of
    groups.
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
        """How many values there are in a reading."""
        return len(self.noise)

    def _parts(self, shape: SensedShape) -> list[SensedShape]:
        points, tangents, of_points, of_tangents, length = shape
        return [
            SensedShape(points[at], tangents[at], of_points[:, at], of_tangents[:, at], length)
            for at in self._places
        ]

    def values(self, shape: SensedShape) -> Array:
        """Return the values (m,) that all sensors would measure without noise."""
        return np.concatenate([s.values(part) for s, part in zip(self._sensors, self._parts(shape), strict=True)])

    def slopes(self, shape: SensedShape) -> Array:
        """Return the derivatives (m, k) of these values over the variables."""
        return np.concatenate([s.slopes(part) for s, part in zip(self._sensors, self._parts(shape), strict=True)])


class Reading(NamedTuple):
    """A reading of all sensors: values (m,), NaN where one is missing, of the moment `time`, s, that the sensors
    state.
    """

    time: float
    values: Array
