"""Report on reached ends as a page of Markdown, a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.plan.verdicts import REACHED_VERDICT_NAMES
from ctr_nlp.studies.reached.cases import REACHED, MethodOutcomes
from ctr_nlp.studies.reached.picture import draw_outcomes
from ctr_nlp.support.tables import markdown, write_csv
from ctr_nlp.view.figures import save

FAILS: Mapping[str, str] = {
    "solved": "not solved",
    "stable": "snaps",
    "within_limits": "exceeds limits",
    "arrives": "does not arrive",
    "within_wall": "touches the wall",
    "holds": "does not hold on built robots",
}
"""Check of REACHED_VERDICT_NAMES -> label, in words, of plans that fail it first."""
FAIL_VERBS: Mapping[str, tuple[str, str]] = {
    "solved": ("is not solved", "are not solved"),
    "stable": ("snaps", "snap"),
    "within_limits": ("exceeds limits", "exceed limits"),
    "arrives": ("does not arrive", "do not arrive"),
    "within_wall": ("touches the wall", "touch the wall"),
    "holds": ("does not hold on built robots", "do not hold on built robots"),
}
"""The same in sentences, of one plan and of several."""
QUARTILES = {"least": 0.0, "quarter": 0.25, "median": 0.5, "three quarters": 0.75, "most": 1.0}
REACHED_PAGE_EXPLANATION = """\

![Outcomes of the plans of each kind](reached.png)

An end is **reached** where the plan is solved and stable on the elastic model, keeps the limits, brings the tip
within the tolerance of the target's end, presses no deeper into the wall than is allowed, in frames and between
them, and holds on simulated robots within the tolerances, which planning does not see: so many of these keep
their branch, arrive, and press no deeper than a millimetre. The thresholds are those of `ctr-nlp plan`. A plan
that fails counts for the first of these checks that does not read yes.
"""


def write(ways: Sequence[MethodOutcomes], folder: Path) -> None:
    """Write reached.md, .csv, .png and .pdf into an existing folder; ways: outcomes, one for each method."""
    rows = [{"way": way.name} | asdict(outcome) for way in ways for outcome in way.outcomes]
    write_csv(folder / "reached.csv", rows)
    for ending in ("png", "pdf"):
        save(draw_outcomes(ways, FAILS), folder / f"reached.{ending}")
    (folder / "reached.md").write_text(page(ways), encoding="utf-8")


def findings(ways: Sequence[MethodOutcomes]) -> list[str]:
    """Return a sentence for each of `ways`, the methods: how many ends it reaches, and why not the others."""
    return [
        f"{way.name}: {way.reached_count} of {len(way.outcomes)} ends are reached{_failure_reasons(way)}"
        for way in ways
    ]


def _failure_reasons(way: MethodOutcomes) -> str:
    """Describe why ends are not reached, the most frequent reason first; empty where all are."""
    counts = {check: sum(outcome.failed == check for outcome in way.outcomes) for check in REACHED_VERDICT_NAMES}
    failed = sorted((check for check in REACHED_VERDICT_NAMES if counts[check]), key=lambda check: -counts[check])
    told = [f"{counts[check]} {FAIL_VERBS[check][counts[check] > 1]}" for check in failed]
    return f"; of the other plans, {', '.join(told)}" if told else ""


def page(ways: Sequence[MethodOutcomes]) -> str:
    """Return the page in Markdown; ways: outcomes, one for each method."""
    title = f"# Which of {max(len(way.outcomes) for way in ways)} ends are reached\n\n"
    sentences = [f"{k}. {told[0].upper()}{told[1:]}.\n" for k, told in enumerate(findings(ways), 1)]
    body = [
        [
            way.name,
            *(
                str(sum(one.failed == check for one in way.outcomes))
                for check in (REACHED, *REACHED_VERDICT_NAMES)
            ),
        ]
        for way in ways
    ]
    table = f"\n## First check that fails\n\n{markdown(['', REACHED, *FAILS.values()], body)}"
    numbers = [
        _quantiles(title, ways, name)
        for title, name in (
            ("Tip to the target's end, mm", "tip"),
            ("Deepest contact, mm", "contact"),
            ("Share of simulated robots that hold", "held"),
            ("e3, mm", "e3"),
        )
    ]
    return "".join([title, *sentences, REACHED_PAGE_EXPLANATION, table, *numbers])


def _quantiles(title: str, ways: Sequence[MethodOutcomes], name: str) -> str:
    """Return a table of quantiles of a number over problems, a row for each of `ways`; a dash where unknown.

    title: of the table. name: of the number, a field of PlanOutcome.
    """
    rows = []
    for way in ways:
        values = np.array([getattr(outcome, name) for outcome in way.outcomes])
        known = values[~np.isnan(values)]
        found = np.quantile(known, list(QUARTILES.values())).tolist() if known.size else []
        rows.append([way.name, *(map(format_cell, found) if found else ["–"] * len(QUARTILES))])
    return f"\n## {title}\n\n{markdown(['', *QUARTILES], rows)}"
