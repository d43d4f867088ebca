"""Re-planning of the rest of a motion, for the robot as estimated and its remaining uncertainty."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.identify.closed_loop.replanning.reference_trajectory import (
    TRACKED_SHAPE_STRIDE,
    ReferenceTrajectory,
    ReplanningStart,
)
from ctr_nlp.identify.closed_loop.tracker import TRACKER_STABILITY_MARGIN
from ctr_nlp.models.elastic import Elastic
from ctr_nlp.models.elastic.history import ElasticWithHistory
from ctr_nlp.ocp.settings import THRESHOLDS, Settings
from ctr_nlp.paths.curve import Curve, curve_from_points
from ctr_nlp.paths.points import SHORTEST_MM, cumulative_arc_length
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import Target
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.robust.plan import solve_robust
from ctr_nlp.typing import Array

CARRIED_OVER_SETTINGS = "stability_margin", "clearance", "contact_weight", "arrival_weight", *THRESHOLDS
"""Settings of a plan that are kept when its rest is re-planned."""


def problem_of(plan: Plan, first: int = 0) -> Problem:
    """Return the problem that a plan solves, from frame `first` on, counted from 0, with its target and walls."""
    lumen = None if plan.lumen is None else curve_from_points(plan.lumen[:, :3], plan.lumen[:, 3])
    curves, lengths = zip(*map(_curve, plan.target[first:], plan.target_direction[first:]), strict=True)
    return Problem(
        "rest", plan.robot, Target(curves, lengths), plan.dt * len(curves), lumen=lumen, walls=plan.walls
    )


def _curve(points: Array, direction: Array) -> tuple[Curve, float]:
    """Return the curve through a frame's target (101, 3) mm, which ends in a direction (3,), and its length, mm.

    A target too short for a curve is extended straight; the length is that of the target.
    """
    length = float(cumulative_arc_length(points)[-1])
    if length > 2 * SHORTEST_MM:
        curve = curve_from_points(points)
        return curve, curve.length
    return curve_from_points(np.vstack([points, points[-1] + 2 * SHORTEST_MM * direction])), length


def settings_of(plan: Plan) -> Settings:
    """Return the settings of margins and of the wall that a plan was made with."""
    return replace(
        DEFAULT_PLANNER_SETTINGS,
        **{name: plan.options[name] for name in CARRIED_OVER_SETTINGS if name in plan.options},
    )


class Replanner:
    """Re-plans the rest of one plan's motion, robustly for all robots within the remaining uncertainty."""

    def __init__(self, plan: Plan) -> None:
        """Take a plan; raises OptionError where its model does not allow to re-plan a motion that has begun."""
        if type(plan.evaluated_model) is not Elastic:
            load = "" if plan.evaluated_load is None else " under a load"
            raise OptionError(
                f"the plan is evaluated on the model {plan.evaluated_model_name}{load}; re-planning needs the "
                "elastic model without a load"
            )
        self._plan = plan

    def __call__(self, start: ReplanningStart) -> ReferenceTrajectory | None:
        """Return the trajectory from start.first on; None where none is found that is stable for all these robots.

        start: where it starts, and the robot as estimated. None also where a motion that has begun would come no
        nearer to the target. Before it has begun, the search takes as long as for any plan.
        """
        begun = start.first > 0
        problem = replace(problem_of(self._plan, start.first), robot=start.robot)
        initial = np.clip(start.reference.q, start.robot.lower, start.robot.upper)
        # Which equilibrium the robot is in depends on its motion so far, not on the alignment of tubes at a start.
        model = ElasticWithHistory(start.passed_configurations) if begun else self._plan.evaluated_model
        settings = settings_of(self._plan)
        asked: dict[str, Any] = {"settings": settings, "model": model, "initial": [initial]}
        if begun:  # with the margin that a tracker keeps
            least = max(settings.stability_margin or 0.0, TRACKER_STABILITY_MARGIN)
            asked["settings"] = replace(settings, stability_margin=least)
            asked |= {"start": start.passed_configurations[-1], "rounds": 1, "guards": False, "margins": ()}
        try:
            plan = solve_robust(problem, **asked)
        except CtrError:  # no motion keeps all limits from there on
            return None
        if not plan.complete or not plan.meta["certificate"]["held"]:
            return None
        rest = ReferenceTrajectory.from_plan(plan, model, start.zeros)
        target = self._plan.target[start.first :, ::TRACKED_SHAPE_STRIDE]
        own, other = (float(((way.shape - target) ** 2).sum()) for way in (rest, start.reference))
        return None if begun and own >= other else rest
