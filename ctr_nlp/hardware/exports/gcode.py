"""A trajectory as a G-code file for Grbl and grblHAL, played without a computer beside it and without the arm."""

from __future__ import annotations

import re

import numpy as np

from ctr_nlp.hardware.motion import gcode
from ctr_nlp.hardware.motion.trajectory import Trajectory

OPENING = "(ctr_nlp"


def gcode_text(trajectory: Trajectory, title: str) -> str:
    """The file: a pause, the slow approach to the first frame, another pause, and the trajectory's numbered lines.

    title: of the plan.
    """
    start, seconds, commands = (
        trajectory.positions(0.0),
        approach_time(trajectory),
        trajectory.commands(),
    )
    head = [
        f"ctr_nlp: {title[:60]}",
        f"digest {trajectory.digests.plan}",
        f"{len(trajectory.frames)} frames in {trajectory.duration:.3f} s from the second pause on",
        *(f"{axis.letter} in {axis.unit} moves {axis.joint}" for axis in trajectory.hardware.axes),
        "positions are those of the machine: no work offset may be active",
        "rates and accelerations of the controller: at least those of the hardware",
        f"after the first pause: to the first frame in {seconds:.1f} s, all axes at once",
        "after the second pause: the motion",
    ]
    if np.any(trajectory.tilt(trajectory.frame_time)):
        head += [
            "THE TILT OF THE ARM IS NOT IN THIS FILE: export it with --to urscript",
            "and end the second pause when the arm starts",
        ]
    return "\n".join(
        [
            *map(_comment, head),
            gcode.MODES,
            "M0",
            gcode.line(0, trajectory.hardware.letters, start, seconds),
            "M0",
            *gcode.lines(trajectory.hardware.letters, start, commands.positions, commands.time),
            "G94",
            "M2",
            "",
        ]
    )


def approach_time(trajectory: Trajectory) -> float:
    """Seconds that are enough to come from any place in the axes' ranges, at hardware.approach of their speeds.

    As time, and not as a feed, this holds however a controller counts degrees beside millimetres.
    """
    robot, hardware = trajectory.robot, trajectory.hardware
    start = trajectory.positions(0.0)
    away = [
        max(abs(position - end) for end in axis.range) for axis, position in zip(hardware.axes, start, strict=True)
    ]
    speed = [abs(axis.scale) * robot.speed[robot.axes.index(axis.joint)] for axis in hardware.axes]
    return float(np.max(np.array(away) / (hardware.approach * np.array(speed))))


def _comment(text: str) -> str:
    """In parentheses, without what ends a comment or is obeyed within one.

    Grbl takes ? ! ~ wherever they are; readers that do not know parentheses take G28 and M3.
    """
    harmless = re.sub(r"[^A-Za-z0-9 _.,:+=/-]", "_", text)
    return "(" + re.sub(r"([GMNTgmnt])(?=[0-9])", r"\1_", harmless) + ")"
