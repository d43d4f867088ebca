"""Sensors of points of the shape, and of the tip's position and direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctr_nlp.identify.closed_loop.sensors import SensedShape, Sensor
from ctr_nlp.identify.closed_loop.sensors.checks import check_positive, checked_places
from ctr_nlp.typing import Array


@dataclass(frozen=True, eq=False)
class ShapePointSensor(Sensor):
    """Points of the robot at known sigma, `places`; deviation: of each coordinate, mm. Raises OptionError."""

    places: Sequence[float]
    deviation: float = 0.5

    def __post_init__(self) -> None:
        check_positive("deviation of shape points", self.deviation, " mm")
        checked_places(self.places)

    @property
    def sigma(self) -> Array:
        """Points (n,), from 0 at the insertion point to 1 at the tip."""
        return checked_places(self.places)

    @property
    def noise(self) -> Array:
        """Standard deviations (3n,) of the coordinates, mm."""
        return np.full(3 * len(self.places), self.deviation)

    def values(self, shape: SensedShape) -> Array:
        """Return the coordinates (3n,) of a shape's points, mm: x, y and z of one point after the other."""
        return shape.points.ravel()

    def slopes(self, shape: SensedShape) -> Array:
        """Return the derivatives (3n, k) of the coordinates of a shape's points."""
        return shape.of_points.reshape(len(shape.of_points), -1).T


class TipPositionSensor(ShapePointSensor):
    """The tip's position, as of an electromagnetic tracker; deviation: of each coordinate, mm."""

    def __init__(self, deviation: float = 0.5) -> None:
        super().__init__((1.0,), deviation)


@dataclass(frozen=True, eq=False)
class TipPoseSensor(Sensor):
    """The tip's position, mm, and its direction as a unit vector.

    deviation: of each coordinate, mm. turn: of each component of the direction, rad.
    """

    deviation: float = 0.5
    turn: float = 0.02

    def __post_init__(self) -> None:
        check_positive("deviation of the tip's position", self.deviation, " mm")
        check_positive("deviation of the tip's direction", self.turn, " rad")

    @property
    def sigma(self) -> Array:
        """Sigma of the tip, 1, as an array (1,)."""
        return np.ones(1)

    @property
    def noise(self) -> Array:
        """Standard deviations (6,): of the position, mm, then of the direction, rad."""
        return np.repeat([self.deviation, self.turn], 3)

    def values(self, shape: SensedShape) -> Array:
        """Return the tip's position, mm, then its direction, (6,), of a shape."""
        return np.concatenate([shape.points[0], shape.tangents[0]])

    def slopes(self, shape: SensedShape) -> Array:
        """Return the derivatives (6, k) of position and direction of a shape's tip."""
        return np.concatenate([shape.of_points[:, 0], shape.of_tangents[:, 0]], axis=1).T
