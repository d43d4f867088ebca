"""Figs. 5 and 6: distribution of e1 over the shape and over time, and errors by frame.

Section IV of the paper: e1 is the distance of points at equal arc length, e2 its root mean square over the shape,
e3 that of e2 over frames; all in mm. The paper's words about Fig. 6 ("noticeable escalation", "comparable") have
no numbers: the thresholds here are ours.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_nlp.plan.metrics import by_frame, e1
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.errors import by_frame_compared, errors_compared, spread
from paper.checks import Check, number, rms_between
from paper.runs import EUCLIDEAN_BASELINE, OUR_HORIZON, PAPER_METHOD_LABELS, PAPER_TWO_STAGE, PaperResults
from paper.section import (
    TABLE_II_PROBLEMS,
    CaptionedTable,
    PaperSection,
    by_frames,
    motion_tasks,
    published_comparison_table,
)

FIG5_METHODS = OUR_HORIZON, PAPER_TWO_STAGE
QUANTILES = {"quarter": 0.25, "median": 0.5, "three_quarters": 0.75, "most": 1.0}


def spread_tables(found: PaperResults) -> list[CaptionedTable]:
    """Tabulate published e3 and e4, all that the paper prints of Fig. 5, and e1 in the results `found`."""
    header = ["problem", *(f"{PAPER_METHOD_LABELS[method]}: median, largest" for method in FIG5_METHODS)]
    body = [
        [
            f"`{p}`",
            *(
                " / ".join(map(format_cell, np.nanquantile(e1(found.plan(p, m)), [0.5, 1]).tolist()))
                for m in FIG5_METHODS
            ),
        ]
        for p in TABLE_II_PROBLEMS
    ]
    return [
        published_comparison_table(found, TABLE_II_PROBLEMS, FIG5_METHODS),
        CaptionedTable("e1 in mm over all samples of all frames", header, body),
    ]


def spread_checks(found: PaperResults) -> list[Check]:
    """Check in the results `found` that targets which the robot can form are followed with the smallest error."""
    least = {m: min(TABLE_II_PROBLEMS, key=lambda p: number(found.row(p, m)["e3"])) for m in FIG5_METHODS}
    return [
        Check(
            "errors are relatively small on `synthesis`, whose targets are in the robot's workspace",
            "the smallest e3 of the six is that of "
            + " and ".join(f"`{least[m]}` for {PAPER_METHOD_LABELS[m]}" for m in FIG5_METHODS),
            sum(name == "synthesis" for name in least.values()),
            len(least),
        )
    ]


def spread_rows(found: PaperResults) -> list[dict[str, Any]]:
    """Return a row for each violin, with its quantiles in mm; found: results of the run."""
    return [
        {
            "problem": problem,
            "method": method,
            "from_s": begin,
            "to_s": end,
            **{f"{name}_mm": float(np.quantile(values, q)) for name, q in QUANTILES.items()},
        }
        for problem in TABLE_II_PROBLEMS
        for method in FIG5_METHODS
        for values, begin, end in spread(found.plan(problem, method))
    ]


FIG5 = PaperSection(
    "fig5",
    "Fig. 5: distance between robot and target over the shape and over time",
    motion_tasks(TABLE_II_PROBLEMS, FIG5_METHODS),
    "A pair of violins for each tenth of the motion, of e1 at 101 samples of each of its frames; bar and dot "
    "are the middle half and the median. The scale is that of square roots, and differs between panels.",
    "The paper prints no number of its Fig. 5 beyond e3 and e4 of Table II. Its formula of e1 is the square root "
    "of a norm, its words are the Euclidean distance: the words are followed.",
    spread_tables,
    spread_checks,
    spread_rows,
    lambda found: errors_compared(
        {problem: found.plans_by_label(problem, FIG5_METHODS) for problem in TABLE_II_PROBLEMS}
    ),
)


FIG6_PROBLEMS = "cos", "arc", "synthesis", "bronchus"
FIG6_METHODS = OUR_HORIZON, PAPER_TWO_STAGE, EUCLIDEAN_BASELINE
MIN_ESCALATION_FACTOR = 1.5
"""Least growth of an error, as a factor, that counts as escalating."""
MAX_COMPARABLE_ERROR_DIFFERENCE = 0.25
"""Largest difference of comparable errors, relative to the smaller one."""
MIN_INFERIORITY_FACTOR = 1.5
"""Least ratio of two errors that counts as significant."""
MIN_CONSISTENT_SHARE = 0.9
"""Least share of the frames that counts as consistent."""


def checks(found: PaperResults) -> list[Check]:
    """Check the paper's statement on each panel against the results `found`."""
    e2 = {p: {m: finite_errors(by_frame(found.plan(p, m))["e2"]) for m in FIG6_METHODS} for p in FIG6_PROBLEMS}
    verdicts = zip((check_cos, check_arc, check_synthesis, check_bronchus), FIG6_PROBLEMS, strict=True)
    return [verdict(e2[problem]) for verdict, problem in verdicts]


def finite_errors(e2: Array) -> Array:
    """Return the errors e2 (T,) without frames that were not reached, which are NaN."""
    return e2[np.isfinite(e2)]


