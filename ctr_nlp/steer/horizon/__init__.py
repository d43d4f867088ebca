"""Plans over all frames at once: one nonlinear program for a whole motion."""

from ctr_nlp.steer.horizon.asked import horizon_planner, solve_horizon
from ctr_nlp.steer.horizon.chained import Horizon

__all__ = ["Horizon", "horizon_planner", "solve_horizon"]
