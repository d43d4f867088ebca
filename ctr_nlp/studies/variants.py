"""Ways to solve a problem, by a text such as ``"horizon:banded:elastic"``, so that plans can be compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp import FORMULATIONS
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.per_frame import solve_per_frame
from ctr_nlp.solvers import CHAIN_SOLVERS, SOLVERS
from ctr_nlp.support.value_checks import check_choice
from ctr_nlp.typing import Array

PAPER_MODEL = "dominant"
"""The model of variants that name none: the paper's own."""
SOLVER_VARIANTS = (
    *(f"horizon:{solver}" for solver in CHAIN_SOLVERS),
    *(f"{formulation}:{solver}" for formulation in FORMULATIONS for solver in SOLVERS),
)
"""Every formulation with every solver that it can use, on the dominant model."""


@dataclass(frozen=True)
class Variant:
    """A method for solving a problem, with a name.

    formulation, model: names of what it uses. plan: (problem, settings, initial, progress) -> Plan; `initial` are
    motions (T, 2d + 2) that a horizon starts from.
    """

    name: str
    formulation: str
    model: str
    plan: Callable[[Problem, Settings, Sequence[Array], Progress | None], Plan]


def parse_solver_variant(name: str, others: Sequence[str] = ()) -> Variant:
    """Return the variant formulation:solver[:model] of a name; frame by frame it goes in the better direction.

    others: names that the caller also understands, for the message. Raises OptionError with the valid names.
    """

    def whole(problem: Problem, settings: Settings, initial: Sequence[Array], progress: Progress | None) -> Plan:
        asked: dict[str, Any] = {"model": model, "solver": solver, "settings": settings}
        return solve_horizon(problem, **asked, initial=initial, progress=progress)

    def by_frame(problem: Problem, settings: Settings, _: Sequence[Array], progress: Progress | None) -> Plan:
        asked: dict[str, Any] = {"model": model, "solver": solver, "settings": settings}
        return solve_per_frame(problem, formulation, **asked, progress=progress)

    parts = name.split(":")
    if len(parts) not in (2, 3):
        raise OptionError(f"variant is {name!r}; it must be one of {', '.join([*SOLVER_VARIANTS, *others])}")
    formulation, solver, model = (*parts, PAPER_MODEL)[:3]
    for kind, value, allowed in (
        ("formulation", formulation, ("horizon", *FORMULATIONS)),
        ("solver", solver, CHAIN_SOLVERS if formulation == "horizon" else SOLVERS),
        ("model", model, KINEMATIC_MODELS),
    ):
        check_choice(f"{kind} of variant {name!r}", value, allowed)
    return Variant(name, formulation, model, whole if formulation == "horizon" else by_frame)
