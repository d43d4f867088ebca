"""Error against roughness: the Pareto front of horizon plans over lambda, and points of other methods.

Error is e3 in mm, roughness sum_j |W (q_{j+1} - q_j)|^2 / dt in mm^2/s, and lambda the weight of the motion term
of eq. (9) in s^2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ctr_nlp.models import suits
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.horizon import Horizon
from ctr_nlp.planning.horizon.loaded_horizon import LoadedHorizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.studies.variants import parse_solver_variant
from ctr_nlp.support.interrupt import deferred_interrupt

COMPARED_VARIANTS = ("joint:ipopt", "two-stage:ipopt")
"""Variants whose points are compared with the front."""


@dataclass(frozen=True)
class ParetoPoint:
    """A plan in the plane of error and roughness.

    motion_weight: lambda, s^2; e3: mm; roughness: mm^2/s. solved: whether all frames were.
    """

    method: str
    motion_weight: float
    e3: float
    roughness: float
    solved: bool


def compute_pareto_front(
    horizon: Horizon | LoadedHorizon,
    plan: Plan,
    weights: Sequence[float],
    settings: Settings,
    labelled: Callable[[str], Progress],
) -> list[ParetoPoint]:
    """Compute the front over `weights` (lambda, s^2), and the points of COMPARED_VARIANTS.

    horizon: the program of the problem. plan: any plan of it, the first initial guess. settings: of the compared
    variants, which plan on the dominant model; those whose model does not describe the robot are left out.
    labelled: label -> progress callback. All errors are on the model, and with the load, of `plan`. After Ctrl-C,
    which the caller defers, the points so far are returned. Raises OptionError.
    """
    with deferred_interrupt() as interrupted:
        plans = sweep_motion_weights(horizon, plan, weights, labelled)
        points = [_point("horizon", found) for found in plans]
        for name in COMPARED_VARIANTS:
            if interrupted():
                break
            variant = parse_solver_variant(name)
            label = f"{horizon.problem.name}, {name}"
            if suits(horizon.problem.robot, variant.model):
                found = variant.plan(horizon.problem, settings, (), labelled(label))
                points.append(_point(name, _evaluate_as(plan, found)))
    return points


def sweep_motion_weights(
    horizon: Horizon | LoadedHorizon, plan: Plan, weights: Sequence[float], labelled: Callable[[str], Progress]
) -> list[Plan]:
    """Plan for every weight and return the plans in ascending order of weight.

    horizon: the program of the problem. plan: the first initial guess. weights: lambda, s^2. labelled: label ->
    progress callback.
    """
    ascending = sorted(set(weights))
    best: dict[float, Plan] = {}
    # Each plan is warm-started from its neighbour's. A sweep stays in a local minimum that was good for earlier
    # weights: so once upwards, once downwards, and the better of both counts.
    with deferred_interrupt() as interrupted:
        for order in (ascending, ascending[::-1]):
            motion = plan.q
            for weight in order:
                found = horizon.solve(
                    [motion], weight, progress=labelled(f"{horizon.problem.name}, λ = {weight:.1e} s²")
                )
                if interrupted():
                    return [best[weight] for weight in ascending if weight in best]
                motion = found.q
                if weight not in best or _ranking_key(found) < _ranking_key(best[weight]):
                    best[weight] = found
    return [best[weight] for weight in ascending]


def _evaluate_as(plan: Plan, found: Plan) -> Plan:
    """Return the plan `found` evaluated on the model, and with the load, of `plan`."""
    if plan.evaluated_load is not None:
        return found.with_load(plan.evaluated_load)
    return (
        found
        if found.evaluated_model_name == plan.evaluated_model_name
        else found.evaluate_on(plan.evaluated_model_name)
    )


def _ranking_key(plan: Plan) -> tuple[bool, float]:
    return not plan.complete, float(plan.objective.mean())


def _point(method: str, plan: Plan) -> ParetoPoint:
    found: dict[str, Any] = summary(plan)
    return ParetoPoint(method, found["weights"]["motion_s2"], found["e3"], found["roughness"], plan.complete)
