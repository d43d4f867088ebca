"""Kinematics of the arm that tilts the robot: joint angles to tilt, and joint angles along a tilting motion.

Forward kinematics are a product of exponentials (Lynch and Park, Modern Robotics, 2017, chapter 4)

    T(q) = exp(S_1 q_1) ... exp(S_6 q_6) M,   exp(S q) = I + sin(q) S + (1 - cos(q)) S^2

with the flange's pose M at q = 0 and the joints' screws S_i (4, 4) in the arm's base frame; the second equation
holds for revolute joints. The columns of the Jacobian are the screws moved along by the joints before them.
Inverse kinematics are analytic (ur-analytic-ik), with up to eight joint solutions for a pose; one of them is
followed along the motion in small steps of tilt, and it ends at singularities, joint limits and the end of the
reach.

The tilt theta (2,) turns the robot about the insertion point by R = Ry(theta_y) Rx(theta_x).
"""

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
    """Return the tilt (T, 2) rad, within +-pi, by forward kinematics.

    arm: the arm and how the robot is mounted on it. joints: (T, 6) rad.
    """
    turned = arm.base[:3, :3].T @ _robot_base_frames(arm, joints)[:, :3, :3]
    # Ry(theta_y) Rx(theta_x) has the middle row (0, cos theta_x, -sin theta_x) and the first column (cos theta_y,
    # 0, -sin theta_y).
    theta_x = np.arctan2(-turned[:, 1, 2], turned[:, 1, 1])
    return np.stack([theta_x, np.arctan2(-turned[:, 2, 0], turned[:, 0, 0])], axis=1)


def insertion_error(arm: Arm, joints: Array) -> Array:
    """Return the distance (T,) in mm from the robot's base frame to the insertion point.

    arm: says where both should be. joints: (T, 6) rad.
    """
    return np.asarray(np.linalg.norm(_robot_base_frames(arm, joints)[:, :3, 3] - arm.base[:3, 3], axis=1))


def gains(arm: Arm, joints: Array) -> Array:
    """Return the largest ratio (T,) of joint speed to the speed of the robot that the joints hold.

    1 / the smallest singular value of the Jacobian at the insertion point, LENGTH counting as a radian; infinite
    at a singularity. arm: the arm. joints: (T, 6) rad.
    """
    screws = _screws(arm, joints)
    at = arm.base[:3, 3]
    turning = screws[:, :3]
    # The point p of a body that turns with omega moves with v + omega x p, v at the origin.
    moving = screws[:, 3:] + np.cross(screws[:, :3], at, axisa=1, axisb=0, axisc=1)
    with np.errstate(divide="ignore"):
        smallest = np.linalg.svd(np.concatenate([turning, moving / LENGTH], axis=1), compute_uv=False)[:, -1]
        return np.asarray(1 / smallest)


@cache
def _turns(model: str) -> tuple[Array, Array, Array]:
    """Return the parts of forward kinematics: M (4, 4), -S_i^2 (6, 4, 4) and S_i (6, 4, 4), lengths in mm.

    model: of the arm, one of ARM_MODELS.
    """

    def pose(*joints: float) -> Array:
        found = np.array(getattr(import_extra("ur_analytic_ik"), model).forward_kinematics(*joints))
        found[:3, 3] *= 1000
        return found

    # With the other joints at 0, pose M^-1 = exp(S q). At q = +-pi/2 that is I + S^2 +- S: the mean and half the
    # difference of the two give S^2 and S exactly, without the library's table of link lengths, and then serve
    # whole arrays of joints, which the library does not take.
    home = pose(*np.zeros(6))
    back = np.linalg.inv(home)
    quarters = np.array([[pose(*(s * np.pi / 2 * e)) @ back for e in np.eye(6)] for s in (1, -1)])
    return home, np.eye(4) - quarters.mean(axis=0), (quarters[0] - quarters[1]) / 2


def _placements(arm: Arm, joints: Array) -> list[Array]:
    """Return exp(S_1 q_1) ... exp(S_i q_i) for i = 0 to 6, 7 of (T, 4, 4), mm.

    Each is the motion of a frame fixed to link i away from q = 0. arm: the arm. joints: q (T, 6) rad.
    """
    _, cosine, sine = _turns(arm.model)
    c = np.cos(joints)[..., None, None]
    s = np.sin(joints)[..., None, None]
    moved = [np.tile(np.eye(4), (len(joints), 1, 1))]
    for i in range(6):
        moved.append(moved[-1] @ (np.eye(4) + (c[:, i] - 1) * cosine[i] + s[:, i] * sine[i]))
    return moved


