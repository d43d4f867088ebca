"""Airways of a study, without walls: nominal plans at several margins and a robust one, on the same samples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ctr_nlp.ocp.settings import Settings
from ctr_nlp.studies.airways import shown_name
from ctr_nlp.studies.grid.case import CASE_DONE
from ctr_nlp.studies.robustness_trade_off import RobustnessPoint
from ctr_nlp.support.tables import write_csv

ROBUST_METHOD = "robust-horizon"
"""Method of robust plans; other methods plan for the nominal robot."""


@dataclass(frozen=True)
class Airway:
    """Plans of an airway, or of another problem, judged on the same sampled robots.

    margins: nominal plans, the least stability margin first; robust: the plan for the robot's tolerances.
    """

    name: str
    frames: int
    margins: tuple[RobustnessPoint, ...]
    robust: RobustnessPoint

    @property
    def plain(self) -> RobustnessPoint:
        """Nominal plan at the default margin, which is the least."""
        return self.margins[0]

    @property
    def best(self) -> RobustnessPoint:
        """Nominal plan with the fewest failed samples; of equals the one with the least mean error."""
        return min(self.margins, key=lambda plan: (plan.lost, mean_error_or_inf(plan)))

    @property
    def plans(self) -> tuple[RobustnessPoint, ...]:
        """All plans of the airway, the robust one last."""
        return *self.margins, self.robust


def mean_error_or_inf(plan: RobustnessPoint) -> float:
    """Return the mean e3 of a plan over sampled robots, mm; infinite where none has a shape."""
    return math.inf if plan.mean is None else plan.mean


def from_rows(rows: Sequence[Mapping[str, Any]]) -> list[Airway]:
    """Make airways of a study's rows; those without a nominal plan or a robust one are left out."""
    found = dict[str, list[Mapping[str, Any]]]()
    for row in (row for row in rows if row["status"] == CASE_DONE):
        found.setdefault(row["problem"], []).append(row)
    return [airway for plans in found.values() if (airway := _airway(plans)) is not None]


def _airway(rows: Sequence[Mapping[str, Any]]) -> Airway | None:
    plans = sorted(map(_plan_from_row, rows), key=lambda plan: plan.margin)
    margins, robust = ([plan for plan in plans if (plan.amount > 0) is asked] for asked in (False, True))
    if not margins or len(robust) != 1:
        return None
    return Airway(margins[0].problem, int(rows[0]["frames"]), tuple(margins), robust[0])


def _plan_from_row(row: Mapping[str, Any]) -> RobustnessPoint:
    margin = row.get("set_stability_margin")
    # Tables write NaN in columns that a row does not have.
    known = margin is not None and not math.isnan(margin)
    return RobustnessPoint(
        problem=shown_name(row["problem"]),
        amount=float(row["method"] == ROBUST_METHOD),
        margin=margin if margin is not None and known else float(Settings().stability_margin or 0.0),
        planned=row["e3"],
        mean=row.get("robustness_e3_mean"),
        lost=int(row["robustness_lost"]),
        draws=int(row["robustness_draws"]),
        solved=bool(row["complete"]),
    )


def write_rows(airways: Sequence[Airway], path: Path) -> None:
    """Write a CSV file at `path` with a row for every plan of the airways."""
    rows = [
        {"airway": airway.name, "frames": airway.frames} | asdict(plan) | {"lost_share": plan.share}
        for airway in airways
        for plan in airway.plans
    ]
    write_csv(path, rows)
