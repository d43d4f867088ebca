"""A timed URScript program that plays sampled joint angles on a UR controller, without a computer beside it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ctr_nlp.exceptions import HardwareError, OptionError
from ctr_nlp.hardware.arm.description import JOINT_LIMIT

UR_CONTROLLER_CYCLE_S = 0.002
"""s: the controller's own cycle; 0.008 before the e-series."""
UR_LAST_SAMPLE_HOLD_S = 0.5
"""s for which the last sample is repeated, so that the arm, which lags by the lookahead time, arrives."""
URSCRIPT_ANGLE_DECIMALS = 7
"""Digits after the decimal point of angles in rad: 0.1 micrometre at a metre."""


def write_urscript(
    time: Any,
    joints: Any,
    *,
    period: float = 0.008,
    lookahead_time: float = 0.1,
    gain: float = 300.0,
    approach_speed: float = 0.1,
    name: str = "ctr_nlp_arm",
) -> str:
    """Return the program that plays joints (N, 6) rad sampled at time (N,) s, every period seconds.

    It moves slowly (approach_speed, rad/s) from wherever the arm is to the first sample, waits for somebody to
    confirm, plays, and stops. period: a multiple of the controller's cycle, 0.008 suits all; longer ones make
    shorter programs. lookahead_time (s, 0.03 to 0.2), gain (100 to 2000): of servoj. name: of the program, an
    identifier.

    There is one servoj a sample and no table of samples: each lasts a period, so that the controller's watchdog
    against programs that compute without moving stays quiet, and neither lists nor loops over lists, whose sizes
    controllers limit, are involved. What is left is the length of the program: older controllers have refused
    programs of some thousand lines that came in through a socket (visose/Robots #55,
    ros-industrial/universal_robot #411). Load long ones from a USB stick or over SFTP, or use a longer period.

    Raises OptionError, and HardwareError for times and joints that cannot be played.
    """
    _check_options(period, lookahead_time, gain, approach_speed, name)
    samples = _samples(time, joints, period)
    first = _format_joints(samples[0])
    last = _format_joints(samples[-1])
    how = f"t={period:g}, lookahead_time={lookahead_time:g}, gain={gain:g}"
    lines = [
        f"def {name}():",
        f"  # {len(samples)} samples, {(len(samples) - 1) * period:.3f} s; speed slider at 100 %",
        f"  movej({first}, a=0.5, v={approach_speed:g})",
        '  popup("At the start. Continue to play, speed slider at 100 %.", title="ctr_nlp", blocking=True)',
        *(f"  servoj({_format_joints(sample)}, {how})" for sample in samples),
        "  i = 0",
        f"  while i < {math.ceil(UR_LAST_SAMPLE_HOLD_S / period)}:",
        f"    servoj({last}, {how})",
        "    i = i + 1",
        "  end",
        "  stopj(2)",
        "end",
    ]
    return "\n".join(lines) + "\n"


def _check_options(period: float, lookahead_time: float, gain: float, approach_speed: float, name: str) -> None:
    for option, value, low, high in (
        ("period", period, UR_CONTROLLER_CYCLE_S, 0.1),
        ("lookahead_time", lookahead_time, 0.03, 0.2),
        ("gain", gain, 100.0, 2000.0),
        ("approach_speed", approach_speed, 0.01, 1.0),
    ):
        if not low <= value <= high:
            raise OptionError(f"{option} is {value!r}; it must lie in [{low:g}, {high:g}]")
    if abs(period / UR_CONTROLLER_CYCLE_S - round(period / UR_CONTROLLER_CYCLE_S)) > 1e-9:
        raise OptionError(
            f"period is {period:g} s; it must be a multiple of {UR_CONTROLLER_CYCLE_S:g} s, the controller's cycle"
        )
    if not (name.isascii() and name.isidentifier()):
        raise OptionError(f"name is {name!r}; it must be letters, digits and underscores")


def _samples(time: Any, joints: Any, period: float) -> Any:
    """Return joints (N, 6) rad as an array, or raise HardwareError where they or time (N,) s cannot be played."""
    time = np.asarray(time, dtype=float)
    joints = np.asarray(joints, dtype=float)
    if time.ndim != 1 or not len(time) or joints.shape != (len(time), 6):
        raise HardwareError(f"time has shape {time.shape} and joints {joints.shape}; give (N,) and (N, 6), N > 0")
    finite = np.isfinite(time) & np.isfinite(joints).all(axis=1)
    if not finite.all():
        raise HardwareError(f"sample {int(np.argmin(finite)) + 1} of {len(time)} is not finite")
    steps = np.diff(time)
    uneven = np.abs(steps - period) > 1e-6
    if uneven.any():
        k = int(np.argmax(uneven))
        raise HardwareError(
            f"sample {k + 2} of {len(time)} comes {steps[k]:.6g} s after the one before; "
            f"it must be one period, {period:g} s"
        )
    beyond = np.abs(joints).max(axis=1) > JOINT_LIMIT
    if beyond.any():
        raise HardwareError(f"sample {int(np.argmax(beyond)) + 1} of {len(time)} has a joint beyond 360 deg")
    return joints


def _format_joints(joints: Any) -> str:
    return "[" + ", ".join(f"{value:.{URSCRIPT_ANGLE_DECIMALS}f}" for value in joints) + "]"
