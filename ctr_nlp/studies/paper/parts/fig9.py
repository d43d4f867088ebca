"""Fig. 9 (d): the whole shape steered into a bronchus, and the tip alone."""

from __future__ import annotations

import matplotlib
from matplotlib.figure import Figure

from ctr_nlp.figures.parts.page import STYLE
from ctr_nlp.plan.account import shown as written
from ctr_nlp.studies.paper.checks import Check, number
from ctr_nlp.studies.paper.clips import Group, clips
from ctr_nlp.studies.paper.runs import HORIZON, NAMES, SEED, TIP, Found
from ctr_nlp.studies.paper.section import Section, Table, by_frames, motions

NAME = "bronchus"
METHODS = HORIZON, SEED, TIP
ARRIVED = 1.0
"""mm from its target within which a tip tracks it closely."""


def tables(found: Found) -> list[Table]:
    """Errors of shape and tip."""
    header = ["method", "e3, mm", "largest e1, mm", "largest tip error, mm"]
    body = [[NAMES[m], *(written(found.row(NAME, m)[key]) for key in ("e3", "e_max", "tip_max"))] for m in METHODS]
    return [Table("Shape and tip on the stiffness-dominant model", header, body)]


def checks(found: Found) -> list[Check]:
    """That a tip alone is well controlled and leaves the shape to itself."""
    tip, e3 = (number(found.row(NAME, TIP)[key]) for key in ("tip_max", "e3"))
    shape = {m: number(found.row(NAME, m)["e3"]) for m in (SEED, HORIZON)}
    better = [value < e3 for value in shape.values()]
    return [
        Check(
            "control of the tip alone tracks the path closely with the tip and leaves the shape misaligned; "
            "control of the shape aligns it better",
            f"the tip alone stays within {written(tip)} mm ({ARRIVED:g} mm counts as close) at an e3 of "
            f"{written(e3)} mm; " + ", ".join(f"{written(shape[m])} mm for {NAMES[m]}" for m in shape),
            int(tip <= ARRIVED) + sum(better),
            1 + len(better),
        )
    ]


@matplotlib.rc_context(STYLE)
def draw(found: Found) -> Figure:
    """Clips of ours above and of the tip alone below, seen from two sides."""
    views = ((0, "seen along y"), (1, "seen along x"))
    return clips(
        [[Group(f"{NAMES[m]}, {view}", found.plan(NAME, m), side) for side, view in views] for m in (HORIZON, TIP)]
    )


SECTION = Section(
    "fig9d",
    "Fig. 9 (d): the whole shape, and the tip alone",
    motions((NAME,), METHODS),
    "Ours above; below, control of the tip alone by the damped inverse of its Jacobian. All clips are to one "
    "scale.",
    "The paper's bronchus, and its numbers for the tip alone. Parts (a) to (c) of Fig. 9 are photographs of "
    "hardware.",
    tables,
    checks,
    by_frames((NAME,), METHODS, ("e2", "max", "tip")),
    draw,
)
