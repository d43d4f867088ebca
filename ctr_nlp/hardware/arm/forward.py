"""Forward kinematics: what joints do to the robot that the arm holds, and where they must move too fast for it."""

from __future__ import annotations

from functools import cache

import numpy as np

from ctr_nlp.hardware.arm.description import Arm
from ctr_nlp.support.extras import needed
from ctr_nlp.typing import Array

LENGTH = 100.0
"""mm that count as one radian where turning and moving are compared."""


def tilt(arm: Arm, joints: Array) -> Array:
    """Tilt (T, 2) rad, within +-pi, of joints (T, 6) rad, by forward kinematics."""
    turned = arm.base[:3, :3].T @ _held(arm, joints)[:, :3, :3]
    theta_x = np.arctan2(-turned[:, 1, 2], turned[:, 1, 1])
    return np.stack([theta_x, np.arctan2(-turned[:, 2, 0], turned[:, 0, 0])], axis=1)


def insertion_error(arm: Arm, joints: Array) -> Array:
    """Distance (T,) in mm of what joints (T, 6) rad hold at the insertion point from there."""
    return np.asarray(np.linalg.norm(_held(arm, joints)[:, :3, 3] - arm.base[:3, 3], axis=1))


def gains(arm: Arm, joints: Array) -> Array:
    """How many times as fast (T,) joints (T, 6) rad may have to turn as the robot they hold.

    1 / the smallest singular value of the Jacobian at the insertion point, LENGTH counting as a radian; infinite
    at a singularity.
    """
    screws, at = _screws(arm, joints), arm.base[:3, 3]
    turning, moving = screws[:, :3], screws[:, 3:] + np.cross(screws[:, :3], at, axisa=1, axisb=0, axisc=1)
    with np.errstate(divide="ignore"):
        smallest = np.linalg.svd(np.concatenate([turning, moving / LENGTH], axis=1), compute_uv=False)[:, -1]
        return np.asarray(1 / smallest)


@cache
def _turns(model: str) -> tuple[Array, Array, Array]:
    """Forward kinematics in parts, mm: the flange with all joints at 0 (4, 4), and of each joint's turn about
    where its axis then lies what goes with its cosine and with its sine, (6, 4, 4) each.

    A pose depends on a joint by these two alone: the library's poses a quarter turn to either side give both
    exactly, and serve whole arrays of joints.
    """

    def pose(*joints: float) -> Array:
        found = np.array(getattr(needed("ur_analytic_ik"), model).forward_kinematics(*joints))
        found[:3, 3] *= 1000
        return found

    home = pose(*np.zeros(6))
    back = np.linalg.inv(home)
    quarters = np.array([[pose(*(s * np.pi / 2 * e)) @ back for e in np.eye(6)] for s in (1, -1)])
    return home, np.eye(4) - quarters.mean(axis=0), (quarters[0] - quarters[1]) / 2


def _placements(arm: Arm, joints: Array) -> list[Array]:
    """What joints (T, 6) rad do to a frame fixed to each link from the base to the flange, 7 of (T, 4, 4), mm."""
    _, cosine, sine = _turns(arm.model)
    c, s = np.cos(joints)[..., None, None], np.sin(joints)[..., None, None]
    moved = [np.tile(np.eye(4), (len(joints), 1, 1))]
    for i in range(6):
        moved.append(moved[-1] @ (np.eye(4) + (c[:, i] - 1) * cosine[i] + s[:, i] * sine[i]))
    return moved


def _held(arm: Arm, joints: Array) -> Array:
    """The robot's base frame in the arm's, (T, 4, 4) mm."""
    return np.asarray(_placements(arm, np.asarray(joints))[-1] @ _turns(arm.model)[0] @ arm.mount)


def _screws(arm: Arm, joints: Array) -> Array:
    """(T, 6, 6): a column a joint, its axis above the speed that it gives a point at the origin, mm/rad."""
    columns = []
    for moved, screw in zip(_placements(arm, joints), _turns(arm.model)[2], strict=False):
        axis = moved[:, :3, :3] @ np.array([screw[2, 1], screw[0, 2], screw[1, 0]])
        speed = np.einsum("tij,j->ti", moved[:, :3, :3], screw[:3, 3]) - np.cross(axis, moved[:, :3, 3])
        columns.append(np.concatenate([axis, speed], axis=1))
    return np.stack(columns, axis=2)
