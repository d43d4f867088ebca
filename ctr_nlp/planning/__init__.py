"""Planners: they take a problem (robot, target, lumen) and settings, and return a plan."""

from ctr_nlp.planning.horizon import Horizon, horizon_planner, solve_horizon
from ctr_nlp.planning.per_frame import march, solve_per_frame
from ctr_nlp.planning.steerer import Steerer
from ctr_nlp.planning.validation import DIRECTIONS

__all__ = ["DIRECTIONS", "Horizon", "Steerer", "horizon_planner", "march", "solve_horizon", "solve_per_frame"]
