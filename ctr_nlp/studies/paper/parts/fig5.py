"""Fig. 5: how e1 spreads over the shape as time passes."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_nlp.figures.errors import errors_compared, spread
from ctr_nlp.plan.account import shown
from ctr_nlp.plan.metrics import e1
from ctr_nlp.studies.paper.checks import Check, number
from ctr_nlp.studies.paper.runs import HORIZON, NAMES, SEED, Found
from ctr_nlp.studies.paper.section import ALL, Section, Table, beside, motions

METHODS = HORIZON, SEED
QUANTILES = {"quarter": 0.25, "median": 0.5, "three_quarters": 0.75, "most": 1.0}


def tables(found: Found) -> list[Table]:
    """Published e3 and e4, which are all that the paper prints of it, and medians of e1."""
    header = ["problem", *(f"{NAMES[method]}: median, largest" for method in METHODS)]
    body = [
        [
            f"`{p}`",
            *(" / ".join(map(shown, np.nanquantile(e1(found.plan(p, m)), [0.5, 1]).tolist())) for m in METHODS),
        ]
        for p in ALL
    ]
    return [beside(found, ALL, METHODS), Table("e1 in mm over all samples of all frames", header, body)]


def checks(found: Found) -> list[Check]:
    """That what the robot can form is fitted best."""
    least = {m: min(ALL, key=lambda p: number(found.row(p, m)["e3"])) for m in METHODS}
    return [
        Check(
            "errors are relatively small on `synthesis`, whose targets are in the robot's workspace",
            "the smallest e3 of the six is that of "
            + " and ".join(f"`{least[m]}` for {NAMES[m]}" for m in METHODS),
            sum(name == "synthesis" for name in least.values()),
            len(least),
        )
    ]


def rows(found: Found) -> list[dict[str, Any]]:
    """A line for each violin."""
    return [
        {
            "problem": problem,
            "method": method,
            "from_s": begin,
            "to_s": end,
            **{f"{name}_mm": float(np.quantile(values, q)) for name, q in QUANTILES.items()},
        }
        for problem in ALL
        for method in METHODS
        for values, begin, end in spread(found.plan(problem, method))
    ]


SECTION = Section(
    "fig5",
    "Fig. 5: distance between robot and target over the shape and over time",
    motions(ALL, METHODS),
    "A pair of violins for each tenth of the motion, of e1 at 101 samples of each of its frames; bar and dot "
    "are the middle half and the median. The scale is that of square roots, and differs between panels.",
    "The paper prints no number of its Fig. 5 beyond e3 and e4 of Table II. Its formula of e1 is the square root "
    "of a norm, its words are the Euclidean distance: the words are followed.",
    tables,
    checks,
    rows,
    lambda found: errors_compared({problem: found.named(problem, METHODS) for problem in ALL}),
)
