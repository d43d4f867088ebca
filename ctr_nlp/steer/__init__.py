"""Planners: they take a problem (robot, target, lumen) and settings, and return a plan."""

from ctr_nlp.steer.horizon import Horizon, horizon_planner, solve_horizon
from ctr_nlp.steer.per_frame import march, solve_per_frame
from ctr_nlp.steer.requests import DIRECTIONS
from ctr_nlp.steer.runtime import Steerer

__all__ = ["DIRECTIONS", "Horizon", "Steerer", "horizon_planner", "march", "solve_horizon", "solve_per_frame"]
