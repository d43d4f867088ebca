"""Files that other machines play: one format a file."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ctr_nlp.exceptions import HardwareError
from ctr_nlp.hardware.arm.kinematics import joints
from ctr_nlp.hardware.exports import gcode, table, urscript
from ctr_nlp.hardware.motion.trajectory import Trajectory

PERIOD = 0.008
"""s from sample to sample of the arm's motion."""


@dataclass(frozen=True)
class Text:
    """A format of one file. of: (trajectory, title) to what is in it; opening: with which that begins."""

    of: Callable[[Trajectory, str], str]
    suffix: str
    opening: str


def _urscript(trajectory: Trajectory, title: str) -> str:
    holder = trajectory.hardware.arm
    if holder is None:
        raise HardwareError("this hardware has no arm, so that there is nothing to write for one")
    time = PERIOD * np.arange(np.ceil(trajectory.duration / PERIOD - 1e-6) + 1)
    sampled = joints(holder, trajectory.tilt(time))
    name = re.sub(r"\W", "_", f"ctr_nlp_{title}", flags=re.ASCII)
    return urscript.write_urscript(time, sampled, period=PERIOD, name=name)


TEXTS = {
    "csv": Text(lambda trajectory, title: table.csv_text(trajectory), ".csv", "time_s,frame,at_frame,"),
    "gcode": Text(gcode.gcode_text, ".gcode", gcode.OPENING),
    "urscript": Text(_urscript, ".script", "def ctr_nlp_"),
}
"""Formats of one file, by name."""

BAG = "rosbag2"
"""The format that is a folder; see rosbag2.py."""

FORMATS = (*TEXTS, BAG)
