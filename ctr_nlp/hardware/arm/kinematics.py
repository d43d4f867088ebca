"""Kinematics of the arm: what joints do to the robot that it holds, and the joints of a tilting motion."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import HardwareError
from ctr_nlp.hardware.arm.description import JOINT_LIMIT, JOINTS, Arm
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

LENGTH = 100.0
"""mm that count as one radian where turning and moving are compared."""

LARGEST_GAIN = 30.0
"""Nearer to a singularity, joints would turn more than this many times as fast as the robot they hold."""
ARM_SINGULARITY_MESSAGE = "singular: joints would turn {gain:.3g} times as fast as the robot"
SUBSTEP = 0.01
"""rad of tilt from one inverse kinematics to the next, so that joint solutions cannot be mixed up."""
MAX_SUBSTEP_JOINT_TURN_RAD = 0.5
"""rad that a joint may turn over a substep: more than LARGEST_GAIN asks for, less than lies between solutions."""


def tilt_of_joints(arm: Arm, joints: Array) -> Array:
    """Tilt (T, 2) rad, within +-pi, of joints (T, 6) rad, by forward kinematics."""
    turned = arm.base[:3, :3].T @ _robot_base_frames(arm, joints)[:, :3, :3]
    theta_x = np.arctan2(-turned[:, 1, 2], turned[:, 1, 1])
    return np.stack([theta_x, np.arctan2(-turned[:, 2, 0], turned[:, 0, 0])], axis=1)


def insertion_error(arm: Arm, joints: Array) -> Array:
    """Distance (T,) in mm of what joints (T, 6) rad hold at the insertion point from there."""
    return np.asarray(np.linalg.norm(_robot_base_frames(arm, joints)[:, :3, 3] - arm.base[:3, 3], axis=1))


def gains(arm: Arm, joints: Array) -> Array:
    """How many times as fast (T,) joints (T, 6) rad may have to turn as the robot they hold.

    1 / the smallest singular value of the Jacobian at the insertion point, LENGTH counting as a radian; infinite
    at a singularity.
    """
    screws = _screws(arm, joints)
    at = arm.base[:3, 3]
    turning = screws[:, :3]
    moving = screws[:, 3:] + np.cross(screws[:, :3], at, axisa=1, axisb=0, axisc=1)
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
        found = np.array(getattr(import_extra("ur_analytic_ik"), model).forward_kinematics(*joints))
        found[:3, 3] *= 1000
        return found

    home = pose(*np.zeros(6))
    back = np.linalg.inv(home)
    quarters = np.array([[pose(*(s * np.pi / 2 * e)) @ back for e in np.eye(6)] for s in (1, -1)])
    return home, np.eye(4) - quarters.mean(axis=0), (quarters[0] - quarters[1]) / 2


def _placements(arm: Arm, joints: Array) -> list[Array]:
    """What joints (T, 6) rad do to a frame fixed to each link from the base to the flange, 7 of (T, 4, 4), mm."""
    _, cosine, sine = _turns(arm.model)
    c = np.cos(joints)[..., None, None]
    s = np.sin(joints)[..., None, None]
    moved = [np.tile(np.eye(4), (len(joints), 1, 1))]
    for i in range(6):
        moved.append(moved[-1] @ (np.eye(4) + (c[:, i] - 1) * cosine[i] + s[:, i] * sine[i]))
    return moved


def _robot_base_frames(arm: Arm, joints: Array) -> Array:
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


class _JointPath(NamedTuple):
    """A joint solution, as far as it can be followed; margin: to singularities and joint limits, 0 at them."""

    joints: Array
    margin: float
    frame: int
    complaint: str


def inverse_kinematics(arm: Arm, theta: Array, start: Array | None = None) -> Array:
    """Joint angles (T, 6) rad that tilt the robot by theta (T, 2) rad, linear in theta between frames.

    All frames follow one joint solution continuously, within JOINT_LIMIT. start: (6,) rad,
    where the arm stands at the first frame. Without it the one of start_joints_deg at zero tilt is taken, or
    if there is none, of those that go through all frames the one that stays furthest from singularities
    and joint limits. Raises HardwareError that names the frame, counted from 1, where no joint solution goes on.
    """
    theta = np.asarray(theta, dtype=float)
    if theta.ndim != 2 or theta.shape[1] != 2 or not len(theta) or not np.isfinite(theta).all():
        raise HardwareError(f"theta has shape {theta.shape}; it must be finite (T, 2), with at least one frame")
    near = start
    lead = 0
    if start is None and arm.start_joints_deg is not None:
        near = np.radians(arm.start_joints_deg)
        lead = 1
        theta = np.concatenate([np.zeros((1, 2)), theta])
    path, frames = _subdivide_tilts(theta)
    solutions = [_solutions(arm.model, pose) for pose in poses(arm, path)]
    first = solutions[0]
    if near is not None and len(first):
        first = first[[np.abs(_wrap_angles(first - near)).sum(axis=1).argmin()]]
        first = near + _wrap_angles(first - near)
    followed = [_follow(arm, q, solutions, frames, wound=near is not None) for q in first]
    if not followed:
        followed = [_JointPath(first, 0.0, 0, "out of the arm's reach")]
    best = max(followed, key=lambda found: (found.frame, found.margin))
    if best.complaint:
        frame = max(best.frame - lead, 0)
        where = "zero tilt" if best.frame < lead else f"frame {frame + 1} of {len(theta) - lead}"
        at = ", ".join(f"{value:.4g}" for value in theta[best.frame])
        which = "the joint solution of the start" if near is not None else "every joint solution"
        raise HardwareError(f"{arm.model} at {where}, theta = ({at}) rad: {which} ends: {best.complaint}")
    return best.joints[frames][lead:]


def poses(arm: Arm, theta: Array) -> Array:
    """Flange poses in the arm's base frame, (T, 4, 4) in mm, that tilt the robot by theta (T, 2) rad."""
    tilted = np.tile(np.eye(4), (len(theta), 1, 1))
    tilted[:, :3, :3] = Rotation.from_euler("xy", theta).as_matrix()  # Ry(theta_y) Rx(theta_x)
    return np.asarray(arm.base @ tilted @ np.linalg.inv(arm.mount))


