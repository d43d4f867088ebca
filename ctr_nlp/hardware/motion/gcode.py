"""A motion as G-code: lines to be streamed to a controller, and a file for one that plays alone.

Inverse time (G93), absolute millimetres and degrees, one straight piece a numbered line.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.typing import Array

MEANING = "G21 G90 G93"
"""Millimetres, absolute positions, and F as 1 / (minutes that a line takes)."""

MODES = f"{MEANING} G54"
"""Modes that a program begins with: MEANING, and the first work offset, which is 0."""

GCODE_DECIMALS = 4

GCODE_FILE_OPENING = "(ctr_nlp"
"""First characters of a file."""

WAITS = "G4"
"""Word of a line that waits and moves nothing."""

LEAST_FEED = 1.0 / 60.0
"""Units/s: Grbl goes no slower, and a line in which nothing moves takes no time there."""


def line(number: int, letters: Sequence[str], position: Array, seconds: float, meaning: str = "") -> str:
    """Return the line that goes straight to a position.

    number: its N. letters: of the axes. position: (m,) in their units. seconds: duration. meaning: words of modes
    that the line repeats, so that no other client can have changed what it means. Every axis and F are on it.
    """
    # Adding 0 turns -0.0 into 0.0, which prints without a sign.
    rounded = np.round(position, GCODE_DECIMALS) + 0.0
    words = " ".join(f"{letter}{value:.{GCODE_DECIMALS}f}" for letter, value in zip(letters, rounded, strict=True))
    # In G93 F is 1 / minutes and belongs to one line only: a line without it is an error.
    return f"N{number} {meaning}{' ' * bool(meaning)}G1 {words} F{60.0 / seconds:.{GCODE_DECIMALS}f}"


class GcodeWriter:
    """Writer of numbered lines, from 1, along straight pieces from start (m,); each line is made in turn, once.

    Where less would move than Grbl's least feed a line waits (G4), and the next line makes up for it. meaning: as
    of line.
    """

    def __init__(self, letters: Sequence[str], start: Array, meaning: str = "") -> None:
        self._letters = letters
        self._there = start
        self._meaning = meaning
        self._made = 0

    def next(self, position: Array, seconds: float, last: bool) -> str:
        """Return the next line.

        position: (m,) where it leads. seconds: duration. last: whether it is the last one, which never waits.
        """
        self._made += 1
        if not last and np.linalg.norm(position - self._there) < LEAST_FEED * seconds:
            return f"N{self._made} {WAITS} P{seconds:.{GCODE_DECIMALS}f}"
        # Not after a wait: the next line starts from where this one leaves the axes.
        self._there = position
        return line(self._made, self._letters, position, seconds, self._meaning)

    def copy(self, text: str) -> str:
        """Return a shorter copy of a line, which moves nothing where that line came as it was sent.

        text: the line. Words that last from line to line, and blanks, are left out.
        """
        return text.replace(self._meaning, "").replace(" ", "")


def lines(letters: Sequence[str], start: Array, positions: Array, time: Array, meaning: str = "") -> list[str]:
    """Return the lines from start (m,) to positions (N, m), reached at time (N,) s.

    letters: of the axes. meaning: as of line.
    """
    made = GcodeWriter(letters, start, meaning)
    count = len(positions)
    return [
        made.next(position, float(seconds), n == count)
        for n, (position, seconds) in enumerate(zip(positions, np.diff(time, prepend=0.0), strict=True), start=1)
    ]


def gcode_text(trajectory: Trajectory, title: str) -> str:
    """Return the file: a pause, the slow approach to the first frame, another pause, and the motion's lines.

    trajectory: as played. title: of the plan.
    """
    letters = trajectory.hardware.letters
    commands = trajectory.commands()
    start = trajectory.positions(0.0)
    seconds = approach_time(trajectory)
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
            MODES,
            "M0",
            line(0, letters, start, seconds),
            "M0",
            *lines(letters, start, commands.positions, commands.time),
            "G94",
            "M2",
            "",
        ]
    )


def approach_time(trajectory: Trajectory) -> float:
    """Return the seconds that suffice from any place in the axes' ranges, at hardware.approach of their speeds.

    trajectory: its start is approached. As time, and not as a feed, this holds however a controller counts degrees
    beside millimetres.
    """
    robot = trajectory.robot
    hardware = trajectory.hardware
    seconds = [
        max(abs(position - end) for end in axis.range)
        / (abs(axis.scale) * robot.speed[robot.axes.index(axis.joint)] * hardware.approach)
        for axis, position in zip(hardware.axes, trajectory.positions(0.0), strict=True)
    ]
    return float(max(seconds))


def _comment(text: str) -> str:
    """Return text in parentheses, without characters that end a comment or are obeyed within one.

    Grbl takes ? ! ~ wherever they are; readers that do not know parentheses take G28 and M3.
    """
    harmless = re.sub(r"[^A-Za-z0-9 _.,:+=/-]", "_", text)
    return "(" + re.sub(r"([GMNTgmnt])(?=[0-9])", r"\1_", harmless) + ")"
