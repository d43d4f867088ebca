"""Which way up pictures of a plan are: superior up, seen from the front, where a patient's directions are known.

A robot that enters from above is inserted downwards, against its own z axis. Physicians look at pictures of
patients with the head up, as from in front of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array

OPPOSITE_DIRECTIONS = {"R": "L", "L": "R", "A": "P", "P": "A", "S": "I", "I": "S"}
"""Opposite of each direction of a patient: right, left, anterior, posterior, superior, inferior."""
SAME_ORIENTATION_TOLERANCE = 1e-6
"""Largest difference of the rotations of plans that are shown the same way up."""


class MatplotlibView(NamedTuple):
    """View of matplotlib's axes in space, degrees: elevation, azimuth and roll."""

    elevation: float
    azimuth: float
    roll: float


def has_patient_directions(space: str) -> bool:
    """Tell whether the axes of a file are named after directions of the patient, as LPS and RAS are."""
    return bool(space) and set(space) <= set(OPPOSITE_DIRECTIONS)


def axis_directions(to_robot: Array) -> Array:
    """Return the unit vectors (3, 3) of a file's axes, one a row, in the robot's frame.

    to_robot: transform (4, 4) from the file to the robot's frame.
    """
    directions: Array = to_robot[:3, :3].T / np.linalg.norm(to_robot[:3, :3], axis=0)[:, None]
    return directions


def picture_axes(plans: Sequence[Plan]) -> Array:
    """Return the rotation (3, 3) from the robot's frame to pictures' axes: to the right, away from the viewer, up.

    With a patient's directions these are left, posterior and superior, so that the patient's right is on the left
    as in radiology. Without them, or where plans disagree, they are the robot's own axes, z upwards.
    """
    found = [_patient_axes(plan) for plan in plans]
    first = found[0]
    agree = all(np.abs(each - first).max() <= SAME_ORIENTATION_TOLERANCE for each in found)
    return first if agree else np.eye(3)


def _patient_axes(plan: Plan) -> Array:
    """Return the rotation of picture_axes for one plan."""
    space = plan.meta["problem"].get("space") or ""
    if not has_patient_directions(space):
        return np.eye(3)
    named = dict(zip(space, axis_directions(plan.to_robot), strict=True))
    named |= {OPPOSITE_DIRECTIONS[letter]: -along for letter, along in named.items()}
    return np.stack([named["L"], named["P"], named["S"]])


def matplotlib_view(axes: Array, elevation: float, azimuth: float) -> MatplotlibView:
    """Return the view for axes in space that draw the robot's frame, of angles that are given in pictures' axes.

    axes: rotation (3, 3) of picture_axes. elevation, azimuth: degrees, of the viewer.
    """
    high, around = np.radians([elevation, azimuth])
    towards = axes.T @ [np.cos(high) * np.cos(around), np.cos(high) * np.sin(around), np.sin(high)]
    own_high = np.arcsin(np.clip(towards[2], -1.0, 1.0))
    own_around = np.arctan2(towards[1], towards[0])
    # matplotlib draws its z axis upwards; it rolls the camera so that another direction is drawn upwards.
    right = np.array([-np.sin(own_around), np.cos(own_around), 0.0])
    up = np.cross(towards, right)
    roll = np.arctan2(axes[2] @ right, axes[2] @ up)
    return MatplotlibView(*np.degrees([own_high, own_around, roll]).tolist())
