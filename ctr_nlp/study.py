"""Many plans side by side: every variant on every problem, from one run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from ctr_nlp.errors import OptionError
from ctr_nlp.formulations import FORMULATIONS
from ctr_nlp.frames import FrameSolver
from ctr_nlp.metrics import summary
from ctr_nlp.models import MODELS
from ctr_nlp.problem import Problem
from ctr_nlp.reference import METHODS, reference_frames
from ctr_nlp.reference.published import BASELINE, SEED
from ctr_nlp.settings import Settings
from ctr_nlp.solvers import SOLVERS
from ctr_nlp.steer import march
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.passes import Direction, Progress


@dataclass(frozen=True)
class Variant:
    """A way to solve frames: formulation:solver[:model], or the name of a reference method."""

    name: str
    build: Callable[[Problem, Settings], FrameSolver]
    direction: Direction


VARIANTS = (*(f"{formulation}:{solver}" for formulation in FORMULATIONS for solver in SOLVERS), *METHODS)
"""Every variant on the default model."""


def parse_variant(name: str) -> Variant:
    """The variant of a name; raises OptionError with the valid ones.

    Reference methods go forward, as published; formulations in the better direction.
    """
    if name in METHODS:
        return Variant(name, lambda problem, settings: reference_frames(problem, name, settings), "forward")
    parts = name.split(":")
    if len(parts) not in (2, 3):
        raise OptionError(f"variant is {name!r}; it must be one of {', '.join(VARIANTS)}")
    formulation, solver, model = (*parts, "dominant")[:3]
    for kind, value, allowed in (
        ("formulation", formulation, FORMULATIONS),
        ("solver", solver, SOLVERS),
        ("model", model, MODELS),
    ):
        if value not in allowed:
            raise OptionError(f"{kind} of variant {name!r} is {value!r}; it must be one of {', '.join(allowed)}")
    return Variant(
        name, lambda problem, settings: NlpFrames(problem, formulation, solver, model, settings), "best"
    )


def compare(
    problems: Iterable[Problem],
    variants: Sequence[Variant],
    settings: Settings | None = None,
    progress: Callable[[str, str], Progress] | None = None,
) -> list[dict[str, Any]]:
    """One row per problem and variant, with the seed's published figures beside; one solve at a time.

    progress: (problem, variant) -> what is told how many frames are done.
    """
    rows = []
    for problem in problems:
        for variant in variants:
            report = None if progress is None else progress(problem.name, variant.name)
            solver = variant.build(problem, settings or Settings())
            plan = march(problem, solver, variant.direction, progress=report)
            rows.append(_row(problem.name, variant.name, summary(plan), plan.meta["iterations"]))
            if rows[-1]["interrupted"]:
                return rows
    return rows


def _row(problem: str, variant: str, found: dict[str, Any], iterations: int) -> dict[str, Any]:
    """Errors in mm, steps in rad and mm, times in ms and s. seed_*: Table II's figures for the same method."""
    e3, e4, t_c = (BASELINE if variant == "euclidean" else SEED).get(problem, (None, None, None))
    return {
        "problem": problem,
        "variant": variant,
        "e3": found["e3"],
        "e4": found["e4"],
        "e_max": found["e_max"],
        "tip_max": found["tip_max"],
        "step_alpha": found["max_step"]["alpha"],
        "step_beta": found["max_step"]["beta"],
        "step_theta": found["max_step"]["theta"],
        "median_ms": found["solve_ms"]["median"],
        "p99_ms": found["solve_ms"]["p99"],
        "build_s": found["build_s"],
        "search_s": found["search_s"],
        "iterations": iterations,
        "failed": found["failed"],
        "interrupted": found["interrupted"],
        "seed_e3": e3,
        "seed_e4": e4,
        "seed_t_s": t_c,
    }
