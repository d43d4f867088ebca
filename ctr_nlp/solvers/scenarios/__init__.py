"""Interior-point solver of motions that several robots share (ocp/scenarios.py).

Each scenario's tips are eliminated from every Newton step by its own equations, so that the remaining system has
the unknowns of the shared q alone and is banded, however many scenarios there are.
"""

from ctr_nlp.solvers.scenarios.interior_point import SharedSolver
from ctr_nlp.solvers.scenarios.rows import SharedSolution

__all__ = ["SharedSolution", "SharedSolver"]
