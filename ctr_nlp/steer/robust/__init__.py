"""Plans that survive tubes that are not quite known."""

from ctr_nlp.steer.robust.plan import solve_robust
from ctr_nlp.steer.robust.rounds import Lost

__all__ = ["Lost", "solve_robust"]