def check_cos(e2: dict[str, Array]) -> Check:
    """Check the statement on cos: RMS of e2 over the last fifth of the frames against the frames before.

    e2: (T,) in mm by method.
    """
    growth = {m: rms_between(e2[m], 0.8, 1.0) / rms_between(e2[m], 0.0, 0.8) for m in FIG6_METHODS}
    parts = " and ".join(
        f"{growth[m]:.2g} times for {PAPER_METHOD_LABELS[m]}"
        for m in (EUCLIDEAN_BASELINE, PAPER_TWO_STAGE, OUR_HORIZON)
    )
    return Check(
        "(a) `cos`: the baseline's error escalates beyond frame 80 of 100, that of the paper's method does not",
        f"from the first four fifths of the frames to the last, the RMS of e2 grows {parts}; more than "
        f"{MIN_ESCALATION_FACTOR:g} times counts as escalating",
        int(growth[EUCLIDEAN_BASELINE] > MIN_ESCALATION_FACTOR)
        + int(growth[PAPER_TWO_STAGE] <= MIN_ESCALATION_FACTOR),
        2,
    )


def check_arc(e2: dict[str, Array]) -> Check:
    """Check the statement on the arc by e3; e2: (T,) in mm by method."""
    e3 = {m: rms_between(e2[m], 0.0, 1.0) for m in FIG6_METHODS}
    apart = _relative_difference(e3[PAPER_TWO_STAGE], e3[EUCLIDEAN_BASELINE])
    return Check(
        "(b) `arc`: the errors of the paper's method are comparable to the baseline's",
        f"e3 is {format_cell(e3[PAPER_TWO_STAGE])} mm for the paper's method and "
        f"{format_cell(e3[EUCLIDEAN_BASELINE])} mm for its baseline, "
        f"{apart:.0%} apart; up to {MAX_COMPARABLE_ERROR_DIFFERENCE:.0%} counts as comparable. Ours: "
        f"{format_cell(e3[OUR_HORIZON])} mm",
        int(apart <= MAX_COMPARABLE_ERROR_DIFFERENCE),
        1,
    )


def check_synthesis(e2: dict[str, Array]) -> Check:
    """Check the statement on synthesis by e3 and frame by frame; e2: (T,) in mm by method."""
    e3 = {m: rms_between(e2[m], 0.0, 1.0) for m in FIG6_METHODS}
    count = min(len(e2[EUCLIDEAN_BASELINE]), len(e2[PAPER_TWO_STAGE]))
    share = float(np.mean(e2[EUCLIDEAN_BASELINE][:count] > e2[PAPER_TWO_STAGE][:count]))
    return Check(
        "(c) `synthesis`: the baseline is consistently and significantly inferior to the paper's method",
        f"e3 is {e3[EUCLIDEAN_BASELINE]:.2g} mm for the baseline and {e3[PAPER_TWO_STAGE]:.2g} mm for the "
        f"paper's method; e2 is "
        f"larger for the baseline in {share:.0%} of the frames. At least {MIN_INFERIORITY_FACTOR:g} times and "
        f"{MIN_CONSISTENT_SHARE:.0%} of the frames count. Ours: {e3[OUR_HORIZON]:.2g} mm",
        int(e3[EUCLIDEAN_BASELINE] >= MIN_INFERIORITY_FACTOR * e3[PAPER_TWO_STAGE])
        + int(share >= MIN_CONSISTENT_SHARE),
        2,
    )


def check_bronchus(e2: dict[str, Array]) -> Check:
    """Check the statement on the bronchus by the first 20, the last 10 and the other frames of 100.

    e2: (T,) in mm by method.
    """
    ends = {"first 20": (0.0, 0.2), "middle 70": (0.2, 0.9), "last 10": (0.9, 1.0)}
    rms = {name: {m: rms_between(e2[m], *span) for m in FIG6_METHODS} for name, span in ends.items()}
    similar = [
        _relative_difference(rms[name][PAPER_TWO_STAGE], rms[name][EUCLIDEAN_BASELINE])
        <= MAX_COMPARABLE_ERROR_DIFFERENCE
        for name in ("first 20", "last 10")
    ]
    numbers = "; ".join(
        f"{name} % of the frames: "
        + ", ".join(f"{format_cell(rms[name][m])} ({PAPER_METHOD_LABELS[m]})" for m in FIG6_METHODS)
        for name in ends
    )
    return Check(
        "(d) `bronchus`: errors of the paper's method and the baseline are similar in the first 20 and the last "
        "10 frames of 100; between, the paper's method is better",
        f"RMS of e2 in mm, {numbers}; up to {MAX_COMPARABLE_ERROR_DIFFERENCE:.0%} apart counts as similar",
        sum(similar) + int(rms["middle 70"][PAPER_TWO_STAGE] < rms["middle 70"][EUCLIDEAN_BASELINE]),
        3,
    )


def _relative_difference(a: float, b: float) -> float:
    return max(a, b) / min(a, b) - 1


FIG6 = PaperSection(
    "fig6",
    "Fig. 6: largest error and RMSE by frame",
    motion_tasks(FIG6_PROBLEMS, FIG6_METHODS),
    "The scale is that of square roots, and differs between panels. The paper compares its own method with its "
    "baseline; its statements are checked on our re-implementations of these two.",
    "The curves of the paper's Fig. 6: only the statements below and Table II are known. Its weights of the "
    "motion term, 100 for its method and 500 for the baseline, have no unit; both re-implementations here use "
    "ours. Its bronchus is not public, ours is another.",
    lambda found: [published_comparison_table(found, FIG6_PROBLEMS)],
    checks,
    by_frames(FIG6_PROBLEMS, FIG6_METHODS, ("e2", "max")),
    lambda found: by_frame_compared(
        {problem: found.plans_by_label(problem, FIG6_METHODS) for problem in FIG6_PROBLEMS}
    ),
)
