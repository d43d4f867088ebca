"""Figs. 7 and 8: the time-varying target, whose configurations are known."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_nlp.figures.motion import configuration_errors, error_from_truth, indistinct
from ctr_nlp.figures.overlay import shapes
from ctr_nlp.plan.plan import Plan
from ctr_nlp.reference.published import SEED as PRINTED
from ctr_nlp.studies.paper.checks import Check, number, order
from ctr_nlp.studies.paper.runs import BASELINE, HORIZON, NAMES, SEED, Found
from ctr_nlp.studies.paper.section import Section, Table, beside, by_frames, mm, motions
from ctr_nlp.support.tables import by_line

NAME = "synthesis"
METHODS = HORIZON, SEED
NOTHING = 1e-3
"""rad or mm: an error of less is none."""


def checks_of_shapes(found: Found) -> list[Check]:
    """That targets are reached as well as the paper says, or better."""
    published = PRINTED[NAME]
    ours = {m: number(found.row(NAME, m)["e3"]) for m in METHODS}
    said = "; ".join(f"{mm(e3)} mm, {order(e3, published[0])}, for {NAMES[m]}" for m, e3 in ours.items())
    return [
        Check(
            f"the robot aligns well with the time-varying shapes: e3 is {published[0]:.2f} mm, at lengths up to "
            "150 mm",
            f"e3 is {said}",
            sum(order(e3, published[0]) != "higher" for e3 in ours.values()),
            len(ours),
        )
    ]


def largest(plan: Plan) -> tuple[float, float, float]:
    """Largest errors of alpha (rad), beta (mm) and theta (rad) over the frames in which they are determined."""
    error = np.abs(error_from_truth(plan))[~indistinct(plan)]
    alpha, beta, theta = (float(np.nanmax(values, initial=0.0)) for values in plan.robot.split(error))
    return alpha, beta, theta


def tables_of_errors(found: Found) -> list[Table]:
    """The largest errors of each method."""
    header = ["method", "alpha, rad", "beta, mm", "theta, rad"]
    body = [[NAMES[m], *(f"{value:.2g}" for value in largest(found.plan(NAME, m)))] for m in METHODS]
    aside = int(indistinct(found.plan(NAME, HORIZON)).sum())
    caption = (
        f"Largest errors of the configuration, over the {found.frames - aside} frames in which it is determined"
    )
    return [Table(caption, header, body)]


def checks_of_errors(found: Found) -> list[Check]:
    """That the motion term leaves some error."""
    most = {m: max(largest(found.plan(NAME, m))) for m in METHODS}
    weights = {m: found.plan(NAME, m).meta["options"]["motion_weight"] for m in METHODS}
    parts = "; ".join(
        f"{most[m]:.2g} (rad or mm), with lambda {weights[m]:.2g} s², for {NAMES[m]}" for m in METHODS
    )
    return [
        Check(
            "the errors are not perfectly close to zero, because of the smoothness regularisation",
            f"the largest error is {parts}; more than {NOTHING:g} counts",
            sum(value > NOTHING for value in most.values()),
            len(most),
        )
    ]


def rows_of_errors(found: Found) -> list[dict[str, Any]]:
    """A line for each method and frame with the error of every coordinate, rad and mm."""
    result: list[dict[str, Any]] = []
    for method in METHODS:
        plan = found.plan(NAME, method)
        errors = dict(zip(plan.robot.axes, error_from_truth(plan).T, strict=True))
        known = {"frame": np.arange(1, len(plan.time) + 1), "determined": ~indistinct(plan)}
        result += [{"method": method, **line} for line in by_line(known | errors)]
    return result


FIG7 = Section(
    "fig7",
    "Fig. 7: time-varying target shapes",
    motions((NAME,), (*METHODS, BASELINE)),
    "Ours, all frames at once, seen along y and along x; targets are thin dashed lines upon the tubes.",
    "Which frames the paper shows. It prints q2 with 7 of its 8 numbers: all angles are taken to end at pi.",
    lambda found: [beside(found, (NAME,))],
    checks_of_shapes,
    by_frames((NAME,), METHODS, ("e2", "max")),
    lambda found: shapes(found.plan(NAME, HORIZON)),
)
FIG8 = Section(
    "fig8",
    "Fig. 8: errors of the configuration for time-varying targets",
    motions((NAME,), METHODS),
    "Planned less known configuration. Columns have scales of their own. Where theta_x passes pi/2 (shaded), "
    "alpha and theta_y are one rotation and no shape tells them apart: these frames are left out of the table. "
    "Whole turns do not count, nor does the other way to write the same rotation (theta_x to pi - theta_x, all "
    "other angles by pi).",
    "Any number of the paper's Fig. 8, its weight's unit, and how it treats the rotation that no shape "
    "determines.",
    tables_of_errors,
    checks_of_errors,
    rows_of_errors,
    lambda found: configuration_errors(found.named(NAME, METHODS)),
)
