"""Airways of a study: plans without and with clearance, and the least contact that there could be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.formulations.settings import Settings
from ctr_nlp.plan.measures import depth
from ctr_nlp.plan.plan import Plan
from ctr_nlp.steer import solve_horizon
from ctr_nlp.studies.airways import SYNTHETIC, shown_name
from ctr_nlp.studies.clearance.alone import Alone
from ctr_nlp.target.problem import Problem

WITH, FIRST = Settings(), Settings(clearance_cost=math.inf)
"""The default; clearance whatever it costs."""


def contact(plan: Plan, problem: Problem) -> dict[str, float]:
    """Depth beyond the wall summed over frames, mm; frames in contact; the target's length, mm.

    short: by how much the robot is shorter than its target at most, mm.
    """
    deep, out = depth(plan), np.minimum(problem.target.lengths, problem.robot.reach)
    return {
        "contact_sum": float(deep.sum()),
        "contact_frames": float((deep > 0).sum()),
        "length": max(problem.target.lengths),
        "short": max(0.0, float((out - plan.beta[:, -1]).max())),
    }


def contact_alone(plan: Plan, problem: Problem) -> dict[str, float]:
    """What is left of a plan's contact where contact is all that counts, mm, and in how many frames that is none.

    It is looked for from the plan itself, too, and from one that puts clearance first. Raises as Alone.
    """
    touching = np.flatnonzero(depth(plan) > 0)
    left = np.zeros(0)
    if len(touching):
        first = solve_horizon(problem, model="dominant", settings=FIRST)
        left = Alone(problem).least([first.q, plan.q], touching)
    return {"contact_alone": float(left.sum()), "contact_alone_clear": float((left == 0).sum())}


@dataclass(frozen=True)
class Airway:
    """Plans of an airway without clearance, with it, and with clearance first; and clearance alone.

    length: of the target, mm. solved: every frame of all three plans was. weight: what a mm of contact costs with
    clearance, mm^2. e3_*: mm. contact_*: depth beyond the wall summed over frames, mm. frames_*: in contact.
    short_*: by how much the robot is shorter than its target at most, mm. alone: what is left of contact_with
    where contact is all that counts and the robot is out to the target's full length, mm; alone_clear: in how
    many of frames_with that is none.
    """

    name: str
    synthetic: bool
    frames: int
    length: float
    solved: bool
    weight: float
    e3_without: float
    e3_with: float
    e3_first: float
    contact_without: float
    contact_with: float
    contact_first: float
    frames_without: int
    frames_with: int
    frames_first: int
    short_without: float
    short_with: float
    short_first: float
    alone: float
    alone_clear: int

    @property
    def growth(self) -> float:
        """Of e3 with clearance, in %."""
        return 100 * (self.e3_with / self.e3_without - 1)

    @property
    def growth_first(self) -> float:
        """Of e3 with clearance first, in %."""
        return 100 * (self.e3_first / self.e3_without - 1)

    @property
    def clearable(self) -> bool:
        """Whether clearance alone leaves no contact in any frame."""
        return self.alone_clear == self.frames_with


def airways(rows: Sequence[Mapping[str, Any]]) -> list[Airway]:
    """The airways of a study's rows, of which each has all three plans; others are left out."""
    found = dict[str, dict[str, Mapping[str, Any]]]()
    for row in rows:
        found.setdefault(row["problem"], {})[_kind(row)] = row
    return [_airway(name, plans) for name, plans in found.items() if len(plans) == len(KINDS)]


KINDS = "without", "with", "first"
"""Of plans, by their settings: no weight of contact, the defaults, and any cost of clearance."""


def _kind(row: Mapping[str, Any]) -> str:
    if row.get("set_contact_weight") == 0:
        return "without"
    return "first" if row.get("set_clearance_cost") == math.inf else "with"


def _airway(name: str, plans: Mapping[str, Mapping[str, Any]]) -> Airway:
    numbers: dict[str, Any] = {}
    for kind in KINDS:
        row = plans[kind]
        numbers |= {f"e3_{kind}": row["e3"], f"contact_{kind}": row["contact_sum"], f"short_{kind}": row["short"]}
        numbers[f"frames_{kind}"] = int(row["contact_frames"])
    kept = plans["with"]
    return Airway(
        name=shown_name(name),
        synthetic=name.startswith(SYNTHETIC),
        frames=int(kept["frames"]),
        length=kept["length"],
        solved=all(bool(row["complete"]) for row in plans.values()),
        weight=kept["weights_contact_mm"],
        alone=kept["contact_alone"],
        alone_clear=int(kept["contact_alone_clear"]),
        **numbers,
    )
