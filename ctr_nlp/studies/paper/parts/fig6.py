"""Figs. 5 and 6: how e1 spreads over the shape as time passes, and errors by frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_nlp.figures.errors import by_frame_compared, errors_compared, spread
from ctr_nlp.plan.account import shown
from ctr_nlp.plan.metrics import by_frame, e1
from ctr_nlp.studies.paper.checks import Check, number, part
from ctr_nlp.studies.paper.runs import BASELINE, HORIZON, NAMES, SEED, Found
from ctr_nlp.studies.paper.section import ALL, Section, Table, beside, by_frames, motions
from ctr_nlp.typing import Array

PAIR = HORIZON, SEED
QUANTILES = {"quarter": 0.25, "median": 0.5, "three_quarters": 0.75, "most": 1.0}


def spread_tables(found: Found) -> list[Table]:
    """Tabulate published e3 and e4, which are all that the paper prints of it, and medians of e1."""
    header = ["problem", *(f"{NAMES[method]}: median, largest" for method in PAIR)]
    body = [
        [
            f"`{p}`",
            *(" / ".join(map(shown, np.nanquantile(e1(found.plan(p, m)), [0.5, 1]).tolist())) for m in PAIR),
        ]
        for p in ALL
    ]
    return [beside(found, ALL, PAIR), Table("e1 in mm over all samples of all frames", header, body)]


def spread_checks(found: Found) -> list[Check]:
    """Check that targets which the robot can form are followed with the smallest error."""
    least = {m: min(ALL, key=lambda p: number(found.row(p, m)["e3"])) for m in PAIR}
    return [
        Check(
            "errors are relatively small on `synthesis`, whose targets are in the robot's workspace",
            "the smallest e3 of the six is that of " + " and ".join(f"`{least[m]}` for {NAMES[m]}" for m in PAIR),
            sum(name == "synthesis" for name in least.values()),
            len(least),
        )
    ]


def spread_rows(found: Found) -> list[dict[str, Any]]:
    """Return a line for each violin."""
    return [
        {
            "problem": problem,
            "method": method,
            "from_s": begin,
            "to_s": end,
            **{f"{name}_mm": float(np.quantile(values, q)) for name, q in QUANTILES.items()},
        }
        for problem in ALL
        for method in PAIR
        for values, begin, end in spread(found.plan(problem, method))
    ]


FIG5 = Section(
    "fig5",
    "Fig. 5: distance between robot and target over the shape and over time",
    motions(ALL, PAIR),
    "A pair of violins for each tenth of the motion, of e1 at 101 samples of each of its frames; bar and dot "
    "are the middle half and the median. The scale is that of square roots, and differs between panels.",
    "The paper prints no number of its Fig. 5 beyond e3 and e4 of Table II. Its formula of e1 is the square root "
    "of a norm, its words are the Euclidean distance: the words are followed.",
    spread_tables,
    spread_checks,
    spread_rows,
    lambda found: errors_compared({problem: found.named(problem, PAIR) for problem in ALL}),
)


PROBLEMS = "cos", "arc", "synthesis", "bronchus"
METHODS = HORIZON, SEED, BASELINE
ESCALATES = 1.5
"""Factor by which errors grow where they escalate."""
COMPARABLE = 0.25
"""Largest difference of comparable errors, as a part of the smaller one."""
INFERIOR = 1.5
"""Factor by which an error is at least larger that is significantly so."""
CONSISTENT = 0.9
"""Least share of the frames in which something holds that holds consistently."""


def checks(found: Found) -> list[Check]:
    """Check the paper's statement on each panel."""
    e2 = {p: {m: known(by_frame(found.plan(p, m))["e2"]) for m in METHODS} for p in PROBLEMS}
    verdicts = zip((escalating, comparable, inferior, in_the_middle), PROBLEMS, strict=True)
    return [verdict(e2[problem]) for verdict, problem in verdicts]


def known(e2: Array) -> Array:
    """Return the errors of frames that were reached."""
    return e2[np.isfinite(e2)]


