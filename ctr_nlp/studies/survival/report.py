"""Report on plans on perturbed robots as a page of Markdown, a table and a figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.studies.robustness_trade_off import RobustnessPoint
from ctr_nlp.studies.survival.cases import Airway, mean_error_or_inf, write_rows
from ctr_nlp.studies.survival.distributions import distributions
from ctr_nlp.support.tables import markdown
from ctr_nlp.typing import Array
from ctr_nlp.view.figures import save

QUARTILES = {"least": 0.0, "quarter": 0.25, "median": 0.5, "three quarters": 0.75, "most": 1.0}
SURVIVAL_PAGE_EXPLANATION = """\

![How mean errors and shares lost are distributed](survival.png)

**Plans.** Synthetic airways are followed in their last 150 mm by the paper's robot of three tubes with the default
tolerances, without walls; {frames} frames in 10 s, on the elastic model. Plans for the robot as described keep a
stability margin of {margins}; the best margin is, in each airway, the one at which fewest draws are lost, and of
these the one of least mean e3: nobody knows it beforehand. Robust plans are made for the whole tolerances, as
`ctr-nlp plan` does.

**Draws.** All plans of an airway are judged on the same {draws} robots, drawn within the tolerances with a seed of
the airway's own, which planning does not see. A draw is lost where it snaps or slides onto another branch of
equilibria.
"""
SURVIVAL_PAGE_REPRODUCTION = """
## How to remake it

    ctr-nlp study examples/survival.toml --out DIR

writes `survival.md` (this page), `survival.csv` with a row for every plan, `survival.png` and `survival.pdf`,
beside the rows of the study. A study that was stopped goes on where it was.
"""


def write(airways: Sequence[Airway], folder: Path) -> None:
    """Write survival.md, .csv, .png and .pdf of the airways into an existing folder."""
    write_rows(airways, folder / "survival.csv")
    for ending in ("png", "pdf"):
        save(distributions(airways), folder / f"survival.{ending}")
    (folder / "survival.md").write_text(page(airways), encoding="utf-8")


def methods(airways: Sequence[Airway]) -> Mapping[str, list[RobustnessPoint]]:
    """Return the plans of all airways by kind of plan, in the order of tables."""
    margins = {
        f"margin {first.margin:g}": [airway.margins[k] for airway in airways]
        for k, first in enumerate(airways[0].margins)
    }
    best = {"best margin": [airway.best for airway in airways], "robust": [airway.robust for airway in airways]}
    return margins | best


def findings(airways: Sequence[Airway]) -> list[str]:
    """Return the findings on the airways, a sentence each."""
    count = len(airways)
    told = []
    named = {"plain": [a.plain for a in airways], "best margin": [a.best for a in airways]}
    for name, plans in (named | {"robust": [a.robust for a in airways]}).items():
        lost = sum(plan.lost for plan in plans)
        draws = sum(plan.draws for plan in plans)
        few = sum(plan.share <= MOST_LOST for plan in plans)
        told.append(
            f"{name}: {lost} of {draws} draws are lost, at most {MOST_LOST:.0%} in {few} of {count} airways; the "
            f"median of mean e3 is {np.nanmedian(_means(plans)):.3g} mm"
        )
    fewer = sum(a.robust.lost <= min(plan.lost for plan in a.margins) for a in airways)
    nearer = sum(mean_error_or_inf(a.robust) <= min(map(mean_error_or_inf, a.margins)) for a in airways)
    told.append(
        f"robust plans lose no more draws than any margin in {fewer} of {count} airways, and have no larger mean "
        f"e3 than any in {nearer}"
    )
    ratios = np.divide(_means([a.robust for a in airways]), _means([a.best for a in airways]))
    middle = np.nanmedian(ratios)
    most = np.nanmax(ratios)
    told.append(
        f"mean e3 of the robust plan is {middle:.2f} times that of the best margin in the median, and at most "
        f"{most:.2f} times"
    )
    unsolved = [plan.problem for a in airways for plan in a.plans if not plan.solved]
    told.append(
        f"not solved: plans of {', '.join(dict.fromkeys(unsolved))}" if unsolved else "every plan was solved"
    )
    return told


def page(airways: Sequence[Airway]) -> str:
    """Return the page on the airways in Markdown."""
    first = airways[0]
    every = methods(airways)
    sentences = [f"{k}. {told[0].upper()}{told[1:]}.\n" for k, told in enumerate(findings(airways), 1)]
    numbers = {
        "frames": first.frames,
        "draws": first.plain.draws,
        "margins": ", ".join(f"{plan.margin:g}" for plan in first.margins),
    }
    title = f"# How plans of {len(airways)} airways survive tubes that are not quite known\n\n"
    tables = [
        _table("Mean e3 over draws, mm", every, _means, format_cell),
        _table("Draws lost", every, lambda plans: np.array([plan.share for plan in plans]), "{:.1%}".format),
        _table(
            "e3 as planned, mm",
            every,
            lambda plans: np.array([plan.planned or np.nan for plan in plans]),
            format_cell,
        ),
    ]
    return "".join(
        [title, *sentences, SURVIVAL_PAGE_EXPLANATION.format(**numbers), *tables, SURVIVAL_PAGE_REPRODUCTION]
    )


def _table(
    title: str,
    every: Mapping[str, list[RobustnessPoint]],
    values: Callable[[Sequence[RobustnessPoint]], Array],
    text: Callable[[float], str],
) -> str:
    """Return a table of quantiles over airways, a row for each kind of plan, with the mean in the last column.

    every: plans of all airways by kind. values: plans -> numbers (n,). text: writes a number.
    """
    rows = []
    for name, plans in every.items():
        found = values(plans)
        numbers = [*np.nanquantile(found, list(QUARTILES.values())).tolist(), float(np.nanmean(found))]
        rows.append([name, *map(text, numbers)])
    return f"\n## {title}\n\n{markdown(['', *QUARTILES, 'mean'], rows)}"


def _means(plans: Sequence[RobustnessPoint]) -> Array:
    """Return the mean e3 (n,) of plans over sampled robots, mm; NaN where none has a shape."""
    return np.array([np.nan if plan.mean is None else plan.mean for plan in plans])
