"""Figs. 7 and 8: the time-varying target `synthesis`, whose configurations q(t) are known."""

from __future__ import annotations

from typing import Any

import numpy as np
from reference.published import TABLE_II_PAPER_METHOD as PRINTED

from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.tables import columns_to_rows
from ctr_nlp.view.figures.motion import configuration_errors, error_from_truth, gimbal_lock_frames
from ctr_nlp.view.figures.overlay import shapes
from paper.checks import Check, compare_with_published, number
from paper.runs import EUCLIDEAN_BASELINE, OUR_HORIZON, PAPER_METHOD_LABELS, PAPER_TWO_STAGE, PaperResults
from paper.section import (
    CaptionedTable,
    PaperSection,
    by_frames,
    format_mm,
    motion_tasks,
    published_comparison_table,
)

FIG7_PROBLEM = "synthesis"
FIG7_METHODS = OUR_HORIZON, PAPER_TWO_STAGE
NEGLIGIBLE_CONFIGURATION_ERROR = 1e-3
"""Largest error of the configuration that counts as none, rad or mm."""


def checks_of_shapes(found: PaperResults) -> list[Check]:
    """Check in the results `found` that shapes are followed as well as published, or better."""
    published = PRINTED[FIG7_PROBLEM]
    ours = {m: number(found.row(FIG7_PROBLEM, m)["e3"]) for m in FIG7_METHODS}
    said = "; ".join(
        f"{format_mm(e3)} mm, {compare_with_published(e3, published[0])}, for {PAPER_METHOD_LABELS[m]}"
        for m, e3 in ours.items()
    )
    return [
        Check(
            f"the robot aligns well with the time-varying shapes: e3 is {published[0]:.2f} mm, at lengths up to "
            "150 mm",
            f"e3 is {said}",
            sum(compare_with_published(e3, published[0]) != "higher" for e3 in ours.values()),
            len(ours),
        )
    ]


def largest_configuration_errors(plan: Plan) -> tuple[float, float, float]:
    """Return the largest errors of a plan's alpha (rad), beta (mm) and theta (rad).

    Only frames in which the shape determines the configuration count.
    """
    # At theta_x = pi/2 alpha and theta_y are one rotation (gimbal lock), and their errors mean nothing.
    error = np.abs(error_from_truth(plan))[~gimbal_lock_frames(plan)]
    alpha, beta, theta = (float(np.nanmax(values, initial=0.0)) for values in plan.robot.split(error))
    return alpha, beta, theta


def tables_of_errors(found: PaperResults) -> list[CaptionedTable]:
    """Return the table of the largest configuration errors of each method in the results `found`."""
    header = ["method", "alpha, rad", "beta, mm", "theta, rad"]
    body = [
        [
            PAPER_METHOD_LABELS[m],
            *(f"{value:.2g}" for value in largest_configuration_errors(found.plan(FIG7_PROBLEM, m))),
        ]
        for m in FIG7_METHODS
    ]
    aside = int(gimbal_lock_frames(found.plan(FIG7_PROBLEM, OUR_HORIZON)).sum())
    caption = (
        f"Largest errors of the configuration, over the {found.frames - aside} frames in which it is determined"
    )
    return [CaptionedTable(caption, header, body)]


def checks_of_errors(found: PaperResults) -> list[Check]:
    """Check in the results `found` that the motion term leaves some error of the configuration."""
    most = {m: max(largest_configuration_errors(found.plan(FIG7_PROBLEM, m))) for m in FIG7_METHODS}
    weights = {m: found.plan(FIG7_PROBLEM, m).meta["options"]["motion_weight"] for m in FIG7_METHODS}
    parts = "; ".join(
        f"{most[m]:.2g} (rad or mm), with lambda {weights[m]:.2g} s², for {PAPER_METHOD_LABELS[m]}"
        for m in FIG7_METHODS
    )
    return [
        Check(
            "the errors are not perfectly close to zero, because of the smoothness regularisation",
            f"the largest error is {parts}; more than {NEGLIGIBLE_CONFIGURATION_ERROR:g} counts",
            sum(value > NEGLIGIBLE_CONFIGURATION_ERROR for value in most.values()),
            len(most),
        )
    ]


def rows_of_errors(found: PaperResults) -> list[dict[str, Any]]:
    """Return a row for each method and frame with the error of every coordinate, rad and mm; found: results."""
    result: list[dict[str, Any]] = []
    for method in FIG7_METHODS:
        plan = found.plan(FIG7_PROBLEM, method)
        errors = dict(zip(plan.robot.axes, error_from_truth(plan).T, strict=True))
        known = {"frame": np.arange(1, len(plan.time) + 1), "determined": ~gimbal_lock_frames(plan)}
        result += [{"method": method, **line} for line in columns_to_rows(known | errors)]
    return result


FIG7 = PaperSection(
    "fig7",
    "Fig. 7: time-varying target shapes",
    motion_tasks((FIG7_PROBLEM,), (*FIG7_METHODS, EUCLIDEAN_BASELINE)),
    "Ours, all frames at once, seen along y and along x; targets are thin dashed lines upon the tubes.",
    "Which frames the paper shows. It prints q2 with 7 of its 8 numbers: all angles are taken to end at pi.",
    lambda found: [published_comparison_table(found, (FIG7_PROBLEM,))],
    checks_of_shapes,
    by_frames((FIG7_PROBLEM,), FIG7_METHODS, ("e2", "max")),
    lambda found: shapes(found.plan(FIG7_PROBLEM, OUR_HORIZON)),
)
FIG8 = PaperSection(
    "fig8",
    "Fig. 8: errors of the configuration for time-varying targets",
    motion_tasks((FIG7_PROBLEM,), FIG7_METHODS),
    "Planned less known configuration. Columns have scales of their own. Where theta_x passes pi/2 (shaded), "
    "alpha and theta_y are one rotation and no shape tells them apart: these frames are left out of the table. "
    "Whole turns do not count, nor does the other way to write the same rotation (theta_x to pi - theta_x, all "
    "other angles by pi).",
    "Any number of the paper's Fig. 8, its weight's unit, and how it treats the rotation that no shape "
    "determines.",
    tables_of_errors,
    checks_of_errors,
    rows_of_errors,
    lambda found: configuration_errors(found.plans_by_label(FIG7_PROBLEM, FIG7_METHODS)),
)
