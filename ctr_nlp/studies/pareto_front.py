"""Error against roughness: the Pareto front of horizons, and other methods' points beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ctr_nlp.models import suits
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning import Horizon
from ctr_nlp.planning.horizon.loaded_horizon import LoadedHorizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.studies.variants import parse_solver_variant
from ctr_nlp.support.interrupt import deferred_interrupt

DEFAULT_SWEEP_WEIGHTS_S2 = tuple(10.0 ** (k / 2 - 8) for k in range(13))
"""Default lambdas of a sweep, s^2."""
COMPARED_VARIANTS = ("joint:ipopt", "two-stage:ipopt", "paper-two-stage", "euclidean")
"""The variants whose points stand beside the front."""


@dataclass(frozen=True)
class ParetoPoint:
    """A plan in the plane of error and roughness. motion_weight: s^2; e3: mm; roughness: mm^2/s.

    solved: every frame was.
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
    """The front over weights, of which each horizon starts from its neighbours', and the points beside it.

    plan: any motion of the horizon, to start from. Methods whose model does not describe the robot are left out.
    They plan on the dominant model; errors of all points are those of the model, and under the load, of plan.
    Ctrl-C, held back by the caller, leaves what was found. Raises OptionError.
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
    """Plan for every weight, in ascending order: the better of one plan started from below and one from above."""
    ascending = sorted(set(weights))
    best: dict[float, Plan] = {}
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
    """The motion `found` with the shapes that the robot has on the model, and under the load, of `plan`."""
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
