"""A timed URScript program that plays sampled joint angles on a UR controller, without a computer beside it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from ctr_nlp.exceptions import HardwareError, OptionError
from ctr_nlp.hardware.arm.description import JOINT_LIMIT

UR_CONTROLLER_CYCLE_S = 0.002
"""s: the controller's own cycle; 0.008 before the e-series."""
UR_LAST_SAMPLE_HOLD_S = 0.5
"""s for which the last sample is repeated, so that the arm, which lags by the lookahead time, arrives."""
URSCRIPT_ANGLE_DECIMALS = 7
"""Digits after the decimal point of angles in rad: 0.1 micrometre at a metre."""


MAX_URSCRIPT_TARGETS = 1000
"""Largest number of targets of a program: controllers have failed above some 1,000 to 2,500 (visose/Robots #55,
ros-industrial/universal_robot #411).
"""
URSCRIPT_TOLERANCES_RAD = (2e-6, 1e-5, 5e-5)
"""Largest differences between samples and the splines through targets, rad, from the finest on: 2 to 50
micrometres at a metre. A coarser one is used where a finer one needs too many targets.
"""
MAX_SAMPLES_PER_TARGET = 250
"""Largest number of samples from target to target: 2 s at 8 ms."""


def write_urscript(
    time: Any,
    joints: Any,
    *,
    period: float = 0.008,
    lookahead_time: float = 0.1,
    gain: float = 300.0,
    approach_speed: float = 0.1,
    name: str = "ctr_nlp_arm",
    max_targets: int = MAX_URSCRIPT_TARGETS,
) -> str:
    """Return the program that plays joints (N, 6) rad sampled at time (N,) s, every period seconds.

    It moves slowly (approach_speed, rad/s) from wherever the arm is to the first sample, waits for somebody to
    confirm, plays, and stops. period: a multiple of the controller's cycle, 0.008 suits all. lookahead_time (s,
    0.03 to 0.2), gain (100 to 2000): of servoj. name: of the program, an identifier. max_targets: largest number
    of targets.

    A line of the program is one target: the cubic spline to it, with positions and velocities at both ends, is
    played by the one loop of the program, a servoj a sample. Samples are met within the first of
    URSCRIPT_TOLERANCES_RAD for which max_targets suffice. Each servoj lasts a period, so that the controller's
    watchdog against programs that compute without moving stays quiet. No list has more than six numbers, since
    controllers limit their sizes.

    Raises OptionError, and HardwareError for times and joints that cannot be played, and where more targets would
    be needed.
    """
    _check_options(period, lookahead_time, gain, approach_speed, name)
    samples = _samples(time, joints, period)
    velocities = _velocities(samples, period)
    for tolerance in URSCRIPT_TOLERANCES_RAD:
        ends = _spline_ends(samples, velocities, period, tolerance, max_targets)
        if ends is not None:
            break
    else:
        raise HardwareError(
            f"the arm's program would have more than {max_targets} targets for "
            f"{(len(samples) - 1) * period:.1f} s; controllers fail above some 1,000 to 2,500. Export a shorter "
            "plan, or let `ctr-nlp play` move the arm"
        )
    first = _format_joints(samples[0])
    last = _format_joints(samples[-1])
    how = f"t={period:g}, lookahead_time={lookahead_time:g}, gain={gain:g}"
    starts = [0, *ends][: len(ends)]
    targets = [
        f"  ctr_nlp_spline({_format_joints(samples[i])}, {_format_joints(velocities[i])}, "
        f"{_format_joints(samples[j])}, {_format_joints(velocities[j])}, {j - i}.0)"
        for i, j in zip(starts, ends, strict=True)
    ]
    lines = [
        f"def {name}():",
        f"  # {len(samples)} samples, {(len(samples) - 1) * period:.3f} s; speed slider at 100 %",
        f"  # {len(ends)} targets of at most {max_targets}; splines within {tolerance:g} rad of the samples",
        *_spline_function(period, how),
        f"  movej({first}, a=0.5, v={approach_speed:g})",
        '  popup("At the start. Continue to play, speed slider at 100 %.", title="ctr_nlp", blocking=True)',
        f"  servoj({first}, {how})",
        *targets,
        "  i = 0",
        f"  while i < {math.ceil(UR_LAST_SAMPLE_HOLD_S / period)}:",
        f"    servoj({last}, {how})",
        "    i = i + 1",
        "  end",
        "  stopj(2)",
        "end",
    ]
    return "\n".join(lines) + "\n"


