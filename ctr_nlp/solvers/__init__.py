"""NLP solvers behind one call each: Nlp -> NlpSolver -> Solution, and Chain -> a chain solver -> Solution."""

from collections.abc import Callable

from ctr_nlp.codegen import cache
from ctr_nlp.nlp.chain import Chain
from ctr_nlp.nlp.nlp import Nlp
from ctr_nlp.solvers.frame.adapter import FEASIBLE, Ipopt, NlpSolver, Solution
from ctr_nlp.solvers.frame.sqp import Sqp
from ctr_nlp.solvers.motion.banded import BandedSolver
from ctr_nlp.solvers.motion.ipopt import IpoptSolver
from ctr_nlp.solvers.motion.watch import Iterate, Watch

SOLVERS: dict[str, Callable[[Nlp], NlpSolver]] = {"ipopt": Ipopt, "sqp": Sqp}
"""Every solver of a frame by the name that options use."""

ChainSolver = BandedSolver | IpoptSolver

CHAIN_SOLVERS: dict[str, Callable[[Chain], ChainSolver]] = {
    "banded": BandedSolver,
    "ipopt": IpoptSolver,
}
"""Every solver of chains by the name that options use; each is called with (x0, watch[, first barrier])."""


def default_solver() -> str:
    """The faster one that works here: sqp is compiled."""
    return "ipopt" if cache.missing() else "sqp"


def default_chain_solver() -> str:
    """The faster one that works here: banded is compiled."""
    return "ipopt" if cache.missing() else "banded"


__all__ = [
    "CHAIN_SOLVERS",
    "FEASIBLE",
    "SOLVERS",
    "ChainSolver",
    "Iterate",
    "NlpSolver",
    "Solution",
    "Watch",
    "default_chain_solver",
    "default_solver",
]
