"""Forces of contact: with what a plan's robot is pressed into the wall of its lumen, and which it could avoid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.loads import Load, check_moduli
from ctr_nlp.plan.plan import Plan
from ctr_nlp.simulation.touching import Foundation, Touching
from ctr_nlp.support.values import instance, number
from ctr_nlp.target.lumen import Lumen
from ctr_nlp.typing import Array, Flags

STIFFNESS = 0.032
"""N/mm for every mm of length, of an airway's wall under a long tube: pi/4 E / (1 - 0.5^2) (Popov, Contact
Mechanics and Friction, 2010: a cylinder's side) with E = 30.5 kPa (Eskandari, Arvayo, Levenston, Mechanical
properties of the airway tree, J. Appl. Physiol. 125, 2018: of pigs, along the airway, where it is stiffest)."""
LEAST, MOST = 1e-6, 1e3
"""Of stiffnesses that are taken, from gels to bone."""


@dataclass(frozen=True, eq=False)
class WallForces(Touching):
    """A plan of T frames whose robot is pressed into a wall of a stiffness, N/mm for every mm, along K pieces.

    depth_alone (T,): how deep the robot would be in a wall that does not push, mm. tip (T,): by how much the wall
    moves the tip, mm. Where the lumen is narrow, the robot cannot avoid the wall.
    """

    stiffness: float
    depth_alone: Array
    tip: Array

    @property
    def known(self) -> Flags:
        """In which frames (T,) the robot is known to stand."""
        return np.asarray(np.isfinite(self.force).all(axis=1))

    @property
    def total(self) -> Array:
        """The sum of the forces' sizes in every frame, (T,) N."""
        return np.asarray(self.force.sum(axis=1))

    @property
    def avoidable(self) -> Array:
        """Of that, (T,) N, what acts where the lumen is wider than the robot: a shape need not touch there."""
        return np.asarray(np.where(self.narrow, 0.0, self.force).sum(axis=1))

    @property
    def worst(self) -> int | None:
        """The frame, from 1, with the largest total; None where nothing is touched."""
        total = np.nan_to_num(self.total)
        return int(total.argmax()) + 1 if total.max(initial=0.0) > 0 else None

    def summary(self) -> dict[str, Any]:
        """Numbers for strict JSON."""
        worst, known = self.worst, self.known
        at = 0 if worst is None else worst - 1
        return {
            "stiffness_N_per_mm2": self.stiffness,
            "worst_frame": worst,
            "largest_total_N": None if not known.any() else float(np.nanmax(self.total)),
            "of_it_avoidable_N": None if not known.any() else float(self.avoidable[at]),
            "largest_on_a_piece_N": None if not known.any() else float(np.nanmax(self.force)),
            "deepest_mm": None if not known.any() else float(np.nanmax(self.depth)),
            "deepest_without_pushing_mm": float(np.nanmax(self.depth_alone)),
            "tip_moved_mm": None if not known.any() else float(np.nanmax(self.tip)),
            "snaps_in_frame": None if known.all() else int(known.argmin()) + 1,
        }

    def rows(self) -> list[dict[str, Any]]:
        """A row a frame; empty cells where the robot has snapped."""
        numbers = {
            "total_N": self.total,
            "avoidable_N": self.avoidable,
            "largest_on_a_piece_N": self.force.max(axis=1),
            "depth_mm": self.depth.max(axis=1),
            "depth_without_pushing_mm": self.depth_alone,
            "tip_moved_mm": self.tip,
        }
        return [
            {"frame": j + 1} | {name: _cell(values[j]) for name, values in numbers.items()}
            for j in range(len(self.force))
        ]


def wall_forces(plan: Plan, stiffness: float = STIFFNESS) -> WallForces:
    """With what a plan's robot is pressed into the wall of its lumen, on the elastic model.

    stiffness: of the wall, N/mm for every mm of the robot. The wall acts beside the load that the plan is
    evaluated under. Raises LoadError where the robot has no moduli in MPa, and OptionError where no lumen is known
    or a frame has no configuration.
    """
    instance(OptionError, "plan", plan, Plan)
    allowed = f"lie in [{LEAST:g}, {MOST:g}] N/mm²"
    value = number(
        OptionError, "stiffness of the wall", stiffness, lambda x: LEAST <= x <= MOST, allowed, " N/mm²"
    )
    check_moduli(plan.robot)
    if plan.lumen is None:
        raise OptionError("the plan knows no wall of a lumen, so that nothing can touch it")
    if not np.isfinite(plan.q).all():
        raise OptionError("the plan has frames that were not reached; forces of contact need all of them")
    load, lumen = plan.bears or Load(), Lumen(plan.lumen)
    found = Foundation(plan.robot, lumen, value, load).along(plan.q)
    alone = plan.under(load)
    assert alone.clearance is not None  # a lumen is known
    return WallForces(
        **vars(found),
        stiffness=value,
        depth_alone=np.maximum(-alone.clearance.min(axis=1), 0.0),
        tip=np.linalg.norm(found.shape[:, -1] - alone.shape[:, -1], axis=1),
    )


def _cell(value: float) -> float | str:
    return round(float(value), 5) if math.isfinite(value) else ""
