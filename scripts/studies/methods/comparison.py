"""Many plans side by side: every variant on every problem, from one run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from reference import REFERENCE_METHODS, reference_frames
from reference.published import TABLE_II_BASELINE, TABLE_II_PAPER_METHOD

from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.models import KINEMATIC_MODELS, model_named, suits
from ctr_nlp.ocp.horizon import EndConfigurations, horizon
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.measures import arrival
from ctr_nlp.plan.metrics import summary, verdict_columns
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning import march, solve_horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.motions import per_frame_motions
from ctr_nlp.robust import solve_robust, solve_robust_per_frame
from ctr_nlp.solvers import default_chain_solver, default_solver
from ctr_nlp.studies.variants import PAPER_MODEL, SOLVER_VARIANTS, Variant, parse_solver_variant
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.typing import Array
from methods.rrt_connect import rrt_connect

OBJECTIVE_AGREEMENT_TOLERANCES = 1e-4, 1e-6
"""Two objectives are the same where they differ by this part, or by so many mm^2."""
ACTIVE_LIMIT_TOLERANCE, INACTIVE_LIMIT_DISTANCE = 1e-5, 1e-2
"""A limit is touched within the first and missed by more than the second, rad or mm."""


VARIANTS = (
    *SOLVER_VARIANTS,
    *(name for name, method in REFERENCE_METHODS.items() if method.serves_every_problem),
)
"""Every variant on the dominant model, and the reference methods that serve every problem."""
ROBUST_VARIANTS: Mapping[str, Callable[..., Plan]] = {
    "robust-horizon": solve_robust,
    "robust-joint": solve_robust_per_frame,
}
"""Variants that plan for the robot's tolerances, on the elastic model; they take long: by name only."""
LUMEN_PATH_VARIANTS: Mapping[str, Callable[..., Plan]] = {"rrt-connect": rrt_connect}
"""Methods that lead through a lumen to the last frame, whatever lies between; by name only."""
WARM_STARTED_VARIANTS: Mapping[str, str] = {
    "s2j-horizon": "s2j-projected",
    "s2j-horizon-elastic": "s2j-projected-elastic",
}
"""Our own horizons that start from nothing but the motion of a trained method; by name only, as these are."""
VARIANTS_BY_NAME_ONLY = (
    *ROBUST_VARIANTS,
    *(name for name, method in REFERENCE_METHODS.items() if not method.serves_every_problem),
    *LUMEN_PATH_VARIANTS,
    *WARM_STARTED_VARIANTS,
)
"""Variants that are run by name only."""


def available_variants() -> list[str]:
    """Return the variants that work here: without a C compiler, IPOPT's and the reference methods; also on the
    elastic model.
    """
    compiled = {"banded", "sqp"} if cache.unavailable_reason() else set()
    elastic = f"horizon:{default_chain_solver()}:elastic", f"joint:{default_solver()}:elastic"
    return [*elastic, *(name for name in VARIANTS if name.split(":")[-1] not in compiled)]


def parse_variant(name: str) -> Variant:
    """Return the variant of a name; raises OptionError with the valid ones.

    Reference methods go forward, as published; frame formulations in the better direction.
    """

    def reference(problem: Problem, settings: Settings, _: Sequence[Array], progress: Progress | None) -> Plan:
        return march(problem, reference_frames(problem, name, settings), "forward", progress=progress)

    def robust(problem: Problem, settings: Settings, _: Sequence[Array], progress: Progress | None) -> Plan:
        return _check_on_samples(ROBUST_VARIANTS[name](problem, settings=settings, progress=progress))

    def path(problem: Problem, settings: Settings, _: Sequence[Array], __: Progress | None) -> Plan:
        return LUMEN_PATH_VARIANTS[name](problem, settings)

    def warm(problem: Problem, settings: Settings, _: Sequence[Array], progress: Progress | None) -> Plan:
        begun = march(problem, reference_frames(problem, WARM_STARTED_VARIANTS[name], settings), "forward")
        asked: dict[str, Any] = {
            "model": REFERENCE_METHODS[WARM_STARTED_VARIANTS[name]].model,
            "settings": settings,
        }
        return solve_horizon(problem, **asked, initial=[begun.q], progress=progress)

    if name in REFERENCE_METHODS:
        return Variant(name, name, REFERENCE_METHODS[name].model, reference)
    if name in WARM_STARTED_VARIANTS:
        return Variant(name, name, REFERENCE_METHODS[WARM_STARTED_VARIANTS[name]].model, warm)
    if name in ROBUST_VARIANTS:
        return Variant(name, name, "elastic", robust)
    if name in LUMEN_PATH_VARIANTS:
        return Variant(name, name, "elastic", path)
    return parse_solver_variant(
        name, [name for name in VARIANTS if name not in SOLVER_VARIANTS] + [*VARIANTS_BY_NAME_ONLY]
    )


