"""NLP solvers behind one call: Nlp -> NlpSolver -> Solution."""

from ctr_nlp.solvers.adapter import SOLVERS, NlpSolver, Solution

__all__ = ["SOLVERS", "NlpSolver", "Solution"]
