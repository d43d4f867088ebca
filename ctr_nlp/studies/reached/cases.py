"""Outcomes of a study's plans, grouped by planning method: the first check that each plan fails."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ctr_nlp.plan.verdicts import REACHED_VERDICT_NAMES, YES
from ctr_nlp.studies.airways import shown_name

REACHED = "reached"


@dataclass(frozen=True)
class PlanOutcome:
    """Outcome of one plan.

    Attributes
    ----------
    problem : str
        Name of the problem.
    failed : str
        First of REACHED_VERDICT_NAMES that is not yes, or REACHED.
    tip : float
        Distance of the tip from the target's end in the last frame, mm.
    contact : float
        Deepest contact with the wall, mm; NaN where no wall is known.
    held : float
        Share of the sampled robots that pass the verdict `holds`; NaN where none were sampled.
    e3 : float
        Mean error, mm.
    """

    problem: str
    failed: str
    tip: float
    contact: float
    held: float
    e3: float


@dataclass(frozen=True)
class MethodOutcomes:
    """Outcomes of one planning method on many problems: its name, and an outcome for each problem."""

    name: str
    outcomes: tuple[PlanOutcome, ...]

    @property
    def reached_count(self) -> int:
        """Number of problems whose end is reached."""
        return sum(outcome.failed == REACHED for outcome in self.outcomes)


def from_rows(rows: Sequence[Mapping[str, Any]]) -> list[MethodOutcomes]:
    """Group the rows of a study by robot, method and settings.

    Parameters
    ----------
    rows : sequence of mapping
        As `Case.row` makes them. Where there is no plan, the problem counts as not solved.

    Returns
    -------
    list of MethodOutcomes
        In the order of the rows.
    """
    found = dict[str, list[PlanOutcome]]()
    several = len({row["robot_name"] for row in rows}) > 1
    for row in rows:
        found.setdefault(_name(row, several), []).append(outcome_of(row))
    return [MethodOutcomes(name, tuple(outcomes)) for name, outcomes in found.items()]


def _name(row: Mapping[str, Any], several: bool) -> str:
    """Name how a row was planned: the method, its settings, and the robot where there are several."""
    told = [row["method"].replace("horizon", "over all frames").replace("robust-", "robust ")]
    settings = {
        key: row[key] for key in sorted(row) if key.startswith("set_") and not math.isnan(read_number(row[key]))
    }
    told += [f"{key.removeprefix('set_')} {value:g}" for key, value in settings.items()]
    return ", ".join([*told, row["robot_name"]] if several else told)


def outcome_of(row: Mapping[str, Any]) -> PlanOutcome:
    """Read the outcome of a plan from the row of a study.

    Parameters
    ----------
    row : mapping
        As `Case.row` makes it. Without a plan, the outcome is that it is not solved.

    Returns
    -------
    PlanOutcome
        The first check that fails, and the figures that decide.
    """
    failed = next((check for check in REACHED_VERDICT_NAMES if row.get(f"verdict_{check}") != YES), REACHED)
    tip, held, e3 = (read_number(row.get(key)) for key in ("tip_last", "robustness_held_share", "e3"))
    # `contact_depth` of a row sums the depths of all frames; the verdict is on the deepest one.
    clearances = (row.get(key) for key in ("clearance_min", "clearance_between_min"))
    least = min((value for each in clearances if not math.isnan(value := read_number(each))), default=math.nan)
    return PlanOutcome(shown_name(row["problem"]), failed, tip, max(-least, 0.0), held, e3)


def read_number(value: Any) -> float:
    """Read a number of a row.

    Parameters
    ----------
    value : object
        The entry of a column.

    Returns
    -------
    float
        NaN where it is no number: tables write NaN for what a row does not have.
    """
    return float(value) if isinstance(value, int | float) else math.nan
