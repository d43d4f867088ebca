"""Whether joint angles over time keep an arm's limits."""

from __future__ import annotations

import math

import numpy as np

from ctr_nlp.exceptions import HardwareError
from ctr_nlp.hardware.arm.description import JOINTS, Arm
from ctr_nlp.typing import Array


def check_joints(arm: Arm, time: Array, joints: Array) -> None:
    """Raise HardwareError, which names frame, joint and value, unless joints (T, 6) rad keep the arm's limits.

    time: (T,) s. Speeds are means from frame to frame; accelerations are between those means, with the arm at
    rest before and after. Give frames for these: between samples of a motion that is linear from frame to frame,
    they show corners that the arm's controller rounds.
    """
    time, joints = np.asarray(time, dtype=float), np.asarray(joints, dtype=float)
    if joints.shape != (len(time), 6) or not (np.isfinite(time).all() and np.isfinite(joints).all()):
        raise HardwareError(f"joints have shape {joints.shape}, times {time.shape}; give finite (T, 6) and (T,)")
    step = np.diff(time)
    if not (step > 0).all():
        raise HardwareError(f"time of frame {int(np.argmin(step)) + 2} does not come after the one before")
    if not len(step):
        return
    speed = np.diff(joints, axis=0) / step[:, None]
    around = np.concatenate([step[:1], (step[1:] + step[:-1]) / 2, step[-1:]])
    acceleration = np.diff(speed, axis=0, prepend=0.0, append=0.0) / around[:, None]
    for name, unit, value, limit, lead in (
        ("speed", "deg/s", speed, arm.joint_speed, 2),
        ("acceleration", "deg/s^2", acceleration, arm.joint_acceleration, 1),
    ):
        over = np.abs(value) / limit
        frame, joint = np.unravel_index(over.argmax(), over.shape)
        if over[frame, joint] > 1 + 1e-9:
            raise HardwareError(
                f"{name} of joint {joint + 1} ({JOINTS[joint]}) to frame {frame + lead} of {len(time)} "
                f"({time[min(frame + lead, len(time)) - 1]:.4g} s) is "
                f"{math.degrees(abs(value[frame, joint])):.4g} {unit}; it must be at most "
                f"{math.degrees(limit[joint]):.4g}"
            )