class Refusal(NamedTuple):
    """A variant that does not serve a problem, and why, in one line."""

    problem: str
    variant: str
    why: str


class Comparison(NamedTuple):
    """Results of variants on problems. rows: one a problem and variant that serves it. refusals: one a problem and
    variant that does not.

    agreements: one a problem on which several solvers solved the horizon.
    """

    rows: list[dict[str, Any]]
    refusals: list[Refusal]
    agreements: list[dict[str, Any]]


def compare(
    problems: Iterable[Problem],
    variants: Sequence[Variant],
    settings: Settings | None = None,
    progress: Callable[[str, str], Progress] | None = None,
    measure: Callable[[str, str, Plan], dict[str, Any]] | None = None,
) -> Comparison:
    """Solve every problem by every variant, one at a time. All horizons of a problem start from the same motions.

    progress: (problem, variant) -> what is told how many frames are done. measure: (problem, variant, plan) -> a
    row, `row` by default. Ctrl-C leaves the rows that were begun. A variant that does not serve a problem is a
    refusal; the first one is raised where none serves any.
    """
    chosen = settings or Settings(contact_weight=0.0, arrival_weight=0.0)
    measure = measure or comparison_row
    found = Comparison([], [], [])
    with deferred_interrupt() as interrupted:
        for problem in problems:
            initial: Sequence[Array] = ()
            horizons: list[Plan] = []
            for variant in variants:
                report = None if progress is None else progress(problem.name, variant.name)
                ours = variant.formulation == "horizon" and variant.model == PAPER_MODEL
                try:
                    model_named(variant.model, f"model of variant {variant.name}").check(problem.robot)
                    if ours and not initial:
                        initial = per_frame_motions(
                            problem, EndConfigurations(), chosen, report, KINEMATIC_MODELS[PAPER_MODEL]
                        )
                    plan = variant.plan(problem, chosen, initial, report)
                except CtrError as error:
                    found.refusals.append(Refusal(problem.name, variant.name, str(error)))
                else:
                    found.rows.append(measure(problem.name, variant.name, plan))
                    horizons += [plan] * ours
                if found.rows and interrupted():
                    return found
            found.agreements.extend(agreement(problem, horizons[0], other) for other in horizons[1:])
    if not found.rows:
        raise OptionError(found.refusals[0].why)
    return found


