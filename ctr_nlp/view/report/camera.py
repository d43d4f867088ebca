"""Where a scene is looked at from: the side, the top, and the eye of the robot's tip."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array

OUTSIDE_FIELD_OF_VIEW_DEG, EYE_FIELD_OF_VIEW_DEG = 30.0, 80.0
"""Fields of view in degrees, from top to bottom: from outside, and from the tip, as an endoscope's."""
EYE_DISTANCE_AHEAD_MM = 1.0
"""Distance of the eye ahead of the tip, mm, so that it looks past the tip's own rim."""
MIN_TIP_DIRECTION_SINE = 1e-9
"""A tip that looks back along -z by less than this is turned about x."""


def cameras(low: Array, high: Array) -> dict[str, list[float]]:
    """Position, point looked at and upward direction of each preset, 9 numbers, for a box of corners (3,) mm.

    The side is the one from which most is seen, a little from above. In both, the box fits a square window.
    """
    size = high - low
    side = [0.25, -1.0, 0.2] if size[0] >= size[1] else [1.0, 0.25, 0.2]
    return {
        "side": _from(np.array(side), [0.0, 0.0, 1.0], low, high),
        "top": _from(np.array([0.0, 0.0, 1.0]), [0.0, 1.0, 0.0], low, high),
    }


def _from(away: Array, up: list[float], low: Array, high: Array) -> list[float]:
    middle = (low + high) / 2
    far = 0.6 * np.linalg.norm(high - low) / np.tan(np.radians(OUTSIDE_FIELD_OF_VIEW_DEG / 2))
    return [*(middle + far * away / np.linalg.norm(away)).tolist(), *middle.tolist(), *up]


def eyes(plan: Plan) -> list[list[float] | None]:
    """The camera of the tip's eye in every frame, as those of `cameras`; None in frames that were not reached.

    It looks along the tip's direction. Its upward direction is y, turned by the smallest rotation that turns z
    into that direction, so that the picture does not spin as the robot advances.
    """
    frames = zip(plan.reached_frames, plan.shape[:, -1], plan.tip_direction, strict=True)
    return [_eye(tip, along) if reached else None for reached, tip, along in frames]


def _eye(tip: Array, along: Array) -> list[float]:
    place = tip + EYE_DISTANCE_AHEAD_MM * along
    numbers: list[float] = np.round([*place, *(place + 10 * along), *_upward(along)], 4).tolist()
    return numbers


def _upward(along: Array) -> Array:
    """The y axis turned by the smallest rotation that turns z into a unit vector (3,)."""
    axis = np.cross([0.0, 0.0, 1.0], along)
    sine = np.linalg.norm(axis)
    if sine < MIN_TIP_DIRECTION_SINE:
        return np.array([0.0, np.sign(along[2]), 0.0])
    turned: Array = Rotation.from_rotvec(axis / sine * np.arctan2(sine, along[2])).apply([0.0, 1.0, 0.0])
    return turned
