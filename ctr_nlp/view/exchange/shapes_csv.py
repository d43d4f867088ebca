"""Write a plan's shapes and targets as a table for spreadsheets and scripts."""

from __future__ import annotations

import csv
import io

import numpy as np

from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.plan import Plan
from ctr_nlp.view.exchange.plan_surfaces import frames_with_shape

SHAPES_CSV_COLUMNS = (
    "frame",
    "time_s",
    "sigma",
    "x_mm",
    "y_mm",
    "z_mm",
    "target_x_mm",
    "target_y_mm",
    "target_z_mm",
)
SHAPES_CSV_SIGNATURE = ",".join(SHAPES_CSV_COLUMNS[:6])
SHAPES_CSV_DECIMALS = 6
"""Decimals of coordinates in mm."""


def encode_shapes_csv(plan: Plan) -> bytes:
    """Return the bytes of a plan's table, comma-separated, in UTF-8, with a row for each of 101 points in every
    frame that has a shape.

    plan: the plan. Columns: frame, from 1; time; sigma, the part of the robot's length up to the point; x, y, z of
    the robot, and of its target at the same sigma, mm in the robot's base frame. Raises OutputError where no frame
    has a shape.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(SHAPES_CSV_COLUMNS)
    for j in frames_with_shape(plan):
        points = (
            np.round(np.hstack([plan.shape[j], plan.target[j]]), SHAPES_CSV_DECIMALS) + 0.0
        )  # no minus before a zero
        for sigma, row in zip(SIGMA_GRID, points.tolist(), strict=True):
            writer.writerow(
                [j + 1, f"{plan.time[j]:.9g}", f"{sigma:.2f}", *(f"{x:.{SHAPES_CSV_DECIMALS}f}" for x in row)]
            )
    return text.getvalue().encode()
