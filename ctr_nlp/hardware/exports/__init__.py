"""Files that other machines play: one format a file, and a table for spreadsheets and scripts."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ctr_nlp.exceptions import HardwareError
from ctr_nlp.hardware.arm.kinematics import inverse_kinematics
from ctr_nlp.hardware.exports.urscript import write_urscript
from ctr_nlp.hardware.motion.gcode import GCODE_FILE_OPENING, gcode_text
from ctr_nlp.hardware.motion.trajectory import Trajectory

CSV_EXPORT_DECIMALS = 9
"""Digits after the decimal point in the table."""

PERIOD = 0.008
"""s from sample to sample of the arm's motion."""


def csv_text(trajectory: Trajectory) -> str:
    """Return the table of a trajectory, comma-separated, with names and units in its first row.

    trajectory: as played. Columns: time_s; frame, the next one to be reached in a row; at_frame, 1 where it is
    reached; joints, as alpha_1_rad, beta_1_mm, theta_x_rad; positions of axes, backlash included, as X_mm, A_deg.
    """
    commands = trajectory.commands()
    time = np.append(0.0, commands.time)
    frame = np.append(trajectory.frames[0], commands.frame)
    names = [f"{name}_{'mm' if name.startswith('beta') else 'rad'}" for name in trajectory.robot.axes]
    axes = [f"{axis.letter}_{axis.unit}" for axis in trajectory.hardware.axes]
    values = np.hstack([trajectory.at(time)[0], trajectory.positions(time)])
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["time_s", "frame", "at_frame", *names, *axes])
    reached = [True, *(np.diff(frame) > 0)[1:], True]
    for t, number, there, row in zip(time, frame, reached, values, strict=True):
        numbers = [
            f"{value:.{CSV_EXPORT_DECIMALS}f}" for value in np.round(row, CSV_EXPORT_DECIMALS) + 0.0
        ]  # no minus before a zero
        writer.writerow([f"{t:.{CSV_EXPORT_DECIMALS}f}", number, int(there), *numbers])
    return file.getvalue()


def _urscript(trajectory: Trajectory, title: str) -> str:
    """Return the URScript program of the arm's part of a trajectory; title: of the plan, for its name."""
    holder = trajectory.hardware.arm
    if holder is None:
        raise HardwareError("this hardware has no arm, so that there is nothing to write for one")
    time = PERIOD * np.arange(np.ceil(trajectory.duration / PERIOD - 1e-6) + 1)
    sampled = inverse_kinematics(holder, trajectory.tilt(time))
    name = re.sub(r"\W", "_", f"ctr_nlp_{title}", flags=re.ASCII)
    return write_urscript(time, sampled, period=PERIOD, name=name)


@dataclass(frozen=True)
class TextFormat:
    """A format of one file.

    of: function of (trajectory, title), and of its own options, that returns the text. suffix: of the file's name.
    opening: how every file of the format begins.
    """

    of: Callable[..., str]
    suffix: str
    opening: str


MACHINE_TEXT_FORMATS = {
    "csv": TextFormat(lambda trajectory, title: csv_text(trajectory), ".csv", "time_s,frame,at_frame,"),
    "gcode": TextFormat(gcode_text, ".gcode", GCODE_FILE_OPENING),
    "urscript": TextFormat(_urscript, ".script", "def ctr_nlp_"),
}
"""Formats of one file, by name."""

BAG = "rosbag2"
"""The format that is a folder; see rosbag2.py."""

MACHINE_FORMATS = (*MACHINE_TEXT_FORMATS, BAG)