def _spline_function(period: float, how: str) -> list[str]:
    """Return the lines of the function that plays a cubic spline, n samples long, from a to b.

    period: of samples, s. how: options of servoj. In the program, va and vb are the velocities at both ends.
    Numbers are floats and powers are products: URScript has integer arithmetic and no power.
    """
    entries = ", ".join(f"ha * a[{k}] + hva * va[{k}] + hb * b[{k}] + hvb * vb[{k}]" for k in range(6))
    return [
        "  def ctr_nlp_spline(a, va, b, vb, n):",
        "    k = 1.0",
        "    while k < n + 0.5:",
        "      u = k / n",
        "      w = 1.0 - u",
        "      ha = (1.0 + 2.0 * u) * w * w",
        "      hb = (3.0 - 2.0 * u) * u * u",
        f"      hva = {period:g} * n * u * w * w",
        f"      hvb = 0.0 - {period:g} * n * u * u * w",
        f"      servoj([{entries}], {how})",
        "      k = k + 1.0",
        "    end",
        "  end",
    ]


def _velocities(samples: Any, period: float) -> Any:
    """Return the velocities (N, 6), rad/s, of samples (N, 6), rad, a period apart, as the program has them."""
    if len(samples) < 2:
        return np.zeros_like(samples)
    time = period * np.arange(len(samples))
    return np.round(CubicSpline(time, samples)(time, 1), URSCRIPT_ANGLE_DECIMALS)


def _spline_ends(samples: Any, velocities: Any, period: float, tolerance: float, most: int) -> list[int] | None:
    """Return the samples at which splines end, so that all samples (N, 6) are met within a tolerance, rad.

    velocities: (N, 6), rad/s. period: of samples, s. most: largest number of splines; None where that is too few.
    Each spline is as long as it can be.
    """
    ends = list[int]()
    here = 0
    while here < len(samples) - 1:
        if len(ends) == most:
            return None
        # The error grows with the length: halve the interval between a length that fits and one that does not.
        good, bad = 1, min(MAX_SAMPLES_PER_TARGET, len(samples) - 1 - here) + 1
        while bad - good > 1:
            middle = (good + bad) // 2
            if _spline_error(samples, velocities, here, here + middle, period) <= tolerance:
                good = middle
            else:
                bad = middle
        here += good
        ends.append(here)
    return ends


def _spline_error(samples: Any, velocities: Any, first: int, last: int, period: float) -> float:
    """Return by how much samples first to last (of N, 6), rad, differ from the spline between both, rad.

    velocities: (N, 6), rad/s. period: of samples, s.
    """
    u = np.linspace(0.0, 1.0, last - first + 1)[:, None]
    w = 1 - u
    duration = period * (last - first)
    # Hermite's basis, as in the program.
    positions = (1 + 2 * u) * w * w * samples[first] + (3 - 2 * u) * u * u * samples[last]
    slopes = u * w * w * velocities[first] - u * u * w * velocities[last]
    return float(abs(positions + duration * slopes - samples[first : last + 1]).max())


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
    # Adding 0 turns -0.0 into 0.0, which prints without a sign.
    rounded = np.round(joints, URSCRIPT_ANGLE_DECIMALS) + 0.0
    return "[" + ", ".join(f"{value:.{URSCRIPT_ANGLE_DECIMALS}f}" for value in rounded) + "]"
