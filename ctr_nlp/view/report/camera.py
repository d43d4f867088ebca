"""Cameras of a scene: from the side, from the top, and from the robot's tip."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array

OUTSIDE_FIELD_OF_VIEW_DEG, EYE_FIELD_OF_VIEW_DEG = 30.0, 80.0
"""Vertical fields of view: from outside, and from the tip, as an endoscope's."""
EYE_DISTANCE_AHEAD_MM = 1.0
"""Distance of the eye ahead of the tip, mm, so that it looks past the tip's own rim."""
CAMERA_MARGIN = 1.04
"""Distance of a camera over the one from which a scene just fits its window."""
MIN_TIP_DIRECTION_SINE = 1e-9
"""Sine of the angle between tip and z axis below which the axis of rotation is not defined."""


def cameras(low: Array, high: Array, axes: Array) -> dict[str, list[float]]:
    """Return position, point looked at and upward direction of each preset camera, 9 numbers in mm.

    low, high: corners (3,), mm, of the box that is seen. axes: rotation (3, 3) of picture_axes. The side is the
    one from which most is seen, or the front of a patient, a little from above. In both, the box fits a square
    window.
    """
    size = high - low
    # A patient is looked at from in front, whatever the lesion's side: these axes are then not the robot's own.
    in_front = size[0] >= size[1] or not np.array_equal(axes, np.eye(3))
    side = axes.T @ ([0.25, -1.0, 0.2] if in_front else [1.0, 0.25, 0.2])
    return {
        "side": _from(np.asarray(side), axes[2], low, high),
        "top": _from(axes[2], axes[1], low, high),
    }


def _from(away: Array, up: Array, low: Array, high: Array) -> list[float]:
    """Return the camera that looks at a box from the direction `away` (3,), with `up` (3,) upwards.

    low, high: corners (3,) of the box, mm.
    """
    middle = (low + high) / 2
    ahead = -away / np.linalg.norm(away)
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    corners = np.array(list(itertools.product(*zip(low, high, strict=True)))) - middle
    # A corner is seen at the edge of the window where its distance from the line of sight is the tangent of half
    # the field of view times its depth before the camera.
    aside = np.abs(np.stack([corners @ right, corners @ np.cross(right, ahead)])).max(axis=0)
    tangent = np.tan(np.radians(OUTSIDE_FIELD_OF_VIEW_DEG / 2))
    far = CAMERA_MARGIN * float((aside / tangent - corners @ ahead).max())
    return [*(middle - far * ahead).tolist(), *middle.tolist(), *up.tolist()]


def eyes(plan: Plan) -> list[list[float] | None]:
    """Return the camera at the tip of `plan` in every frame, 9 numbers as in cameras; None in frames that were not
    reached.

    It looks along the tip's direction. Its upward direction is y, turned by the smallest rotation that turns z
    into that direction, so that the picture does not spin as the robot advances.
    """
    frames = zip(plan.reached_frames, plan.shape[:, -1], plan.tip_direction, strict=True)
    return [_eye(tip, along) if reached else None for reached, tip, along in frames]


def _eye(tip: Array, along: Array) -> list[float]:
    """Return the camera at a tip (3,), mm, that looks along a unit vector (3,)."""
    place = tip + EYE_DISTANCE_AHEAD_MM * along
    numbers: list[float] = np.round([*place, *(place + 10 * along), *upward_at_tip(along)], 4).tolist()
    return numbers


def upward_at_tip(along: Array) -> Array:
    """Return the y axis turned by the smallest rotation that turns z into a unit vector `along` (3,)."""
    axis = np.cross([0.0, 0.0, 1.0], along)
    sine = np.linalg.norm(axis)
    if sine < MIN_TIP_DIRECTION_SINE:
        # Backwards, every axis at right angles to z gives a smallest rotation; the half turn about x takes y to
        # -y.
        return np.array([0.0, np.sign(along[2]), 0.0])
    turned: Array = Rotation.from_rotvec(axis / sine * np.arctan2(sine, along[2])).apply([0.0, 1.0, 0.0])
    return turned
