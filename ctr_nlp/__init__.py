"""Whole-shape steering of concentric tube robots: problem -> plan -> errors -> figures."""

from ctr_nlp.curve import Curve, curve_from_formula, curve_from_points
from ctr_nlp.errors import CtrError
from ctr_nlp.forward import shape_curve, shapes
from ctr_nlp.metrics import by_frame, summary
from ctr_nlp.plan import Plan
from ctr_nlp.problem import Problem
from ctr_nlp.problem_files import problem_from_file, read_csv
from ctr_nlp.robot import Limits, Robot, Tube, seed_robot
from ctr_nlp.settings import Settings
from ctr_nlp.steer import Steerer, solve_horizon, solve_per_frame
from ctr_nlp.target import Target, growing, sequence

__all__ = [
    "CtrError",
    "Curve",
    "Limits",
    "Plan",
    "Problem",
    "Robot",
    "Settings",
    "Steerer",
    "Target",
    "Tube",
    "by_frame",
    "curve_from_formula",
    "curve_from_points",
    "growing",
    "problem_from_file",
    "read_csv",
    "seed_robot",
    "sequence",
    "shape_curve",
    "shapes",
    "solve_horizon",
    "solve_per_frame",
    "summary",
]