def _follow(arm: Arm, q: Array, solutions: list[Array], frames: list[int], wound: bool) -> _JointPath:
    """The joint solution from q (6,) on, over solutions [(n, 6)]; wound: q's whole turns are those of the arm."""
    turned = [q]
    complaint = ""
    for found in solutions[1:]:
        if not len(found):
            complaint = "out of the arm's reach"
            break
        steps = _wrap_angles(found - turned[-1])
        step = steps[np.abs(steps).max(axis=1).argmin()]
        if np.abs(step).max() > MAX_SUBSTEP_JOINT_TURN_RAD:
            joint = int(np.abs(step).argmax())
            gain = gains(arm, (turned[-1] + step)[None])[0]
            complaint = f"joint {joint + 1} ({JOINTS[joint]}) would jump by {abs(step[joint]):.3g} rad"
            complaint = ARM_SINGULARITY_MESSAGE.format(gain=gain) if gain > LARGEST_GAIN else complaint
            break
        turned.append(turned[-1] + step)
    path = np.array(turned)
    if not wound:
        middle = (path.max(axis=0) + path.min(axis=0)) / 2
        path = path - 2 * np.pi * np.round(middle / (2 * np.pi))
    gain = gains(arm, path)
    reached = len(path)
    for bad, said in (
        (gain > LARGEST_GAIN, ARM_SINGULARITY_MESSAGE),
        (np.abs(path).max(axis=1) > JOINT_LIMIT + 1e-9, "joint {joint} would turn beyond 360 deg"),
    ):
        if bad[:reached].any():
            reached = int(bad.argmax())
            joint = int(np.abs(path[reached]).argmax())
            complaint = said.format(gain=gain[reached], joint=f"{joint + 1} ({JOINTS[joint]})")
    frame = len(frames) if not complaint else int(np.searchsorted(frames, reached))
    margin = min(1 / gain.max(), 1 - np.abs(path).max() / JOINT_LIMIT)
    return _JointPath(path, float(margin), frame, complaint)


def _subdivide_tilts(theta: Array) -> tuple[Array, list[int]]:
    """Tilts (n, 2) at most SUBSTEP apart on the path through theta (T, 2), and where in them the frames are."""
    path = [theta[:1]]
    frames = [0]
    for a, b in pairwise(theta):
        count = max(1, math.ceil(np.abs(b - a).max() / SUBSTEP))
        path.append(a + (b - a) * np.linspace(0, 1, count + 1)[1:, None])
        frames.append(frames[-1] + count)
    return np.concatenate(path), frames


def _solutions(model: str, pose: Array) -> Array:
    """All joint angles (n, 6) rad within +-pi that hold the flange at a pose (4, 4) in mm."""
    metres = pose.copy()
    metres[:3, 3] /= 1000
    return np.array(getattr(import_extra("ur_analytic_ik"), model).inverse_kinematics(metres)).reshape(-1, 6)


def _wrap_angles(angles: Array) -> Array:
    """The same angles within +-pi."""
    return (angles + np.pi) % (2 * np.pi) - np.pi