def agreement(problem: Problem, first: Plan, second: Plan) -> dict[str, Any]:
    """Tell whether two horizons of a problem are one solution: objectives within OBJECTIVE_AGREEMENT_TOLERANCES,
    the same active limits.
    """
    robot = problem.robot
    weight = first.meta["options"]["motion_weight"]
    chain = horizon(
        robot, problem.target_frames, problem.dt, weight, EndConfigurations(), KINEMATIC_MODELS[PAPER_MODEL]
    )
    objectives = [float(plan.objective.mean()) for plan in (first, second)]
    difference = abs(objectives[0] - objectives[1])
    values = [chain.evaluate(plan.q.ravel())[1] for plan in (first, second)]
    low, high = chain.bounds
    one, other = (np.minimum(value - low, high - value) for value in values)  # from the nearer bound, rad or mm
    differing = int(
        (
            ((one < ACTIVE_LIMIT_TOLERANCE) & (other > INACTIVE_LIMIT_DISTANCE))
            | ((other < ACTIVE_LIMIT_TOLERANCE) & (one > INACTIVE_LIMIT_DISTANCE))
        ).sum()
    )
    same = (
        difference <= max(OBJECTIVE_AGREEMENT_TOLERANCES[0] * min(objectives), OBJECTIVE_AGREEMENT_TOLERANCES[1])
        and differing == 0
    )
    return {
        "problem": problem.name,
        "first": first.meta["solver"],
        "second": second.meta["solver"],
        "first_objective": objectives[0],
        "second_objective": objectives[1],
        "difference": difference,
        "differing_limits": differing,
        "agree": same,
        "first_s": first.meta["solve_s"],
        "second_s": second.meta["solve_s"],
    }


def comparison_row(problem: str, variant: str, plan: Plan) -> dict[str, Any]:
    """Return the figures of a plan: errors in mm, steps in rad and mm, times in ms and s.

    seed_*: Table II's figures for the same method. e3 and others are of the model planned on; dominant_*,
    elastic_* of the same motion on both, None where the robot's tubes are balanced and the dominant model does not
    describe it; *_no the verdicts there that are no. verdict_*: words of the verdicts on the elastic model and
    over samples of the robot's tolerances, whatever model the plan was made on; no: those that are no; tip_last:
    mm by which the tip misses the target's end there. draws_e3, draws_lost: mean of e3 over these samples, and the
    share of them that is lost.
    """
    checked = _check_on_samples(plan)
    end = arrival(checked)
    found = summary(plan)
    drawn = checked.drawn
    errors = None if drawn is None else drawn.errors
    models = [model for model in KINEMATIC_MODELS if suits(plan.robot, model)]
    plans = {model: plan if model == plan.meta["model"] else plan.evaluate_on(model) for model in models}
    on = {model: summary(each) for model, each in plans.items()}
    e3, e4, t_c = (TABLE_II_BASELINE if variant == "euclidean" else TABLE_II_PAPER_METHOD).get(
        problem, (None, None, None)
    )
    return {
        "problem": problem,
        "variant": variant,
        **{key: found[key] for key in ("e3", "e4", "e_max", "tip_max")},
        **{f"step_{name}": step for name, step in found["max_step"].items()},
        **{key: found[key] for key in ("roughness", "objective")},
        "median_ms": found["solve_ms"]["median"],
        "p99_ms": found["solve_ms"]["p99"],
        "total_s": found["solve_ms"]["total"] / 1e3,
        "build_s": found["build_s"],
        "search_s": found["search_s"],
        "iterations": plan.meta["iterations"],
        "failed": found["failed"],
        "interrupted": found["interrupted"],
        "draws": None if drawn is None else len(drawn),
        "draws_e3": None if errors is None else errors.mean,
        "draws_lost": None if drawn is None else drawn.lost_share,
        "seed_e3": e3,
        "seed_e4": e4,
        "seed_t_s": t_c,
        **{
            f"{model}_{key}": on[model][key] if model in on else None
            for model in KINEMATIC_MODELS
            for key in ("e3", "e4")
        },
        "stability_between": on["elastic"]["stability_between_min"],
        "snaps": len(on["elastic"]["snaps"]),
        "tip_last": None if end is None else end.distance,
        "no": ", ".join(checked.verdicts.failed_names),
        **verdict_columns(checked),
        **{
            f"{model}_no": ", ".join(plans[model].verdicts.failed_names) if model in plans else None
            for model in KINEMATIC_MODELS
        },
    }


def _check_on_samples(plan: Plan) -> Plan:
    """Return a plan as it is judged: on the elastic model, with simulated robots."""
    return plan if plan.drawn is not None and plan.can_snap else plan.check()
