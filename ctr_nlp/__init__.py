"""Whole-shape steering of concentric tube robots: problem -> plan -> errors -> figures."""

from ctr_nlp.anatomy.problem_files import problem_from_file, read_csv
from ctr_nlp.exceptions import CtrError
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.plan.metrics import by_frame, summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Limits, Robot, Tube, seed_robot, table_i_robot
from ctr_nlp.simulation.forward import shape_curve, shapes
from ctr_nlp.steer import Steerer, solve_horizon, solve_per_frame
from ctr_nlp.target.curve import Curve, curve_from_formula, curve_from_points
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import Target, growing, sequence

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
    "table_i_robot",
]
