"""Airways one after another, without walls: plain plans at several margins and a robust one, on the same draws."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ctr_nlp.exceptions import OptionError
from ctr_nlp.studies.clearance.cases import problem_of
from ctr_nlp.studies.trade import MARGINS, Traded, asked, traded
from ctr_nlp.support.pool import side_by_side
from ctr_nlp.support.tables import write_csv

AMOUNTS = (1.0,)
"""Of the tolerances that robust plans are made for."""
DRAWS, FIRST_SEED = 100, 20270000
"""Of the robots on which the plans of an airway are judged; the seeds of airways' draws count on from the last."""


@dataclass(frozen=True)
class Airway:
    """Plans of a synthetic airway, judged on the same draws.

    margins: plans for the robot described, the least margin first; robust: the one for its tolerances.
    """

    seed: int
    frames: int
    margins: tuple[Traded, ...]
    robust: Traded

    @property
    def plain(self) -> Traded:
        """At the usual margin, which is the least."""
        return self.margins[0]

    @property
    def best(self) -> Traded:
        """Of all margins: fewest draws are lost, and of these the least mean error."""
        return min(self.margins, key=lambda plan: (plan.lost, mean_of(plan)))

    @property
    def plans(self) -> tuple[Traded, ...]:
        """All of them, the robust one last."""
        return *self.margins, self.robust


def mean_of(plan: Traded) -> float:
    """Mean e3 over draws, mm; infinite where no draw has a shape."""
    return math.inf if plan.mean is None else plan.mean


def study(seeds: Sequence[int], frames: int = 100, draws: int = DRAWS, jobs: int = 1) -> Iterator[Airway]:
    """The airways of some seeds, as they are done, in so many processes; after Ctrl-C no more are begun."""
    for _, airway in side_by_side(partial(measured, frames=frames, draws=draws), seeds, jobs):
        if airway is not None:
            yield airway


def measured(seed: int, frames: int = 100, draws: int = DRAWS) -> Airway | None:
    """The airway of a seed; None where Ctrl-C ended it."""
    plans = traded(problem_of(seed, frames), AMOUNTS, MARGINS, draws, FIRST_SEED + seed)
    if len(plans) < len(asked(AMOUNTS, MARGINS)):
        return None
    return Airway(seed, frames, tuple(plans[:-1]), plans[-1])


def write_rows(airways: Sequence[Airway], path: Path) -> None:
    """A CSV file with a row for every plan."""
    rows = [
        {"airway": airway.seed, "frames": airway.frames} | asdict(plan) | {"lost_share": plan.share}
        for airway in airways
        for plan in airway.plans
    ]
    write_csv(path, rows)


def read_rows(path: Path, frames: int, draws: int) -> list[Airway]:
    """The airways of such a file, none where there is no file.

    Raises OptionError where the file is another, or its plans have other numbers of frames or draws.
    """
    if not path.exists():
        return []
    found = dict[int, list[Traded]]()
    try:
        with open(path, encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                if (int(row["frames"]), int(row["draws"])) != (frames, draws):
                    what = f"airways of {row['frames']} frames and {row['draws']} draws, not {frames} and {draws}"
                    raise OptionError(f"{path} holds {what}; name another folder with --out")
                found.setdefault(int(row["airway"]), []).append(_plan(row))
        return [Airway(seed, frames, tuple(plans[:-1]), plans[-1]) for seed, plans in found.items()]
    except (KeyError, ValueError, TypeError) as error:
        raise OptionError(
            f"{path} is not a table of this study ({error}); name another folder with --out"
        ) from error


def _plan(row: Mapping[str, Any]) -> Traded:
    planned, mean = (float(row[key]) if row[key] else None for key in ("planned", "mean"))
    amount, margin = float(row["amount"]), float(row["margin"])
    lost, draws = int(row["lost"]), int(row["draws"])
    return Traded(row["problem"], amount, margin, planned, mean, lost, draws, row["solved"] == "True")