def escalating(e2: dict[str, Array]) -> Check:
    """Check the statement on cos, by the RMS of e2 over the last fifth of the frames against those before."""
    growth = {m: part(e2[m], 0.8, 1.0) / part(e2[m], 0.0, 0.8) for m in METHODS}
    parts = " and ".join(f"{growth[m]:.2g} times for {NAMES[m]}" for m in (BASELINE, SEED, HORIZON))
    return Check(
        "(a) `cos`: the baseline's error escalates beyond frame 80 of 100, that of the paper's method does not",
        f"from the first four fifths of the frames to the last, the RMS of e2 grows {parts}; more than "
        f"{ESCALATES:g} times counts as escalating",
        int(growth[BASELINE] > ESCALATES) + int(growth[SEED] <= ESCALATES),
        2,
    )


def comparable(e2: dict[str, Array]) -> Check:
    """Check the statement on the arc, by e3."""
    e3 = {m: part(e2[m], 0.0, 1.0) for m in METHODS}
    apart = _apart(e3[SEED], e3[BASELINE])
    return Check(
        "(b) `arc`: the errors of the paper's method are comparable to the baseline's",
        f"e3 is {shown(e3[SEED])} mm for the paper's method and {shown(e3[BASELINE])} mm for its baseline, "
        f"{apart:.0%} apart; up to {COMPARABLE:.0%} counts as comparable. Ours: {shown(e3[HORIZON])} mm",
        int(apart <= COMPARABLE),
        1,
    )


def inferior(e2: dict[str, Array]) -> Check:
    """Check the statement on synthesis, by e3 and frame by frame."""
    e3 = {m: part(e2[m], 0.0, 1.0) for m in METHODS}
    count = min(len(e2[BASELINE]), len(e2[SEED]))
    share = float(np.mean(e2[BASELINE][:count] > e2[SEED][:count]))
    return Check(
        "(c) `synthesis`: the baseline is consistently and significantly inferior to the paper's method",
        f"e3 is {e3[BASELINE]:.2g} mm for the baseline and {e3[SEED]:.2g} mm for the paper's method; e2 is "
        f"larger for the baseline in {share:.0%} of the frames. At least {INFERIOR:g} times and "
        f"{CONSISTENT:.0%} of the frames count. Ours: {e3[HORIZON]:.2g} mm",
        int(e3[BASELINE] >= INFERIOR * e3[SEED]) + int(share >= CONSISTENT),
        2,
    )


def in_the_middle(e2: dict[str, Array]) -> Check:
    """Check the statement on the bronchus, by the first 20, the last 10 and the other frames of 100."""
    ends = {"first 20": (0.0, 0.2), "middle 70": (0.2, 0.9), "last 10": (0.9, 1.0)}
    rms = {name: {m: part(e2[m], *span) for m in METHODS} for name, span in ends.items()}
    similar = [_apart(rms[name][SEED], rms[name][BASELINE]) <= COMPARABLE for name in ("first 20", "last 10")]
    numbers = "; ".join(
        f"{name} % of the frames: " + ", ".join(f"{shown(rms[name][m])} ({NAMES[m]})" for m in METHODS)
        for name in ends
    )
    return Check(
        "(d) `bronchus`: errors of the paper's method and the baseline are similar in the first 20 and the last "
        "10 frames of 100; between, the paper's method is better",
        f"RMS of e2 in mm, {numbers}; up to {COMPARABLE:.0%} apart counts as similar",
        sum(similar) + int(rms["middle 70"][SEED] < rms["middle 70"][BASELINE]),
        3,
    )


def _apart(a: float, b: float) -> float:
    return max(a, b) / min(a, b) - 1


FIG6 = Section(
    "fig6",
    "Fig. 6: largest error and RMSE by frame",
    motions(PROBLEMS, METHODS),
    "The scale is that of square roots, and differs between panels. The paper compares its own method with its "
    "baseline; its statements are checked on our re-implementations of these two.",
    "The curves of the paper's Fig. 6: only the statements below and Table II are known. Its weights of the "
    "motion term, 100 for its method and 500 for the baseline, have no unit; both re-implementations here use "
    "ours. Its bronchus is not public, ours is another.",
    lambda found: [beside(found, PROBLEMS)],
    checks,
    by_frames(PROBLEMS, METHODS, ("e2", "max")),
    lambda found: by_frame_compared({problem: found.named(problem, METHODS) for problem in PROBLEMS}),
)
