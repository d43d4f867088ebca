"""A program as a G-code file for Grbl and grblHAL, played without a computer beside it. The arm is not in it."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt

from ctr_nlp.executor import gcode
from ctr_nlp.executor.program import Program

Array = npt.NDArray[np.float64]

OPENING = "(ctr_nlp"
LEAST_FEED = 1.0 / 60.0
"""Units/s: Grbl goes no slower, and a line in which nothing moves takes no time there."""


def gcode_text(program: Program, title: str) -> str:
    """The file: a pause, the slow way to the first frame, another pause, and the program's numbered lines.

    title: of the plan. A straight piece in which less than Grbl's least feed would do is waited for (G4), and made
    up for by the next line; the last line goes where the program ends.
    """
    start, seconds = program.positions(np.zeros(1))[0], approach_time(program)
    head = [
        f"ctr_nlp: {title}",
        f"digest {program.digest}",
        f"{len(program.frames)} frames in {program.duration:.3f} s from the second pause on",
        *(f"{axis.letter} in {axis.unit} moves {axis.joint}" for axis in program.hardware.axes),
        "positions are those of the machine: no work offset may be active",
        "rates and accelerations that the controller allows must not be less than those of the hardware file",
        f"after the first pause: to the first frame in {seconds:.1f} s, all axes at once",
        "after the second pause: the motion",
    ]
    if np.any(program.at(program.frame_time)[0][:, -2:]):
        head += [
            "THE TILT OF THE ARM IS NOT IN THIS FILE: export it with --to urscript",
            "and end the second pause when the arm starts",
        ]
    return "\n".join(
        [
            *map(_comment, head),
            gcode.MODES,
            "M0",
            gcode.line(0, program.hardware.letters, start, seconds),
            "M0",
            *_lines(program, start),
            "G94",
            "M2",
            "",
        ]
    )


def approach_time(program: Program) -> float:
    """Seconds that are enough to come from any place in the axes' ranges, at hardware.approach of their speeds.

    As time, and not as a feed, this holds however a controller counts degrees beside millimetres.
    """
    robot, hardware = program.robot, program.hardware
    start = program.positions(np.zeros(1))[0]
    away = [
        max(abs(position - end) for end in axis.range) for axis, position in zip(hardware.axes, start, strict=True)
    ]
    speed = [abs(axis.scale) * robot.speed[robot.axes.index(axis.joint)] for axis in hardware.axes]
    return float(np.max(np.array(away) / (hardware.approach * np.array(speed))))


def _lines(program: Program, start: Array) -> list[str]:
    commands = program.commands()
    duration = np.diff(commands.time, prepend=0.0)
    moving = gcode.lines(program.hardware.letters, commands.positions, commands.time)
    there, lines = start, []
    for k, (position, seconds) in enumerate(zip(commands.positions, duration, strict=True)):
        if np.linalg.norm(position - there) < LEAST_FEED * seconds and k < len(duration) - 1:
            lines.append(f"N{k + 1} G4 P{seconds:.{gcode.DECIMALS}f}")
        else:
            lines.append(moving[k])
            there = position
    return lines


def _comment(text: str) -> str:
    """In parentheses, without what ends a comment or is obeyed within one.

    Grbl takes ? ! ~ wherever they are; readers that do not know parentheses take G28 and M3.
    """
    harmless = re.sub(r"[^A-Za-z0-9 _.,:+=/-]", "_", text)
    return "(" + re.sub(r"([GMNTgmnt])(?=[0-9])", r"\1_", harmless) + ")"
