"""A plan's shapes and targets as a table for spreadsheets and scripts."""

from __future__ import annotations

import csv
import io

import numpy as np

from ctr_nlp.exchange.surface import shown_frames
from ctr_nlp.plan.plan import Plan
from ctr_nlp.target.target import SIGMA

COLUMNS = ("frame", "time_s", "sigma", "x_mm", "y_mm", "z_mm", "target_x_mm", "target_y_mm", "target_z_mm")
OPENING = ",".join(COLUMNS[:6])
DECIMALS = 6
"""Decimals of coordinates: a millionth of a millimetre."""


def shapes_csv(plan: Plan) -> bytes:
    """The table, comma-separated, in UTF-8: a row for each of 101 points in every frame that has a shape.

    frame: its number from 1; sigma: part of the robot's length up to the point; x, y, z: of the robot, and of its
    target at the same sigma, in the robot's base frame. Raises OutputError where no frame has a shape.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for j in shown_frames(plan):
        points = np.round(np.hstack([plan.shape[j], plan.target[j]]), DECIMALS) + 0.0  # no minus before a zero
        for sigma, row in zip(SIGMA, points.tolist(), strict=True):
            writer.writerow([j + 1, f"{plan.time[j]:.9g}", f"{sigma:.2f}", *(f"{x:.{DECIMALS}f}" for x in row)])
    return text.getvalue().encode()
