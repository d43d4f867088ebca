"""Moving a path before the robot."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.target.curve import Curve
from ctr_nlp.typing import Array

HEADING_MM = 10.0
"""The mean direction over this first length becomes the insertion direction."""


def placed(curve: Curve, direction: npt.ArrayLike | None = None) -> tuple[Curve, Array]:
    """Move a curve before the robot; also the rigid transform (4, 4) from the curve's axes to the robot's.

    Its first point goes to the origin; the insertion direction turns to +z by the smallest rotation. direction:
    (3,) of any length in the curve's axes, by default the curve's mean direction over its first 10 mm. Raises
    CurveError, also where direction leads away from the path, and OptionError where it is none.
    """
    heading = _heading(curve)
    if direction is not None:
        given = unit(direction)
        if heading is not None and given @ heading <= 0:
            angle = np.degrees(np.arccos(np.clip(given @ heading, -1.0, 1.0)))
            raise CurveError(
                f"the insertion direction is {angle:.0f} degrees away from where the path leads over its first "
                f"{HEADING_MM:g} mm; it must be within 90"
            )
        heading = given
    if heading is None:
        raise CurveError(f"the path returns to its start within {HEADING_MM:g} mm; no insertion direction")
    axis = np.cross(heading, [0.0, 0.0, 1.0])
    sine, cosine = np.linalg.norm(axis), heading[2]
    about = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    rotation = Rotation.from_rotvec(np.arctan2(sine, cosine) * about).as_matrix()
    to_robot = np.eye(4)
    to_robot[:3, :3], to_robot[:3, 3] = rotation, -rotation @ curve.point(np.zeros(1))[0]
    return curve.moved(to_robot), to_robot


def unit(direction: npt.ArrayLike) -> Array:
    """An insertion direction (3,) of any length as a unit vector; raises OptionError."""
    try:
        given = np.asarray(direction, dtype=float)
    except (TypeError, ValueError):
        given = np.empty(0)
    if given.shape != (3,) or not np.isfinite(given).all() or not given.any():
        raise OptionError(
            f"insertion direction is {direction!r}; it must be three finite numbers, not all of them 0"
        )
    scaled = given / np.abs(given).max()
    return np.asarray(scaled / np.linalg.norm(scaled))


def trimmed(curve: Curve, longest: float, drop: Literal["start", "end"]) -> Curve:
    """The curve without what exceeds longest mm, dropped at its start or its end."""
    if curve.length <= longest:
        return curve
    return curve.part(curve.length - longest, curve.length) if drop == "start" else curve.part(0.0, longest)


def _heading(curve: Curve) -> Array | None:
    """Mean direction (3,) over the first length of a curve; None where it returns to its start."""
    start, end = curve.point(np.array([0.0, min(HEADING_MM, curve.length)]))
    length = float(np.linalg.norm(end - start))
    return None if length < 1e-9 else np.asarray((end - start) / length)
