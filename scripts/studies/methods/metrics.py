"""Figures of every method's plan, measured alike: on the elastic model, and over samples of its robot."""

from __future__ import annotations

from typing import Any

import numpy as np
from reference import REFERENCE_METHODS

from ctr_nlp.plan.measures import contact_depths, follow_the_leader_deviation
from ctr_nlp.plan.metrics import summary, verdict_columns
from ctr_nlp.plan.monte_carlo import DEFAULT_PLAN_SAMPLES
from ctr_nlp.plan.plan import Plan
from ctr_nlp.solvers import default_chain_solver, default_solver
from ctr_nlp.typing import Array
from methods.comparison import LUMEN_PATH_VARIANTS, ROBUST_VARIANTS, WARM_STARTED_VARIANTS, available_variants

ERROR_KEYS_ON_BOTH_MODELS = "e3", "e_max", "tip_max"
"""Keys of errors in mm that are reported on the model planned on and on the elastic one."""


def every_method() -> list[str]:
    """Return the name of each method once: ours with default solvers, robust ones, and reference methods."""
    solvers = {default_chain_solver(), default_solver()}
    ours = [name for name in available_variants() if ":" in name and name.split(":")[1] in solvers]
    return [*ours, *ROBUST_VARIANTS, *REFERENCE_METHODS, *LUMEN_PATH_VARIANTS, *WARM_STARTED_VARIANTS]


def measure_plan(problem: str, variant: str, plan: Plan, samples: int = DEFAULT_PLAN_SAMPLES) -> dict[str, Any]:
    """Measure a plan, and return the figures as a row: errors in mm, times in ms.

    problem, variant: names, for the row. plan: any method's. samples: number of sampled robots. planned_*: on the
    model planned on; all else is of the motion on the elastic model. own_path: largest distance of the robot from
    its own last shape, which is 0 in follow-the-leader motion. depth: deepest contact with the wall, None where no
    wall is known. lost: share of the sampled robots that snap or end on another branch; draws_e3: mean of e3 over
    them; both are None where no frame has a shape. frame_ms: time of search and solution divided by frames,
    without the construction of programs.
    """
    moved = plan.check(samples)
    planned = summary(plan)
    found = summary(moved)
    drawn = moved.drawn
    errors = None if drawn is None else drawn.errors
    frames = found["frames"]
    seconds = planned["solve_ms"]["total"] / 1e3 + (planned["search_s"] or 0.0)
    return {
        "problem": problem,
        "variant": variant,
        "model": plan.meta["model"],
        **{f"planned_{key}": planned[key] for key in ERROR_KEYS_ON_BOTH_MODELS},
        **{key: found[key] for key in ERROR_KEYS_ON_BOTH_MODELS},
        "own_path": _largest_finite(follow_the_leader_deviation(moved)),
        "roughness": found["roughness"],
        "lost": None if drawn is None else drawn.lost_share,
        "draws": None if drawn is None else len(drawn),
        "draws_e3": None if errors is None else errors.mean,
        "snaps": len(found["snaps"]),
        "margin": found["stability_between_min"],
        "planned_depth": _largest_finite(contact_depths(plan)),
        "depth": _largest_finite(contact_depths(moved)),
        "frame_ms": 1e3 * seconds / frames,
        "solved": frames - planned["failed"],
        "frames": frames,
        "interrupted": found["interrupted"],
        "tip_last": found["tip_last"],
        "no": ", ".join(moved.verdicts.failed_names),
        **verdict_columns(moved),
    }


def _largest_finite(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else None
