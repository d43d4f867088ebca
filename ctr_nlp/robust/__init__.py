"""Robust plans: one motion that the nominal robot and perturbed robots within its tolerances all follow."""

from ctr_nlp.robust.per_frame import solve_robust_per_frame
from ctr_nlp.robust.plan import solve_robust

__all__ = ["solve_robust", "solve_robust_per_frame"]
