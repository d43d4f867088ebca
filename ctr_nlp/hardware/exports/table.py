"""A trajectory as a table for spreadsheets and scripts: a row for where it starts, and one for every command."""

from __future__ import annotations

import csv
import io

import numpy as np

from ctr_nlp.hardware.motion.trajectory import Trajectory

DECIMALS = 9


def csv_text(trajectory: Trajectory) -> str:
    """The table, comma-separated, with names and units in its first row.

    time_s; frame: the next one to be reached in a row; at_frame: 1 where it is reached. Then joints, as in
    alpha_1_rad, beta_1_mm, theta_x_rad, and positions of axes, backlash included, as in X_mm, A_deg.
    """
    commands, start = trajectory.commands(), np.zeros(1)
    frame = np.append(trajectory.frames[0], commands.frame)
    joints = [f"{name}_{'mm' if name.startswith('beta') else 'rad'}" for name in trajectory.robot.axes]
    axes = [f"{axis.letter}_{axis.unit}" for axis in trajectory.hardware.axes]
    values = np.hstack(
        [
            np.vstack([trajectory.at(start)[0], commands.q]),
            np.vstack([trajectory.positions(start), commands.positions]),
        ]
    )
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["time_s", "frame", "at_frame", *joints, *axes])
    reached = np.append(np.diff(frame) > 0, True)
    reached[0] = True
    for t, number, there, row in zip(np.append(0.0, commands.time), frame, reached, values, strict=True):
        numbers = [f"{value:.{DECIMALS}f}" for value in np.round(row, DECIMALS) + 0.0]  # no minus before a zero
        writer.writerow([f"{t:.{DECIMALS}f}", number, int(there), *numbers])
    return file.getvalue()
