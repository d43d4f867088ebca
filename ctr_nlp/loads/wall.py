"""Contact forces between a plan's robot and the wall of its lumen, and which part of them is avoidable.

Where the lumen is wider than the robot, contact is a matter of planning, and its force avoidable; where it is
narrower, the wall must give.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.loads.tissue import (
    AIRWAY_WALL_STIFFNESS_N_PER_MM2,
    MAX_WALL_STIFFNESS_N_PER_MM2,
    MIN_WALL_STIFFNESS_N_PER_MM2,
)
from ctr_nlp.loads.wall_contact import Foundation, WallContact
from ctr_nlp.models.loads import Load, check_moduli
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.value_checks import check_instance, number
from ctr_nlp.typing import Array, Flags


@dataclass(frozen=True, eq=False)
class WallForces(WallContact):
    """Contact forces of a plan's robot with an elastic wall, in T frames and on K pieces of the robot.

    See :class:`~ctr_nlp.loads.wall_contact.WallContact` for the forces and where they act.

    Attributes
    ----------
    stiffness : float
        Stiffness of the wall, N/mm for every mm of length.
    depth_alone : (T,) array
        Depth of the robot in the wall if the wall did not push, mm.
    tip : (T,) array
        Displacement of the tip by the wall, mm.
    """

    stiffness: float
    depth_alone: Array
    tip: Array

    @property
    def in_equilibrium(self) -> Flags:
        """Mask (T,) of the frames in which the robot has an equilibrium; after a snap none is known."""
        return np.asarray(np.isfinite(self.force).all(axis=1))

    @property
    def total(self) -> Array:
        """Sum of the forces' sizes in every frame, (T,) N."""
        return np.asarray(self.force.sum(axis=1))

    @property
    def avoidable(self) -> Array:
        """Part of the total that acts where the lumen is wider than the robot, (T,) N."""
        return np.asarray(np.where(self.narrow, 0.0, self.force).sum(axis=1))

    @property
    def worst(self) -> int | None:
        """The frame, from 1, with the largest total; None where the robot touches nothing."""
        total = np.nan_to_num(self.total)
        return int(total.argmax()) + 1 if total.max(initial=0.0) > 0 else None

    def summary(self) -> dict[str, Any]:
        """Return the largest numbers by name, with their units in the names.

        Returns
        -------
        dict
            Fit for strict JSON; None where nothing is known.
        """
        worst = self.worst
        known = self.in_equilibrium
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
        """Return a table with one row a frame.

        Returns
        -------
        list of dict
            Forces in N and depths in mm by name; empty after a snap.
        """
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


def wall_forces(plan: Plan, stiffness: float = AIRWAY_WALL_STIFFNESS_N_PER_MM2) -> WallForces:
    """Compute the contact forces between a plan's robot and the wall of its lumen.

    The robot is that of the elastic model. The wall is an elastic (Winkler) foundation without friction: every mm
    of the robot is pushed towards the lumen's path with the stiffness times its depth. This is added to the load
    that the plan is evaluated under.

    Parameters
    ----------
    plan : Plan
        The plan; its robot needs Young's moduli in MPa (:meth:`Plan.with_modulus`).
    stiffness : float
        Stiffness of the wall, N/mm for every mm of the robot; by default that of an airway.

    Returns
    -------
    WallForces
        Forces and depths in every frame, NaN from a snap on.

    Raises
    ------
    LoadError
        A tube has no Young's modulus in MPa.
    OptionError
        `stiffness` is out of its range, the plan knows no lumen, or a frame has no configuration.

    Examples
    --------
    A straight rod in a bent lumen:

    >>> import ctr_nlp as ctr
    >>> rod = ctr.Robot((ctr.Tube(200, 150, 0.0, 1.5, 1.0, youngs_modulus=60_000),))
    >>> bend = ctr.curve_from_points([[0, 0.002 * z**2, z] for z in range(0, 101, 5)], np.full(21, 1.5))
    >>> problem = ctr.Problem("rod", rod, ctr.growing(bend, 2))
    >>> found = ctr.wall_forces(ctr.plan_through(problem, np.array([[0, 30, 0, 0], [0, 60, 0, 0]])))
    >>> found.total.round(2).tolist(), found.worst
    ([0.14, 0.82], 2)
    """
    check_instance(OptionError, "plan", plan, Plan)
    allowed = f"lie in [{MIN_WALL_STIFFNESS_N_PER_MM2:g}, {MAX_WALL_STIFFNESS_N_PER_MM2:g}] N/mm²"
    value = number(
        OptionError,
        "stiffness of the wall",
        stiffness,
        lambda x: MIN_WALL_STIFFNESS_N_PER_MM2 <= x <= MAX_WALL_STIFFNESS_N_PER_MM2,
        allowed,
        " N/mm²",
    )
    check_moduli(plan.robot)
    if plan.wall is None:
        raise OptionError("wall forces need a lumen or another wall, and the plan has none")
    if not np.isfinite(plan.q).all():
        raise OptionError("the plan has frames that were not reached; forces of contact need all of them")
    load = plan.evaluated_load or Load()
    found = Foundation(plan.robot, plan.wall, value, load).follow_motion(plan.q)
    # The same robot and load without the pushes of the wall, for comparison.
    alone = plan.with_load(load)
    assert alone.clearance is not None  # a lumen is known
    return WallForces(
        **vars(found),
        stiffness=value,
        # Clearance is negative beyond the wall.
        depth_alone=np.maximum(-alone.clearance.min(axis=1), 0.0),
        tip=np.linalg.norm(found.shape[:, -1] - alone.shape[:, -1], axis=1),
    )


def _cell(value: float) -> float | str:
    """Round a value for a table; empty where it is not finite."""
    return round(float(value), 5) if math.isfinite(value) else ""
