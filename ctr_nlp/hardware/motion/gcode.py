"""A motion as G-code: lines to be streamed to a controller, and a file for one that plays alone.

Inverse time (G93), absolute millimetres and degrees, one straight piece a numbered line. Files for controllers
without G93 have feeds per minute (G94) instead, with which every line takes the same time.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.typing import Array, Flags

MEANING = "G21 G90 G93"
"""Millimetres, absolute positions, and F as 1 / (minutes that a line takes)."""

MODES = f"{MEANING} G54"
"""Modes that a program begins with: MEANING, and the first work offset, which is 0."""

GCODE_DECIMALS = 4

INVERSE_TIME, PER_MINUTE, PER_MINUTE_LINEAR = "inverse-time", "per-minute", "per-minute-linear"
GCODE_FEEDS = {
    INVERSE_TIME: "F is 1 / minutes that a line takes, G93; a controller without it needs --feed per-minute",
    PER_MINUTE: "F is in units per minute, G94, along all axes together, with degrees counted like mm, as "
    "Grbl does",
    PER_MINUTE_LINEAR: "F is in mm per minute, G94, along the axes in mm alone, and in degrees per minute where "
    "only others move, as LinuxCNC and Marlin do",
}
"""What F means in a file, by the name of the option --feed."""

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


def gcode_text(trajectory: Trajectory, title: str, feed: str = INVERSE_TIME) -> str:
    """Return the file: a pause, the slow approach to the first frame, another pause, and the motion's lines.

    trajectory: as played. title: of the plan. feed: what F means, one of GCODE_FEEDS.
    """
    letters = trajectory.hardware.letters
    commands = trajectory.commands()
    start = trajectory.positions(0.0)
    seconds = approach_time(trajectory)
    if feed == INVERSE_TIME:
        approach = [line(0, letters, start, seconds)]
        motion = lines(letters, start, commands.positions, commands.time)
    else:
        approach = _per_minute_approach(trajectory)
        motion = _per_minute_lines(trajectory, feed)
    head = [
        f"ctr_nlp: {title[:60]}",
        f"digest {trajectory.digests.plan}",
        f"{len(trajectory.frames)} frames in {trajectory.duration:.3f} s from the second pause on",
        *(f"{axis.letter} in {axis.unit} moves {axis.joint}" for axis in trajectory.hardware.axes),
        GCODE_FEEDS[feed],
        "positions are those of the machine: no work offset may be active",
        "rates and accelerations of the controller: at least those of the hardware",
        f"after the first pause: to the first frame in {seconds:.1f} s, all axes at once"
        if feed == INVERSE_TIME
        else "after the first pause: to the first frame, first the axes in mm, then the others",
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
            MODES if feed == INVERSE_TIME else MODES.replace("G93", "G94"),
            "M0",
            *approach,
            "M0",
            *motion,
            "G94",
            "M2",
            "",
        ]
    )


def _per_minute(line_length: float, seconds: float) -> str:
    """Return the word F, units per minute, of a line of a length in units that takes so many seconds."""
    return f"F{60.0 * line_length / seconds:.{GCODE_DECIMALS}f}"


def _line_length(change: Array, linear: Flags, feed: str) -> float:
    """Return the length that F refers to, of a line along which axes change by change (m,), mm or degrees.

    linear: (m,), which axes are in mm. feed: PER_MINUTE or PER_MINUTE_LINEAR.
    """
    if feed == PER_MINUTE_LINEAR and np.any(change[linear]):
        change = change[linear]
    return float(np.linalg.norm(change))


def _per_minute_lines(trajectory: Trajectory, feed: str) -> list[str]:
    """Return the lines of a trajectory's motion, with F per minute such that each takes the time that it should.

    feed: PER_MINUTE or PER_MINUTE_LINEAR.
    """
    letters = trajectory.hardware.letters
    linear = np.array([axis.unit == "mm" for axis in trajectory.hardware.axes])
    commands = trajectory.commands()
    inverse = lines(letters, trajectory.positions(0.0), commands.positions, commands.time)
    # As the controller reads it: lengths are those between rounded positions.
    there = np.round(trajectory.positions(0.0), GCODE_DECIMALS)
    found = []
    steps = zip(inverse, commands.positions, np.diff(commands.time, prepend=0.0), strict=True)
    for text, position, seconds in steps:
        if f" {WAITS} " in text:
            found.append(text)
            continue
        place = np.round(position, GCODE_DECIMALS)
        length = _line_length(place - there, linear, feed)
        there = place
        if length == 0:
            # The last line may move nothing.
            found.append(f"{text.partition(' ')[0]} {WAITS} P{seconds:.{GCODE_DECIMALS}f}")
            continue
        found.append(f"{text.rpartition(' ')[0]} {_per_minute(length, seconds)}")
    return found


def _per_minute_approach(trajectory: Trajectory) -> list[str]:
    """Return the lines of the slow approach to the first frame from any place, with F per minute.

    First the axes in mm move, then the others, so that F means the same to all controllers. No axis is then faster
    than F, which is hardware.approach of the lowest speed among those that move.
    """
    robot = trajectory.robot
    hardware = trajectory.hardware
    start = np.round(trajectory.positions(0.0), GCODE_DECIMALS) + 0.0
    found = []
    for is_linear in (True, False):
        moved = [
            (axis, at) for axis, at in zip(hardware.axes, start, strict=True) if (axis.unit == "mm") == is_linear
        ]
        if not moved:
            continue
        words = " ".join(f"{axis.letter}{at:.{GCODE_DECIMALS}f}" for axis, at in moved)
        speeds = [abs(axis.scale) * robot.speed[robot.axes.index(axis.joint)] for axis, _ in moved]
        found.append(f"N0 G1 {words} {_per_minute(min(speeds) * hardware.approach, 1.0)}")
    return found


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
