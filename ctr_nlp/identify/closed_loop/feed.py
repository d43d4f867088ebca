"""Simulated readings of a plant by sensors, with noise, latency, and faults of the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.sensors import Reading, SensedShape, Sensors
from ctr_nlp.typing import Array, Index

Random = np.random.Generator


@dataclass(frozen=True)
class SensorFault:
    """A fault of a sensor from one time until another, s. This base class changes nothing."""

    begin: float = 0.0
    end: float = np.inf

    def is_active_at(self, time: float) -> bool:
        """Return whether the fault is present at a time, s."""
        return self.begin <= time < self.end

    def distort_shape(self, shape: SensedShape) -> SensedShape:
        """Return the shape that the faulty sensor measures instead of the real one."""
        return shape

    def distort_values(
        self, values: Array, before: Array | None, random: Random, groups: Sequence[Index]
    ) -> Array:
        """Return the values (m,) that the faulty sensor reports instead of its values (m,).

        before: (m,), values that were reported last, or None. random: generator of random numbers. groups: rows of
        values that belong together (Sensors.value_groups).
        """
        return values


@dataclass(frozen=True)
class Silence(SensorFault):
    """All values are missing."""

    def distort_values(
        self, values: Array, before: Array | None, random: Random, groups: Sequence[Index]
    ) -> Array:
        """Return NaN for all values (m,); before, random and groups are not used."""
        return np.full_like(values, np.nan)


@dataclass(frozen=True)
class Outliers(SensorFault):
    """A share of the groups of values is off by size, in a direction of its own each time."""

    share: float = 0.3
    size: float = 20.0

    def distort_values(
        self, values: Array, before: Array | None, random: Random, groups: Sequence[Index]
    ) -> Array:
        """Return values (m,) of which a share of the groups is off by size, in a random direction each.

        random: generator of random numbers. groups: rows of values that belong together; before is not used.
        """
        found = values.copy()
        for rows in groups:
            off = random.standard_normal(rows.shape)
            off *= self.size / np.linalg.norm(off, axis=1, keepdims=True)
            found[rows] += np.where(random.random(len(rows))[:, None] < self.share, off, 0.0)
        return found


@dataclass(frozen=True)
class LateReadings(SensorFault):
    """Values are `delay` s old, and are reported with the present time."""

    delay: float = 0.2


@dataclass(frozen=True)
class ShiftedPoints(SensorFault):
    """A registration that jumps: points are off by (x, y, z), mm."""

    offset: tuple[float, float, float] = (2.0, 0.0, 0.0)

    def distort_shape(self, shape: SensedShape) -> SensedShape:
        """Return the shape with its points shifted by the offset, mm."""
        return shape._replace(points=shape.points + self.offset)


@dataclass(frozen=True)
class SwappedAxes(SensorFault):
    """Axes are exchanged."""

    axes: tuple[int, int, int] = (1, 0, 2)

    def distort_shape(self, shape: SensedShape) -> SensedShape:
        """Return the shape with exchanged axes, of points and tangents."""
        order = list(self.axes)
        return shape._replace(points=shape.points[:, order], tangents=shape.tangents[:, order])


@dataclass(frozen=True)
class StuckReadings(SensorFault):
    """The last values are reported again and again."""

    def distort_values(
        self, values: Array, before: Array | None, random: Random, groups: Sequence[Index]
    ) -> Array:
        """Return `before`, the values (m,) that were reported last; `values` (m,) where there are none yet.

        random and groups are not used.
        """
        return values if before is None else before


class Feed:
    """Readings of a plant, as they arrive; the same seed gives the same noise.

    latency: delay, s, with which readings arrive, stamped with the time at which they were taken. dropped: share
    of readings that never arrive. faults: of the sensors. noise: factor of the sensors' own noise.
    """

    def __init__(
        self,
        plant: Plant,
        sensors: Sensors,
        seed: int = 0,
        latency: float = 0.0,
        dropped: float = 0.0,
        faults: Sequence[SensorFault] = (),
        noise: float = 1.0,
    ) -> None:
        self._plant = plant
        self._sensors = sensors
        self._random = np.random.default_rng([seed, 3])
        self._latency = latency
        self._dropped = dropped
        self._faults = tuple(faults)
        self._noise = noise
        self._waiting = list[Reading]()
        self._taken = list[Reading]()
        self._told: Array | None = None

    def take_readings(self, time: float) -> list[Reading]:
        """Measure at a time, s, and return the readings that arrive by then."""
        faults = [fault for fault in self._faults if fault.is_active_at(time)]
        seen = self._plant.sample_shape(self._sensors.sigma)
        for fault in faults:
            seen = fault.distort_shape(seen)
        # Faults of the shape come before the noise, those of values after it: a stuck sensor has no noise.
        noise = self._random.standard_normal(len(self._sensors)) * self._sensors.noise
        values = self._sensors.values(seen) + self._noise * noise
        self._taken.append(Reading(time, values))
        for fault in faults:
            if isinstance(fault, LateReadings):
                values = self._earlier(time - fault.delay)
            values = fault.distort_values(values, self._told, self._random, self._sensors.value_groups)
        if np.isfinite(values).any():
            self._told = values
        if self._random.random() >= self._dropped:
            self._waiting.append(Reading(time, values))
        due = [each for each in self._waiting if each.time + self._latency <= time + 1e-9]
        self._waiting = [each for each in self._waiting if each.time + self._latency > time + 1e-9]
        return [each for each in due if np.isfinite(each.values).any()]

    def _earlier(self, time: float) -> Array:
        """Return the last values taken by a time, s; the first ones where there are none."""
        return next((r.values for r in self._taken[::-1] if r.time <= time + 1e-9), self._taken[0].values)
