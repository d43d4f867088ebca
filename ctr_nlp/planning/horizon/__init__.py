"""Plans over all frames at once: one nonlinear program for a whole motion."""

from ctr_nlp.planning.horizon.horizon import Horizon
from ctr_nlp.planning.horizon.planner import horizon_planner, solve_horizon

__all__ = ["Horizon", "horizon_planner", "solve_horizon"]
