"""Comparison of planning methods: every variant on every problem, in one run."""

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
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.motions import per_frame_motions
from ctr_nlp.planning.per_frame import march
from ctr_nlp.robust import solve_robust, solve_robust_per_frame
from ctr_nlp.solvers import default_chain_solver, default_solver
from ctr_nlp.studies.variants import PAPER_MODEL, SOLVER_VARIANTS, Variant, parse_solver_variant
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.typing import Array
from methods.rrt_connect import rrt_connect

OBJECTIVE_AGREEMENT_TOLERANCES = 1e-4, 1e-6
"""Relative and absolute (mm^2) difference up to which two objectives count as equal."""
ACTIVE_LIMIT_TOLERANCE, INACTIVE_LIMIT_DISTANCE = 1e-5, 1e-2
"""A limit is active within the first distance and inactive beyond the second, rad or mm."""


VARIANTS = (
    *SOLVER_VARIANTS,
    *(name for name, method in REFERENCE_METHODS.items() if method.serves_every_problem),
)
"""Every variant on the dominant model, and the reference methods that apply to every problem."""
ROBUST_VARIANTS: Mapping[str, Callable[..., Plan]] = {
    "robust-horizon": solve_robust,
    "robust-joint": solve_robust_per_frame,
}
"""Variants that plan for the robot's tolerances, on the elastic model; by name only, since they take long."""
LUMEN_PATH_VARIANTS: Mapping[str, Callable[..., Plan]] = {"rrt-connect": rrt_connect}
"""Methods that find a path through a lumen to the pose of the last frame and ignore the others; by name only."""
WARM_STARTED_VARIANTS: Mapping[str, str] = {
    "s2j-horizon": "s2j-projected",
    "s2j-horizon-elastic": "s2j-projected-elastic",
}
"""Our horizons with the motion of a trained method as their only initial guess; by name only, as these are."""
VARIANTS_BY_NAME_ONLY = (
    *ROBUST_VARIANTS,
    *(name for name, method in REFERENCE_METHODS.items() if not method.serves_every_problem),
    *LUMEN_PATH_VARIANTS,
    *WARM_STARTED_VARIANTS,
)
"""Variants that are run by name only."""


def available_variants() -> list[str]:
    """Return the names of the variants that work on this machine, including two on the elastic model.

    Without a C compiler these are IPOPT's and the reference methods.
    """
    compiled = {"banded", "sqp"} if cache.unavailable_reason() else set()
    elastic = f"horizon:{default_chain_solver()}:elastic", f"joint:{default_solver()}:elastic"
    return [*elastic, *(name for name in VARIANTS if name.split(":")[-1] not in compiled)]


def parse_variant(name: str) -> Variant:
    """Return the variant called `name`; raises OptionError, which lists the valid names.

    Reference methods solve frames forward, as published; frame formulations in the better direction.
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
    """A variant that does not apply to a problem, and why, in one line."""

    problem: str
    variant: str
    why: str


class Comparison(NamedTuple):
    """Results of variants on problems.

    rows: one for each problem and variant that applies to it. refusals: one for each that does not. agreements:
    one for each problem and further solver where several solved the horizon.
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
    """Solve every problem by every variant, one at a time; all horizons of a problem start from the same motions.

    problems, variants: what is solved, and how. settings: of all variants; by default without walls and arrival,
    which the paper's methods do not know. progress: (problem, variant) -> callback for the frames of that plan.
    measure: (problem, variant, plan) -> a row; `comparison_row` by default. After Ctrl-C the rows so far are
    returned. A variant that does not apply to a problem is a refusal; OptionError is raised where none applies to
    any.
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
                    # Once for all horizon solvers: with equal starts, they should find the same solution.
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
    """Compare two horizon plans of a problem, and return a row that says whether they are the same solution.

    first, second: plans by different solvers. They agree where objectives are within
    OBJECTIVE_AGREEMENT_TOLERANCES and the same limits are active.
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
    # Limits between the two distances count for neither: solvers stop at different distances from active limits.
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
    """Return the figures of a plan as a row: errors in mm, steps in rad and mm, times in ms and s.

    problem, variant: names, for the row. seed_*: the paper's Table II for the same method. e3 and others are of
    the model planned on; dominant_*, elastic_* of the same motion on both, None where the robot's tubes are
    balanced and the dominant model does not describe it; *_no the verdicts there that are no. verdict_*: words of
    the verdicts on the elastic model and over samples of the robot's tolerances, whatever model the plan was made
    on; no: those that are no; tip_last: distance of the tip from the target's end there, mm. draws, draws_e3,
    draws_lost: number of these samples, mean of e3 over them, and the share of them that fails.
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
    """Return a plan evaluated on the elastic model, with sampled robots; as it is, where it has been already."""
    return plan if plan.drawn is not None and plan.can_snap else plan.check()
