"""Sensor of points of the shape in images of known geometry, as of two fluoroscopes (pinhole cameras)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.closed_loop.sensors import SensedShape, Sensor
from ctr_nlp.identify.closed_loop.sensors.checks import check_positive, checked_places
from ctr_nlp.support.value_checks import floats
from ctr_nlp.typing import Array


@dataclass(frozen=True, eq=False)
class ViewSensor(Sensor):
    """Points of the robot at known sigma, `places`, in images of known geometry, as of two fluoroscopes.

    projections (v, 3, 4): from homogeneous points, mm, to homogeneous coordinates in each image, in its units.
    deviation: of each coordinate there. Raises OptionError.
    """

    places: Sequence[float]
    projections: Array
    deviation: float = 0.5
    group = 2

    def __post_init__(self) -> None:
        check_positive("deviation of views", self.deviation, "")
        checked_places(self.places)
        floats(OptionError, "projections of views", np.asarray(self.projections), (None, 3, 4))

    @property
    def sigma(self) -> Array:
        """Points (n,), from 0 at the insertion point to 1 at the tip."""
        return checked_places(self.places)

    @property
    def noise(self) -> Array:
        """Standard deviations (2 v n,) of the coordinates in v images, in units of these."""
        return np.full(2 * len(self.projections) * len(self.places), self.deviation)

    def _homogeneous(self, points: Array) -> Array:
        """Return the homogeneous coordinates (v, .., 3) of directions (.., 3), without the projections' offset."""
        turned: Array = np.einsum("vij,...j->v...i", self.projections[:, :, :3], points)
        return turned

    def values(self, shape: SensedShape) -> Array:
        """Return the coordinates (2 v n,) of a shape's points, image by image, point by point."""
        found = self._homogeneous(shape.points) + self.projections[:, None, :, 3]
        return (found[..., :2] / found[..., 2:]).ravel()

    def slopes(self, shape: SensedShape) -> Array:
        """Return the derivatives (2 v n, k) of the coordinates of a shape's points."""
        found = self._homogeneous(shape.points) + self.projections[:, None, :, 3]
        turned = self._homogeneous(shape.of_points)
        depth = found[:, None, :, 2:]
        places = (found[..., :2] / found[..., 2:])[:, None]
        # Derivative of the quotient p = n / w by which points are projected: dp = (dn - p dw) / w.
        slopes = (turned[..., :2] - places * turned[..., 2:]) / depth
        return slopes.swapaxes(0, 1).reshape(len(shape.of_points), -1).T


def view(source: Array, centre: Array, up: Array, magnification: float = 1.0) -> Array:
    """Return the projection (3, 4) from a source (3,), mm, onto the plane through centre (3,) that faces it.

    up: (3,), second axis of the image, projected onto the plane. magnification: image units per mm at the centre.
    Raises OptionError where source, centre and up are degenerate.
    """
    away = np.asarray(centre, dtype=float) - source
    distance = float(np.linalg.norm(away))
    right = np.cross(away, up)
    if not distance > 0 or not np.linalg.norm(right) > 0:
        raise OptionError(
            "a view needs a source away from its centre, and an up that does not point along the ray"
        )
    across = right / np.linalg.norm(right)
    turned = np.stack([across, np.cross(across, away / distance), away / distance])
    scaled = np.diag([magnification * distance, magnification * distance, 1.0]) @ turned
    return np.column_stack([scaled, -scaled @ source])
