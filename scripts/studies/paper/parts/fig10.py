"""Fig. 10: tubes of varying curvature along a path of varying curvature."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp.models.dominant import shape as dominant
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.support.tables import columns_to_rows
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.page import STYLE
from ctr_nlp.view.figures.parts.palette import BLACK, tube_colour, tube_width
from paper.checks import Check, number
from paper.clips import CLIPS_KEY_HEIGHT_INCH, CLIPS_LEFT_MARGIN_INCH, CLIPS_WIDTH_INCH, ClipGroup, draw_clips
from paper.runs import EUCLIDEAN_BASELINE, OUR_HORIZON, PAPER_METHOD_LABELS, PAPER_TWO_STAGE, PaperResults
from paper.section import CaptionedTable, PaperSection, format_errors, motion_tasks

FIG10_PROBLEMS = {"euler": "(a) three Euler curves", "euler_mixed": "(b) a line, an arc and an Euler curve"}
FIG10_METHODS = OUR_HORIZON, PAPER_TWO_STAGE, EUCLIDEAN_BASELINE
CURVATURE_PANEL_HEIGHT_INCH = 2.3
"""Height of the panel of curvatures with its labels, inches."""
FIG10_CURVATURE_SPACING_MM = 1.0
"""Distance along the robot of the points at which curvatures are computed, mm."""


def tables(found: PaperResults) -> list[CaptionedTable]:
    """Return the table of errors of all methods in the results `found`; the paper prints none."""
    header = ["problem", "the paper (published)", *(PAPER_METHOD_LABELS[m] for m in FIG10_METHODS)]
    body = [[f"`{p}`", "none", *(format_errors(found, p, m) for m in FIG10_METHODS)] for p in FIG10_PROBLEMS]
    return [CaptionedTable("e3 / e4 in mm on the stiffness-dominant model", header, body)]


def checks(found: PaperResults) -> list[Check]:
    """Return the check on following the path in the results `found`; the paper gives no number to compare with."""
    parts = []
    for problem in FIG10_PROBLEMS:
        plan = found.plan(problem, OUR_HORIZON)
        e3 = number(found.row(problem, OUR_HORIZON)["e3"])
        length = float(np.linalg.norm(np.diff(plan.target[-1], axis=0), axis=1).sum())
        parts.append(
            f"`{problem}`: e3 of {format_cell(e3)} mm over targets of up to {length:.0f} mm, {e3 / length:.2%}"
        )
    return [
        Check(
            "robots of tubes with varying curvature follow the path well",
            f"ours, {'; '.join(parts)}. The paper prints no error to compare with",
            0,
            0,
        )
    ]


def curvatures(plan: Plan) -> dict[str, Array]:
    """Compute curvatures along the robot in the last frame of a plan.

    Returns arrays (n,): "s", arc length in mm; "k_1" .. "k_d" of the tubes, NaN beyond their tips; "robot" and
    "target"; in 1/mm.
    """
    robot = plan.robot
    beta = plan.beta[-1]
    s = np.arange(0.0, beta[-1], FIG10_CURVATURE_SPACING_MM)
    tubes = {}
    for i, tube in enumerate(robot.tube_numbers):
        # Pre-curvature is linear in the distance from the tube's own tip, over its curved part.
        from_tip = np.minimum(beta[i] - s, tube.curved_length)
        tubes[f"k_{i + 1}"] = np.where(s <= beta[i], tube.tip_curvature + tube.slope * from_tip, np.nan)
    whole = dominant.curvature(robot.tube_numbers, list(beta), s, lambda x: np.heaviside(x, 0.0), np)
    return {"s": s, **tubes, "robot": whole, "target": np.interp(s, *target_curvature(plan.target[-1]))}


def target_curvature(points: Array) -> tuple[Array, Array]:
    """Compute arc length, mm, and curvature, 1/mm, (n - 2,) each, at the inner points of a curve (n, 3), mm."""
    chords = np.diff(points, axis=0)
    lengths = np.linalg.norm(chords, axis=1)
    crossed = np.linalg.norm(np.cross(chords[:-1], chords[1:]), axis=1)
    # The angle between neighbouring chords over their mean length. arctan2 stays accurate at small angles, where
    # the arc cosine of a dot product does not.
    angle = np.arctan2(crossed, (chords[:-1] * chords[1:]).sum(axis=1))
    return np.cumsum(lengths)[:-1], 2 * angle / (lengths[:-1] + lengths[1:])


def rows(found: PaperResults) -> list[dict[str, Any]]:
    """Return a row for each problem and mm along the robot in the last frame: curvatures in 1/mm, "" beyond a tip.

    found: results of the run.
    """
    result: list[dict[str, Any]] = []
    for problem in FIG10_PROBLEMS:
        for line in columns_to_rows(curvatures(found.plan(problem, OUR_HORIZON))):
            numbers = {name: "" if np.isnan(value) else value for name, value in line.items()}
            result.append({"problem": problem, **numbers})
    return result


@matplotlib.rc_context(STYLE)
def draw(found: PaperResults) -> Figure:
    """Draw clips of both robots in the results `found`, and curvatures along them in the last frame."""
    plans = {title: found.plan(problem, OUR_HORIZON) for problem, title in FIG10_PROBLEMS.items()}
    figure = draw_clips([[ClipGroup(title, plan) for title, plan in plans.items()]], CURVATURE_PANEL_HEIGHT_INCH)
    height = figure.get_figheight()
    wide = (CLIPS_WIDTH_INCH - 2 * CLIPS_LEFT_MARGIN_INCH - 0.5) / 2
    first: Axes | None = None
    for k, (title, plan) in enumerate(plans.items()):
        left = CLIPS_LEFT_MARGIN_INCH + 0.15 + k * (wide + CLIPS_LEFT_MARGIN_INCH)
        box = (
            left / CLIPS_WIDTH_INCH,
            (CLIPS_KEY_HEIGHT_INCH + 0.45) / height,
            wide / CLIPS_WIDTH_INCH,
            (CURVATURE_PANEL_HEIGHT_INCH - 0.75) / height,
        )
        axes = figure.add_axes(box, sharey=first)
        first = first or axes
        _curvatures(axes, plan)
        axes.set_title(f"{title[:3]} curvatures, last frame", loc="left")
        if k == 0:
            axes.set_ylabel("curvature (1/mm)")
    return figure


def _curvatures(axes: Axes, plan: Plan) -> None:
    columns = curvatures(plan)
    s = columns["s"]
    start = 0.0
    for i in range(plan.robot.d):
        value = columns[f"k_{i + 1}"]
        end = plan.beta[-1, i]
        seen = (s >= start) & (s <= end)
        axes.plot(s, value, color=tube_colour(i), lw=0.9, ls=":")
        axes.plot(s[seen], value[seen], color=tube_colour(i), lw=tube_width(i, plan.robot.d))
        start = end
    axes.plot(s, columns["target"], color=BLACK, lw=0.8, ls=(0, (4, 2)))
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("s (mm)")


FIG10 = PaperSection(
    "fig10",
    "Fig. 10: tubes of varying curvature",
    motion_tasks(tuple(FIG10_PROBLEMS), FIG10_METHODS),
    "Ours, all frames at once. Below, pre-curvatures k_i(s) of the tubes along the robot when it is all out, "
    "thick where a tube is the outermost one, so that it sets the robot's curvature, dotted where it lies "
    "within another; and the target's, dashed.",
    "The paper gives no numbers of these tubes and of this path: those of `problems/euler.py` and "
    "`problems/euler_mixed.py` are ours, with the paper's kinds of curves. So no error here can be held against "
    "it.",
    tables,
    checks,
    rows,
    draw,
)
