"""Plans that survive tubes that are not quite known."""

from ctr_nlp.steer.robust.per_frame import solve_robust_per_frame
from ctr_nlp.steer.robust.plan import solve_robust

__all__ = ["solve_robust", "solve_robust_per_frame"]
