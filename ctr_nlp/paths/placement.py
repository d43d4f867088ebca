"""Placing a path before the robot: its first point at the insertion point, its first direction along +z."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.paths.curve import Curve
from ctr_nlp.typing import Array

INSERTION_HEADING_MM = 10.0
"""Length over which the mean direction of a path becomes the insertion direction, mm."""


def move_to_robot_frame(curve: Curve, direction: npt.ArrayLike | None = None) -> tuple[Curve, Array]:
    """Move a curve before the robot.

    Its first point goes to the origin, and the insertion direction turns to +z by the smallest rotation.

    Parameters
    ----------
    curve : Curve
        A path in the axes of its file, mm.
    direction : array_like, optional
        Insertion direction (3,) of any length in the same axes; by default the mean direction of the curve over
        its first 10 mm.

    Returns
    -------
    curve : Curve
        The path in the robot's frame.
    to_robot : ndarray
        Rigid transform (4, 4) from the axes of the file to the robot's frame, translation in mm.

    Raises
    ------
    CurveError
        The direction leads away from the path, or the path returns to its start within 10 mm.
    OptionError
        `direction` is no direction.
    """
    heading = _heading(curve)
    if direction is not None:
        given = normalise_direction(direction)
        if heading is not None and given @ heading <= 0:
            angle = np.degrees(np.arccos(np.clip(given @ heading, -1.0, 1.0)))
            raise CurveError(
                f"the insertion direction is {angle:.0f} degrees away from where the path leads over its first "
                f"{INSERTION_HEADING_MM:g} mm; it must be within 90"
            )
        heading = given
    if heading is None:
        raise CurveError(
            f"the path returns to its start within {INSERTION_HEADING_MM:g} mm; no insertion direction"
        )
    # The smallest rotation is about heading x z. Where the heading is -z, every horizontal axis will do: x is
    # taken.
    axis = np.cross(heading, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    cosine = heading[2]
    about = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    # The angle from sine and cosine together: arccos alone loses half of the digits near 0 and pi.
    rotation = Rotation.from_rotvec(np.arctan2(sine, cosine) * about).as_matrix()
    to_robot = np.eye(4)
    # x -> R x - R x(0) takes the first point to the origin.
    to_robot[:3, :3], to_robot[:3, 3] = rotation, -rotation @ curve.point(np.zeros(1))[0]
    return curve.apply_transform(to_robot), to_robot


def normalise_direction(direction: npt.ArrayLike) -> Array:
    """Normalise an insertion direction.

    Parameters
    ----------
    direction : array_like
        Vector (3,) of any length but 0.

    Returns
    -------
    ndarray
        Unit vector (3,).

    Raises
    ------
    OptionError
        It is not three finite numbers, or all of them are 0.
    """
    try:
        given = np.asarray(direction, dtype=float)
    except (TypeError, ValueError):
        given = np.empty(0)
    if given.shape != (3,) or not np.isfinite(given).all() or not given.any():
        raise OptionError(
            f"insertion direction is {direction!r}; it must be three finite numbers, not all of them 0"
        )
    # Scaled first: squares of very large or very small numbers would overflow or vanish.
    scaled = given / np.abs(given).max()
    return np.asarray(scaled / np.linalg.norm(scaled))


def trim_curve(curve: Curve, longest: float, drop: Literal["start", "end"]) -> Curve:
    """Cut a curve to a length.

    Parameters
    ----------
    curve : Curve
        The curve.
    longest : float
        Largest length, mm; a curve that is no longer is returned as it is.
    drop : str
        ``"start"`` or ``"end"``: where the rest is dropped.

    Returns
    -------
    Curve
        A curve of at most this length.
    """
    if curve.length <= longest:
        return curve
    return curve.part(curve.length - longest, curve.length) if drop == "start" else curve.part(0.0, longest)


def _heading(curve: Curve) -> Array | None:
    """Return the mean direction (3,) of a curve over its first 10 mm; None where it returns to its start."""
    start, end = curve.point(np.array([0.0, min(INSERTION_HEADING_MM, curve.length)]))
    length = float(np.linalg.norm(end - start))
    return None if length < 1e-9 else np.asarray((end - start) / length)
