"""Fig. 4, clips along primitive shapes, and Fig. 9 (d): the whole shape in a bronchus, and the tip alone."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ctr_nlp.plan.metrics import by_frame
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.view.figures.parts.page import STYLE
from paper.checks import Check, number
from paper.clips import ClipGroup, clip_frames, draw_clips
from paper.runs import OUR_HORIZON, PAPER_METHOD_LABELS, PAPER_TWO_STAGE, TIP_ONLY, PaperResults
from paper.section import (
    PRIMITIVE_SHAPES,
    CaptionedTable,
    PaperSection,
    by_frames,
    motion_tasks,
    published_comparison_table,
)

FIG4_STEP_TOLERANCE = 1e-6
"""Tolerance on the speed limits, rad or mm in a step."""


def tables(found: PaperResults) -> list[CaptionedTable]:
    """Return tables of errors beside published ones, and of the largest steps; found: results of the run."""
    header = ["problem", "largest e1, mm", "largest step of alpha, rad", "of beta, mm", "of theta, rad"]
    body = []
    for problem in PRIMITIVE_SHAPES:
        row = found.row(problem, OUR_HORIZON)
        keys = ("e_max", "step_alpha", "step_beta", "step_theta")
        body.append([f"`{problem}`", *(format_cell(row[key]) for key in keys)])
    steps = CaptionedTable("Ours: the largest distance, and the largest steps from frame to frame", header, body)
    return [published_comparison_table(found, PRIMITIVE_SHAPES, (OUR_HORIZON, PAPER_TWO_STAGE)), steps]


def checks(found: PaperResults) -> list[Check]:
    """Check in the results `found` that all frames are solved, and that the line has the largest error."""
    followed = [
        found.row(p, OUR_HORIZON)["failed"] == 0 and within_speed(found.plan(p, OUR_HORIZON))
        for p in PRIMITIVE_SHAPES
    ]
    hardest = {
        m: max(PRIMITIVE_SHAPES, key=lambda p: number(found.row(p, m)["e3"]))
        for m in (OUR_HORIZON, PAPER_TWO_STAGE)
    }
    failed = sum(found.row(p, OUR_HORIZON)["failed"] for p in PRIMITIVE_SHAPES)
    total = len(PRIMITIVE_SHAPES) * found.frames
    return [
        Check(
            "the robot is steered along all four paths, in a smooth continuous motion",
            f"ours solves {total - failed} of {total} frames, and keeps the robot's limits of speed in "
            f"{sum(within_speed(found.plan(p, OUR_HORIZON)) for p in PRIMITIVE_SHAPES)} of "
            f"{len(PRIMITIVE_SHAPES)} motions",
            sum(followed),
            len(followed),
        ),
        Check(
            "a straight line, which pre-curved tubes cannot form, has the largest error",
            "the largest e3 of the four is that of "
            + " and ".join(f"`{hardest[m]}` for {PAPER_METHOD_LABELS[m]}" for m in (OUR_HORIZON, PAPER_TWO_STAGE)),
            sum(name == "line" for name in hardest.values()),
            len(hardest),
        ),
    ]


def within_speed(plan: Plan) -> bool:
    """Return whether every step of a plan from frame to frame keeps the robot's speed limits."""
    return bool((np.abs(np.diff(plan.q, axis=0)) <= plan.robot.speed * plan.dt + FIG4_STEP_TOLERANCE).all())


def rows(found: PaperResults) -> list[dict[str, Any]]:
    """Return a row for each clip, with its errors in the results `found`."""
    result = []
    for problem in PRIMITIVE_SHAPES:
        columns = by_frame(found.plan(problem, OUR_HORIZON))
        for frame in clip_frames(found.frames):
            numbers = {f"{key}_mm": float(columns[key][frame - 1]) for key in ("e2", "max", "tip")}
            result.append({"problem": problem, "frame": frame, **numbers})
    return result


