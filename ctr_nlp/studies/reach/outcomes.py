"""Outcomes of the ends of a tree: reached, nearly reached, not reached, or not planned and why."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctr_nlp.anatomy.lumen_tree import WIDTH_MARGIN_MM, LumenTree, TreeEnd
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import MAX_TARGET_LENGTH_RATIO
from ctr_nlp.plan.verdicts import NOT_CHECKED
from ctr_nlp.robot import Robot
from ctr_nlp.studies.grid.case import CASE_DONE
from ctr_nlp.studies.reached.cases import REACHED, outcome_of, read_number

NEARLY, MISSED, NARROW, UNENTERED, UNPLANNED = "nearly", "missed", "too narrow", "not entered", "not planned"
"""Outcomes beside REACHED: missed by little, missed, without room for the robot, on a branch that does not pass
the entry, and without a plan yet."""
OUTCOMES = (REACHED, NEARLY, UNPLANNED, MISSED, NARROW, UNENTERED)
"""All outcomes, the best first: an end that one robot misses may be reached by another that is not planned yet."""
NEARLY_MM = 1.0
"""By how much tip and contact may exceed what is allowed where an end is nearly reached, mm."""
LENGTH_CHECK = "length"
"""Check that a path fails that is longer than the robot reaches."""


@dataclass(frozen=True)
class EndOutcome:
    """How a robot fares at an end of a tree.

    Attributes
    ----------
    end : int
        Number of the end, from 1.
    robot : str
        Name of the robot.
    outcome : str
        Of OUTCOMES.
    failed : str
        First check that is not *yes*: one of :data:`ctr_nlp.plan.verdicts.REACHED_VERDICT_NAMES`, LENGTH_CHECK, or
        empty.
    nominal : bool
        Whether all checks but that on built robots are *yes*.
    x, y, z : float
        The end, mm in the file's coordinates.
    depth : float
        Length of the path from the entry, mm; NaN where the branch does not pass it.
    margin, narrowest : float
        Least difference between the lumen's radius and the robot's, mm, and its depth, mm; NaN where unknown.
    tip, contact : float
        Distance of the tip from the end, and deepest contact with the wall, mm; NaN where unknown.
    contact_x, contact_y, contact_z, contact_along : float
        Where that is, mm in the file's coordinates, and mm along the robot.
    held : float
        Share of the simulated robots that hold; NaN where none were simulated.
    binds : str
        Constraints that are active where the motion ends, where it fails; see
        :func:`ctr_nlp.studies.reach.binding.find_binding`.
    bound : float
        No configuration of the robot, with at most the contact that is allowed, brings the tip nearer to the end
        than this, mm; NaN where no bound was computed.
    reason : str
        Why there is no plan; empty where there is one.
    process_s : float
        Processor time of the plan, s.
    """

    end: int
    robot: str
    outcome: str
    failed: str
    nominal: bool
    x: float
    y: float
    z: float
    depth: float
    margin: float = math.nan
    narrowest: float = math.nan
    tip: float = math.nan
    contact: float = math.nan
    contact_x: float = math.nan
    contact_y: float = math.nan
    contact_z: float = math.nan
    contact_along: float = math.nan
    held: float = math.nan
    binds: str = ""
    bound: float = math.nan
    reason: str = ""
    process_s: float = math.nan

    @property
    def wide_enough(self) -> bool:
        """Whether the end counts among those that a robot may reach."""
        return self.outcome not in (NARROW, UNENTERED)


def outcome_before_planning(tree: LumenTree, end: TreeEnd, name: str, robot: Robot, trim: bool) -> EndOutcome:
    """Tell what is known of an end before it is planned.

    Parameters
    ----------
    tree : LumenTree
        The tree.
    end : TreeEnd
        One of its ends.
    name : str
        Name of the robot.
    robot : Robot
        The robot.
    trim : bool
        Whether its base is moved inwards where the path is longer than it reaches.

    Returns
    -------
    EndOutcome
        UNPLANNED where the end is to be planned, else MISSED, NARROW or UNENTERED.
    """
    x, y, z = end.tip.tolist()
    found = EndOutcome(end.number, name, UNPLANNED, "", False, x, y, z, end.depth)
    if end.start is None:
        return replace(found, outcome=UNENTERED, reason="its branch does not pass the entry")
    narrowest = tree.find_narrowest(end, robot)
    if narrowest is not None:
        found = replace(found, margin=narrowest.margin, narrowest=narrowest.depth)
        if narrowest.margin < WIDTH_MARGIN_MM:
            at = ", ".join(f"{value:.1f}" for value in narrowest.point)
            why = f"radius {narrowest.radius:.2f} mm at a depth of {narrowest.depth:.0f} mm, at ({at})"
            return replace(found, outcome=NARROW, reason=why)
    if end.depth > MAX_TARGET_LENGTH_RATIO * robot.reach and not trim:
        why = f"the path of {end.depth:.0f} mm is longer than the robot reaches, {robot.reach:.0f} mm"
        # The tip cannot be farther from the entry than the robot is long.
        path = end.path.point(np.array([0.0, end.path.length]))
        bound = max(0.0, float(np.linalg.norm(path[1] - path[0])) - robot.reach)
        tube = f"length of tube {robot.d}"
        return replace(found, outcome=MISSED, failed=LENGTH_CHECK, binds=tube, bound=bound, reason=why)
    return found


def outcome_of_plan(before: EndOutcome, row: Mapping[str, Any]) -> EndOutcome:
    """Add what a plan says to what was known of an end.

    Parameters
    ----------
    before : EndOutcome
        Of `outcome_before_planning`.
    row : mapping
        Row of the plan, as `Case.row` makes it.

    Returns
    -------
    EndOutcome
        REACHED where all checks are *yes*; NEARLY where the plan is solved, stable and within the limits, and tip
        and contact are within what is allowed or exceed it by at most NEARLY_MM; else MISSED. A check that was not
        made is not *yes*.
    """
    found = outcome_of(row)
    if row["status"] != CASE_DONE:
        return replace(before, outcome=MISSED, failed=found.failed, reason=str(row["reason"]))
    allowed = Settings()
    near = found.tip <= allowed.arrival_tolerance + NEARLY_MM and not (
        found.contact > allowed.contact_allowed + NEARLY_MM
    )
    reached = found.failed == REACHED
    # A tip at its end by a shortcut, or with a body off its path, is within the tolerance and does not arrive.
    by_path = found.tip > allowed.arrival_tolerance or row["verdict_arrives"] != "no"
    nearly = near and by_path and found.failed in ("arrives", "within_wall", "holds")
    return replace(
        before,
        outcome=REACHED if reached else NEARLY if nearly else MISSED,
        failed="" if reached else found.failed,
        nominal=found.failed in (REACHED, "holds"),
        tip=found.tip,
        contact=found.contact,
        contact_x=read_number(row.get("contact_x")),
        contact_y=read_number(row.get("contact_y")),
        contact_z=read_number(row.get("contact_z")),
        contact_along=read_number(row.get("contact_along")),
        held=math.nan if row.get("verdict_holds") == NOT_CHECKED else found.held,
        binds="" if reached else str(row.get("binds") or ""),
        process_s=read_number(row.get("process_s")),
    )


def with_bound(one: EndOutcome, row: Mapping[str, Any] | None) -> EndOutcome:
    """Return an outcome with the bound in the row of a search, where there is one."""
    if row is None or row["status"] != CASE_DONE:
        return one
    return replace(one, bound=read_number(row.get("bound")))


def best_outcome(outcomes: Sequence[EndOutcome]) -> EndOutcome:
    """Return the best of the outcomes of several robots at one end: by kind, then by tip and contact."""

    def order(one: EndOutcome) -> tuple[int, float]:
        excess = np.nan_to_num(one.tip, nan=math.inf) + np.nan_to_num(one.contact)
        return OUTCOMES.index(one.outcome), float(excess)

    return min(outcomes, key=order)


def count_outcomes(outcomes: Sequence[EndOutcome]) -> dict[str, int]:
    """Count outcomes: ``wide_enough``, ``as_described`` (all checks but that on built robots), and each kind."""
    return {
        "wide_enough": sum(one.wide_enough for one in outcomes),
        "as_described": sum(one.nominal for one in outcomes),
        **{kind: sum(one.outcome == kind for one in outcomes) for kind in OUTCOMES},
    }
