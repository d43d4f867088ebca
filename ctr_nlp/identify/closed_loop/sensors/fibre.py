"""Fibre sensor: curvature between points of the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.closed_loop.sensors import SensedShape, Sensor
from ctr_nlp.identify.closed_loop.sensors.checks import check_positive, checked_places
from ctr_nlp.typing import Array


@dataclass(frozen=True, eq=False)
class FibreSensor(Sensor):
    """Unsigned curvature, 1/mm, of a fibre in the robot between neighbouring points.

    places: the points, sigma from 0 to 1. The curvature between two of them is the distance of their unit tangents
    over the length between them. deviation: standard deviation, 1/mm.
    """

    places: Sequence[float] = field(default_factory=lambda: tuple(np.linspace(0.0, 1.0, 11).tolist()))
    deviation: float = 5e-4
    group = 1

    def __post_init__(self) -> None:
        check_positive("deviation of a fibre", self.deviation, " 1/mm")
        if len(checked_places(self.places)) < 2:
            raise OptionError("a fibre needs two places at least")

    @property
    def sigma(self) -> Array:
        """Points (n,) of the fibre, from 0 at the insertion point to 1 at the tip."""
        return checked_places(self.places)

    @property
    def noise(self) -> Array:
        """Standard deviations (n - 1,) of the curvatures, 1/mm."""
        return np.full(len(self.places) - 1, self.deviation)

    def values(self, shape: SensedShape) -> Array:
        """Return the curvature (n - 1,) of a shape between each point and the next, 1/mm."""
        turned = np.diff(shape.tangents, axis=0)
        return np.linalg.norm(turned, axis=1) / (np.diff(self.sigma) * shape.length)

    def slopes(self, shape: SensedShape) -> Array:
        """Return the derivatives (n - 1, k) of the curvatures of a shape."""
        turned = np.diff(shape.tangents, axis=0)
        of_turned = np.diff(shape.of_tangents, axis=1)
        # d|v| = v . dv / |v|; a straight fibre has no direction in which it bends, and slopes of 0.
        size = np.maximum(np.linalg.norm(turned, axis=1), 1e-9)
        slopes = np.einsum("kni,ni->kn", of_turned, turned / size[:, None]) / (np.diff(self.sigma) * shape.length)
        return slopes.T