@matplotlib.rc_context(STYLE)
def draw(found: PaperResults) -> Figure:
    """Draw four clips of each primitive shape in the results `found`; the arc, which is wide, below the others."""

    def group(letter: str, problem: str) -> ClipGroup:
        return ClipGroup(f"({letter}) {problem}", found.plan(problem, OUR_HORIZON))

    return draw_clips([[group("a", "cos"), group("c", "line"), group("d", "line_arc")], [group("b", "arc")]])


FIG4 = PaperSection(
    "fig4",
    "Fig. 4: following primitive shapes",
    motion_tasks(PRIMITIVE_SHAPES, (OUR_HORIZON, PAPER_TWO_STAGE)),
    "Ours, all frames at once. Each tube is drawn where it is the outermost one, the target as a thin dashed line "
    "upon it. The paper's xy-plane lies in the robot's zx-plane, with the insertion direction z upwards; all "
    "clips are to one scale.",
    "Which frames the paper shows. Its formula of the arc, y = sqrt(1 - x²) - 100, has no real values on its "
    "range: read as sqrt(100² - x²) - 100. Line and arc of `line_arc` are joined here with a common tangent, 75 "
    "mm of each; the paper says only that they are connected.",
    tables,
    checks,
    rows,
    draw,
)


BRONCHUS = "bronchus"
TIP_METHODS = OUR_HORIZON, PAPER_TWO_STAGE, TIP_ONLY
CLOSE_TIP_TRACKING_MM = 1.0
"""Largest tip error that counts as close tracking, mm."""


def tip_tables(found: PaperResults) -> list[CaptionedTable]:
    """Return the table of errors of shape and tip in the results `found`."""
    header = ["method", "e3, mm", "largest e1, mm", "largest tip error, mm"]
    body = [
        [PAPER_METHOD_LABELS[m], *(format_cell(found.row(BRONCHUS, m)[key]) for key in ("e3", "e_max", "tip_max"))]
        for m in TIP_METHODS
    ]
    return [CaptionedTable("Shape and tip on the stiffness-dominant model", header, body)]


def tip_checks(found: PaperResults) -> list[Check]:
    """Check in the results `found` that control of the tip alone tracks the tip and misaligns the shape."""
    tip, e3 = (number(found.row(BRONCHUS, TIP_ONLY)[key]) for key in ("tip_max", "e3"))
    shape = {m: number(found.row(BRONCHUS, m)["e3"]) for m in (PAPER_TWO_STAGE, OUR_HORIZON)}
    better = [value < e3 for value in shape.values()]
    return [
        Check(
            "control of the tip alone tracks the path closely with the tip and leaves the shape misaligned; "
            "control of the shape aligns it better",
            f"the tip alone stays within {format_cell(tip)} mm ({CLOSE_TIP_TRACKING_MM:g} mm counts as close) "
            f"at an e3 of "
            f"{format_cell(e3)} mm; "
            + ", ".join(f"{format_cell(shape[m])} mm for {PAPER_METHOD_LABELS[m]}" for m in shape),
            int(tip <= CLOSE_TIP_TRACKING_MM) + sum(better),
            1 + len(better),
        )
    ]


@matplotlib.rc_context(STYLE)
def draw_tip(found: PaperResults) -> Figure:
    """Draw clips of ours above and of the tip alone below, from two sides; found: results of the run."""
    views = ((0, "seen along y"), (1, "seen along x"))
    return draw_clips(
        [
            [ClipGroup(f"{PAPER_METHOD_LABELS[m]}, {view}", found.plan(BRONCHUS, m), side) for side, view in views]
            for m in (OUR_HORIZON, TIP_ONLY)
        ]
    )


FIG9 = PaperSection(
    "fig9d",
    "Fig. 9 (d): the whole shape, and the tip alone",
    motion_tasks((BRONCHUS,), TIP_METHODS),
    "Ours above; below, control of the tip alone by the damped inverse of its Jacobian. All clips are to one "
    "scale.",
    "The paper's bronchus, and its numbers for the tip alone. Parts (a) to (c) of Fig. 9 are photographs of "
    "hardware.",
    tip_tables,
    tip_checks,
    by_frames((BRONCHUS,), TIP_METHODS, ("e2", "max", "tip")),
    draw_tip,
)
