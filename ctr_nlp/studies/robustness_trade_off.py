"""Trade-off of robustness: error as planned, error on sampled robots, and share of failures.

Robust plans for the robot's tolerances times a factor (`amount`) are compared with nominal plans at several
stability margins; all are judged on the same robots, sampled within the whole tolerances.
"""

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
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import sample_robots
from ctr_nlp.robot.tolerances import MAX_TOLERANCES, Tolerances
from ctr_nlp.robust import solve_robust
from ctr_nlp.support.interrupt import deferred_interrupt

TOLERANCE_SCALES = 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5
"""Factors on the tolerances that are planned for; 0 is a plan for the nominal robot."""
COMPARED_STABILITY_MARGINS = 0.1, 0.3, 0.5, 0.7
"""Stability margins of the nominal plans to compare with."""
ROBUSTNESS_STUDY_SAMPLES, ROBUSTNESS_STUDY_SEED = 500, 20260101
"""Number and seed of the robots on which all plans are judged; planning takes other seeds."""


@dataclass(frozen=True)
class RobustnessPoint:
    """A plan judged on sampled robots.

    amount: factor on the tolerances that were planned for. margin: of stability. planned, mean: e3 in mm, as
    planned and as the mean over the samples. lost: number of samples that fail, of draws. solved: whether all
    frames were; figures are given in any case.
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
        """Share of the sampled robots that fail."""
        return self.lost / self.draws


def plan_for_tolerances(
    problem: Problem,
    amounts: Sequence[float] = TOLERANCE_SCALES,
    margins: Sequence[float] = COMPARED_STABILITY_MARGINS,
    samples: int = ROBUSTNESS_STUDY_SAMPLES,
    seed: int = ROBUSTNESS_STUDY_SEED,
    progress: Progress | None = None,
) -> list[RobustnessPoint]:
    """Plan a problem, without its wall, for each factor on the tolerances and each margin, and judge the plans.

    The order is that of requested_plans. amounts: factors on the tolerances. margins: of nominal plans. samples,
    seed: number of robots on which all plans are judged, and the seed with which they are sampled. progress:
    called with (plans done, plans in all, label of the next one). After Ctrl-C the points so far are returned.
    Raises OptionError, RobotError.
    """
    free = replace(problem, lumen=None)
    found = list[RobustnessPoint]()
    wanted = requested_plans(amounts, margins)
    # Results are not used: tolerances that cannot be sampled or scaled are refused now, not after hours of
    # planning.
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
    """Return the plans to make as pairs (factor on the tolerances, stability margin), sorted, without duplicates.

    Nominal plans, of factor 0, come first: at all `margins` and, where 0 is among the amounts, at the default one.
    Others have the default margin. Raises OptionError for margins out of their range.
    """
    every = {(0.0, Settings(stability_margin=margin).stability_margin) for margin in margins}
    every |= {(amount, Settings().stability_margin) for amount in amounts}
    return sorted((amount, margin) for amount, margin in every if margin is not None)


def plan_label(amount: float, margin: float) -> str:
    """Describe a plan: the factor on the tolerances, `amount`, or, where that is 0, the stability margin."""
    return f"{amount:g} × the tolerances" if amount else f"no tolerances, margin {margin:g}"


def choose_plan(points: Sequence[RobustnessPoint], most_lost: float = MOST_LOST) -> RobustnessPoint | None:
    """Choose, of points that are solved and fail on at most a share `most_lost`, the one of least mean e3.

    None where there is no such point.
    """
    able = [(point.mean, point) for point in points if point.solved and point.share <= most_lost]
    known = [(mean, point) for mean, point in able if mean is not None]
    return min(known, key=lambda each: each[0])[1] if known else None


def choice_sentence(points: Sequence[RobustnessPoint], most_lost: float = MOST_LOST) -> str:
    """Say which of the points is chosen, and why; most_lost: largest share of failures that is accepted."""
    best = choose_plan(points, most_lost)
    if best is None:
        return f"No plan is chosen: on each, more than {most_lost:.1%} of the samples fail, or it is not solved."
    return (
        f"Chosen: the plan for {plan_label(best.amount, best.margin)}, with the smallest mean e3 over samples "
        f"({best.mean:.3g} mm) where at most {most_lost:.1%} may fail; {best.lost} of {best.draws} fail on it."
    )


def scale_tolerances(robot: Robot, amount: float) -> Robot:
    """Return a robot with its tolerances times `amount`; raises RobotError where they become too large."""
    own = robot.tolerances
    square = robot.tolerances.covariance
    if square is not None:
        # Bands scale with the factor, a covariance with its square.
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
    """Judge a plan on sampled robots; robot: with the whole tolerances, where the plan's own has scaled ones."""
    tried = replace(plan, meta=plan.meta | {"robot": robot.to_dict()}).robustness(samples, seed)
    mean = None if tried.errors is None else tried.errors.mean
    margin = float(plan.options["stability_margin"])
    return RobustnessPoint(name, amount, margin, e3(plan), mean, tried.lost_count, samples, plan.complete)
