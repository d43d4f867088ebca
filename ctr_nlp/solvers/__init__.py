"""NLP solvers, one call each: Nlp -> NlpSolver -> Solution, and Chain -> a chain solver -> Solution.

`frame` solves the program of one frame (SQP in C, or IPOPT), `motion` that of all frames of one robot (a banded
interior-point method in C, or IPOPT), `scenarios` that of several robots that share their motors. All judge
success by the KKT conditions of the problem itself, never by a solver's own status.
"""

from collections.abc import Callable

from ctr_nlp.codegen import cache
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.nlp import Nlp
from ctr_nlp.solvers.frame.adapter import FEASIBILITY_TOLERANCE, Ipopt, NlpSolver, Solution
from ctr_nlp.solvers.frame.sqp import Sqp
from ctr_nlp.solvers.motion.banded import BandedSolver
from ctr_nlp.solvers.motion.ipopt import IpoptSolver
from ctr_nlp.solvers.motion.watch import Iterate, Watch

SOLVERS: dict[str, Callable[[Nlp], NlpSolver]] = {"ipopt": Ipopt, "sqp": Sqp}
"""Solvers of a frame, by the names that options use."""

ChainSolver = BandedSolver | IpoptSolver

CHAIN_SOLVERS: dict[str, Callable[[Chain], ChainSolver]] = {
    "banded": BandedSolver,
    "ipopt": IpoptSolver,
}
"""Solvers of chains, by the names that options use; each is called as solver(x0, watch[, first barrier])."""


def default_solver() -> str:
    """Return the name of the fastest frame solver that works here: sqp needs a C compiler."""
    return "ipopt" if cache.unavailable_reason() else "sqp"


def default_chain_solver() -> str:
    """Return the name of the fastest chain solver that works here: banded needs a C compiler."""
    return "ipopt" if cache.unavailable_reason() else "banded"


__all__ = [
    "CHAIN_SOLVERS",
    "FEASIBILITY_TOLERANCE",
    "SOLVERS",
    "ChainSolver",
    "Iterate",
    "NlpSolver",
    "Solution",
    "Watch",
    "default_chain_solver",
    "default_solver",
]
