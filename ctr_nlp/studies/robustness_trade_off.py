"""Errors as planned, errors on simulated robots and lost ones, against how much robustness is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.planning import solve_horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import sample_robots
from ctr_nlp.robot.tolerances import MAX_TOLERANCES, Tolerances
from ctr_nlp.robust import solve_robust
from ctr_nlp.support.interrupt import deferred_interrupt

TOLERANCE_SCALES = 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5
"""Factors by which the tolerances are scaled that are planned for; 0 is a plan for the robot described alone."""
COMPARED_STABILITY_MARGINS = 0.1, 0.3, 0.5, 0.7
"""Stability margins of the plans for the robot described that stand beside."""
ROBUSTNESS_STUDY_SAMPLES, ROBUSTNESS_STUDY_SEED = 500, 20260101
"""Number and seed of the robots on which all plans are judged; planning takes other seeds."""


@dataclass(frozen=True)
class RobustnessPoint:
    """A plan judged on draws. amount: what the tolerances planned for are scaled by; margin: of stability.

    planned, mean: e3 in mm, as planned and on average over the draws; lost: of so many draws. solved: every frame
    was. Figures are those of what was found, also where that is not a solution.
    """

    problem: str
    amount: float
    margin: float
    planned: float | None
    mean: float | None
    lost: int
    draws: int
    solved: bool

    @property
    def share(self) -> float:
        """Share of the simulated robots that are lost."""
        return self.lost / self.draws


def plan_for_tolerances(
    problem: Problem,
    amounts: Sequence[float] = TOLERANCE_SCALES,
    margins: Sequence[float] = COMPARED_STABILITY_MARGINS,
    samples: int = ROBUSTNESS_STUDY_SAMPLES,
    seed: int = ROBUSTNESS_STUDY_SEED,
    progress: Progress | None = None,
) -> list[RobustnessPoint]:
    """Plan a problem, without its wall, for each amount of tolerances and at each margin, in the order of `asked`.

    All are judged on the same robots, sampled within the whole tolerances. progress: (number done, of how many,
    what is planned next). Ctrl-C leaves what was found. Raises OptionError, RobotError.
    """
    free = replace(problem, lumen=None)
    found = list[RobustnessPoint]()
    wanted = requested_plans(amounts, margins)
    sample_robots(problem.robot, samples, seed)
    for amount, _ in wanted:
        scale_tolerances(problem.robot, amount)
    with deferred_interrupt() as interrupted:
        for amount, margin in wanted:
            if interrupted():
                break
            if progress is not None:
                progress(len(found), len(wanted), plan_label(amount, margin))
            plan = _plan_scaled(free, amount, margin)
            if plan.meta["interrupted"]:
                break
            found.append(_judge_plan(plan, problem.robot, problem.name, amount, samples, seed))
    return found


def requested_plans(amounts: Sequence[float], margins: Sequence[float]) -> list[tuple[float, float]]:
    """Return the parts of the tolerances to plan for, in order, each with a stability margin; none of them twice.

    Plans for none of them come first, at all margins and, where 0 is among the amounts, at the usual one; others
    have the usual one. Raises OptionError for margins that there are not.
    """
    every = {(0.0, Settings(stability_margin=margin).stability_margin) for margin in margins}
    every |= {(amount, Settings().stability_margin) for amount in amounts}
    return sorted((amount, margin) for amount, margin in every if margin is not None)


def plan_label(amount: float, margin: float) -> str:
    """Say for what part of the tolerances, or at what margin without any, a plan is made."""
    return f"{amount:g} × the tolerances" if amount else f"no tolerances, margin {margin:g}"


def choose_plan(points: Sequence[RobustnessPoint], most_lost: float = MOST_LOST) -> RobustnessPoint | None:
    """Return the solved plan with the least mean e3 that loses at most the share `most_lost`; None where each
    loses more.
    """
    able = [(point.mean, point) for point in points if point.solved and point.share <= most_lost]
    known = [(mean, point) for mean, point in able if mean is not None]
    return min(known, key=lambda each: each[0])[1] if known else None


def choice_sentence(points: Sequence[RobustnessPoint], most_lost: float = MOST_LOST) -> str:
    """Say which plan is chosen, and why."""
    best = choose_plan(points, most_lost)
    if best is None:
        return f"None is chosen: each plan loses more than {most_lost:.3g} of its draws or is not solved."
    return (
        f"Chosen: the plan for {plan_label(best.amount, best.margin)}, with the least mean e3 over draws "
        f"({best.mean:.3g} mm) of those that lose at most {most_lost:.1%}; it loses {best.lost} of {best.draws}."
    )


def scale_tolerances(robot: Robot, amount: float) -> Robot:
    """Return a robot with its tolerances times `amount`; raises RobotError where they become too large."""
    own = robot.tolerances
    square = robot.tolerances.covariance
    if square is not None:
        covariance = amount**2 * np.array(square)
        parts: dict[str, Any] = {"rotation_lag": amount * np.array(own.rotation_lag), "covariance": covariance}
        return replace(robot, tolerances=replace(own, **parts))
    parts = {name: amount * np.array(getattr(own, name)) for name in MAX_TOLERANCES}
    return replace(robot, tolerances=Tolerances(**parts, distribution=own.distribution))


def _plan_scaled(problem: Problem, amount: float, margin: float) -> Plan:
    settings = Settings(stability_margin=margin)
    if amount:
        return solve_robust(replace(problem, robot=scale_tolerances(problem.robot, amount)), settings=settings)
    return solve_horizon(problem, model="elastic", settings=settings)


def _judge_plan(plan: Plan, robot: Robot, name: str, amount: float, samples: int, seed: int) -> RobustnessPoint:
    """Judge a plan on simulated robots around `robot`, which differs from its own in tolerances alone."""
    tried = replace(plan, meta=plan.meta | {"robot": robot.to_dict()}).robustness(samples, seed)
    mean = None if tried.errors is None else tried.errors.mean
    margin = float(plan.options["stability_margin"])
    return RobustnessPoint(name, amount, margin, e3(plan), mean, tried.lost_count, samples, plan.complete)
