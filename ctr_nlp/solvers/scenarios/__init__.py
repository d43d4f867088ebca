"""Solving motions that scenarios share: their tips are eliminated from every Newton step, and the rest is
banded.
"""

from ctr_nlp.solvers.scenarios.interior import SharedSolver
from ctr_nlp.solvers.scenarios.rows import SharedSolution

__all__ = ["SharedSolution", "SharedSolver"]
