"""A motion as G-code: lines for a controller beside which a computer stands, and a file for one that plays alone.

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
"""What a program begins with: also the first work offset, which is 0."""

GCODE_DECIMALS = 4

GCODE_FILE_OPENING = "(ctr_nlp"
"""With which a file begins."""

WAITS = "G4"
"""What a line says that waits and moves nothing."""

LEAST_FEED = 1.0 / 60.0
"""Units/s: Grbl goes no slower, and a line in which nothing moves takes no time there."""


def line(number: int, letters: Sequence[str], position: Array, seconds: float, meaning: str = "") -> str:
    """The line that goes straight to a position (m,) within so many s; every axis and F are on it.

    meaning: words that it says besides, lest it means something else after another client's word.
    """
    rounded = np.round(position, GCODE_DECIMALS) + 0.0
    words = " ".join(f"{letter}{value:.{GCODE_DECIMALS}f}" for letter, value in zip(letters, rounded, strict=True))
    return f"N{number} {meaning}{' ' * bool(meaning)}G1 {words} F{60.0 / seconds:.{GCODE_DECIMALS}f}"


class GcodeWriter:
    """Numbered lines, from 1, from start (m,) along straight pieces; each is made in turn, and once.

    Where less would move than Grbl's least feed a line waits (G4), and the next line makes up for it. meaning: as
    of line.
    """

    def __init__(self, letters: Sequence[str], start: Array, meaning: str = "") -> None:
        self._letters = letters
        self._there = start
        self._meaning = meaning
        self._made = 0

    def next(self, position: Array, seconds: float, last: bool) -> str:
        """The line that goes on to a position (m,) within so many s; last: nothing comes after it."""
        self._made += 1
        if not last and np.linalg.norm(position - self._there) < LEAST_FEED * seconds:
            return f"N{self._made} {WAITS} P{seconds:.{GCODE_DECIMALS}f}"
        self._there = position
        return line(self._made, self._letters, position, seconds, self._meaning)

    def copy(self, text: str) -> str:
        """A shorter copy of a line that moves, which finds nothing to move where that line came as it was sent.

        It leaves out what lasts from line to line, and blanks.
        """
        return text.replace(self._meaning, "").replace(" ", "")


def lines(letters: Sequence[str], start: Array, positions: Array, time: Array, meaning: str = "") -> list[str]:
    """The lines from start (m,) to positions (N, m) that are reached at time (N,) s; meaning: as of line."""
    made = GcodeWriter(letters, start, meaning)
    count = len(positions)
    return [
        made.next(position, float(seconds), n == count)
        for n, (position, seconds) in enumerate(zip(positions, np.diff(time, prepend=0.0), strict=True), start=1)
    ]


def gcode_text(trajectory: Trajectory, title: str) -> str:
    """The file: a pause, the slow approach to the first frame, another pause, and the trajectory's numbered lines.

    title: of the plan.
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
    """Seconds that are enough to come from any place in the axes' ranges, at hardware.approach of their speeds.

    As time, and not as a feed, this holds however a controller counts degrees beside millimetres.
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
    """In parentheses, without what ends a comment or is obeyed within one.

    Grbl takes ? ! ~ wherever they are; readers that do not know parentheses take G28 and M3.
    """
    harmless = re.sub(r"[^A-Za-z0-9 _.,:+=/-]", "_", text)
    return "(" + re.sub(r"([GMNTgmnt])(?=[0-9])", r"\1_", harmless) + ")"