def _robot_base_frames(arm: Arm, joints: Array) -> Array:
    """Return the robot's base frame in the arm's base frame, (T, 4, 4) mm; joints: (T, 6) rad."""
    return np.asarray(_placements(arm, np.asarray(joints))[-1] @ _turns(arm.model)[0] @ arm.mount)


def _screws(arm: Arm, joints: Array) -> Array:
    """Return the Jacobian (T, 6, 6) in the arm's base frame, a column for each joint.

    A column is the joint's axis (3,) above the velocity (3,) in mm/rad that it gives a point at the origin.
    joints: (T, 6) rad.
    """
    columns = []
    for moved, screw in zip(_placements(arm, joints), _turns(arm.model)[2], strict=False):
        # The adjoint of the motion (R, p) of the link: omega -> R omega, v -> R v + p x R omega. The axis is read
        # from S, whose upper left part is the cross-product matrix of omega.
        axis = moved[:, :3, :3] @ np.array([screw[2, 1], screw[0, 2], screw[1, 0]])
        speed = np.einsum("tij,j->ti", moved[:, :3, :3], screw[:3, 3]) - np.cross(axis, moved[:, :3, 3])
        columns.append(np.concatenate([axis, speed], axis=1))
    return np.stack(columns, axis=2)


class _JointPath(NamedTuple):
    """A joint solution (n, 6) rad, as far as it can be followed.

    margin: distance to singularities and joint limits, 0 at them. frame: the first that it does not reach.
    complaint: why not, "" where it reaches all.
    """

    joints: Array
    margin: float
    frame: int
    complaint: str


def inverse_kinematics(arm: Arm, theta: Array, start: Array | None = None) -> Array:
    """Joint angles (T, 6) rad that tilt the robot by theta (T, 2) rad, linear in theta between frames.

    All frames follow one joint solution continuously, within JOINT_LIMIT. start: (6,) rad, where the arm stands at
    the first frame. Without it the solution of start_joints_deg at zero tilt is taken, or, if there is none, of
    those that pass all frames the one that stays furthest from singularities and joint limits. Raises
    HardwareError that names the frame, counted from 1, at which every joint solution ends.
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
        # The library answers within +-pi, but the joints of a UR turn by +-2 pi: the arm may stand a whole turn
        # away from the answer, and must not be sent back by it.
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
    """Return the joint solution that goes on from q over all tilts, as far as it can be followed.

    q: (6,) rad at the first tilt. solutions: all joint solutions (n, 6) rad at each tilt. frames: which tilts are
    frames. wound: whether the whole turns in q are those of the arm; else they are free.
    """
    turned = [q]
    complaint = ""
    for found in solutions[1:]:
        if not len(found):
            complaint = "out of the arm's reach"
            break
        steps = _wrap_angles(found - turned[-1])
        step = steps[np.abs(steps).max(axis=1).argmin()]
        # A larger step is a change to another joint solution, or a singularity between two tilts: inverse
        # kinematics alone would hide both.
        if np.abs(step).max() > MAX_SUBSTEP_JOINT_TURN_RAD:
            joint = int(np.abs(step).argmax())
            gain = gains(arm, (turned[-1] + step)[None])[0]
            complaint = f"joint {joint + 1} ({JOINTS[joint]}) would jump by {abs(step[joint]):.3g} rad"
            complaint = ARM_SINGULARITY_MESSAGE.format(gain=gain) if gain > LARGEST_GAIN else complaint
            break
        turned.append(turned[-1] + step)
    path = np.array(turned)
    if not wound:
        # Whole turns are free here: bring the middle of each joint's range next to 0, away from both limits.
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
    """Return all joint angles (n, 6) rad within +-pi that hold the flange at a pose.

    model: of the arm. pose: (4, 4) in mm.
    """
    metres = pose.copy()
    metres[:3, 3] /= 1000
    return np.array(getattr(import_extra("ur_analytic_ik"), model).inverse_kinematics(metres)).reshape(-1, 6)


def _wrap_angles(angles: Array) -> Array:
    """Return angles in rad shifted by whole turns to within +-pi."""
    return (angles + np.pi) % (2 * np.pi) - np.pi
