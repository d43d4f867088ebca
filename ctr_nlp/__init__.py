"""Whole-shape steering of concentric tube robots: problem -> plan -> errors -> figures.

Names are imported when they are first used, so that `import ctr_nlp` itself takes milliseconds.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ctr_nlp.anatomy.problem_files import problem_from_file, read_csv
    from ctr_nlp.anatomy.wall_files import WallFile, read_wall
    from ctr_nlp.exceptions import CtrError
    from ctr_nlp.identify.calibration.calibration import Calibration, calibrate
    from ctr_nlp.identify.calibration.measurements import Measurements
    from ctr_nlp.identify.calibration.reading import read_measurements
    from ctr_nlp.identify.force_estimation import ForceEstimate, estimate_forces
    from ctr_nlp.loads.contact_plan import solve_on_wall
    from ctr_nlp.loads.tip import Forces, forces
    from ctr_nlp.loads.wall import WallForces, wall_forces
    from ctr_nlp.models.loaded.model import Loaded
    from ctr_nlp.models.loads import Load, LoadOverTime, read_load
    from ctr_nlp.ocp.settings import Settings
    from ctr_nlp.ocp.shared.manufacture import Manufacture
    from ctr_nlp.paths.curve import Curve, curve_from_formula, curve_from_points
    from ctr_nlp.paths.named_problems import named_problem
    from ctr_nlp.paths.problem import Problem
    from ctr_nlp.paths.target import Target, growing, sequence
    from ctr_nlp.paths.walls import Body
    from ctr_nlp.plan.batch import batch
    from ctr_nlp.plan.metrics import by_frame, summary
    from ctr_nlp.plan.plan import Plan
    from ctr_nlp.plan.sample_motions import simulate_samples
    from ctr_nlp.plan.simulation import shape_curve, shapes
    from ctr_nlp.planning.horizon import solve_horizon
    from ctr_nlp.planning.per_frame import solve_per_frame
    from ctr_nlp.planning.steerer import Steerer
    from ctr_nlp.robot import Limits, Robot, Tolerances, Tube, table_i_robot
    from ctr_nlp.robot.samples import sample_robots
    from ctr_nlp.robot.shipped import read_robot_files
    from ctr_nlp.robust import solve_robust, solve_robust_per_frame
    from ctr_nlp.studies.grid.results import Results
    from ctr_nlp.studies.grid.study_file import Study
    from ctr_nlp.studies.reach.reach import Reach, reach_tree
    from ctr_nlp.studies.workers.running import run_study
    from ctr_nlp.tube_design.choice import RobotChoice, choose_robot, compare_robots
    from ctr_nlp.tube_design.co_design import Design, design
    from ctr_nlp.tube_design.groups import assign_to_robots, divide_problems
    from ctr_nlp.tube_design.stock import StockTube, read_stock
    from ctr_nlp.view.exchange.configurations import plan_through, read_configurations
    from ctr_nlp.view.exchange.robots import read_robot

__version__ = "0.1.0"

__all__ = [
    "Body",
    "Calibration",
    "CtrError",
    "Curve",
    "Design",
    "ForceEstimate",
    "Forces",
    "Limits",
    "Load",
    "LoadOverTime",
    "Loaded",
    "Manufacture",
    "Measurements",
    "Plan",
    "Problem",
    "Reach",
    "Results",
    "Robot",
    "RobotChoice",
    "Settings",
    "Steerer",
    "StockTube",
    "Study",
    "Target",
    "Tolerances",
    "Tube",
    "WallFile",
    "WallForces",
    "__version__",
    "assign_to_robots",
    "batch",
    "by_frame",
    "calibrate",
    "choose_robot",
    "compare_robots",
    "curve_from_formula",
    "curve_from_points",
    "design",
    "divide_problems",
    "estimate_forces",
    "forces",
    "growing",
    "named_problem",
    "plan_through",
    "problem_from_file",
    "reach_tree",
    "read_configurations",
    "read_csv",
    "read_load",
    "read_measurements",
    "read_robot",
    "read_robot_files",
    "read_stock",
    "read_wall",
    "run_study",
    "sample_robots",
    "sequence",
    "shape_curve",
    "shapes",
    "simulate_samples",
    "solve_horizon",
    "solve_on_wall",
    "solve_per_frame",
    "solve_robust",
    "solve_robust_per_frame",
    "summary",
    "table_i_robot",
    "wall_forces",
]

_HOMES = {
    "anatomy.problem_files": ("problem_from_file", "read_csv"),
    "anatomy.wall_files": ("WallFile", "read_wall"),
    "identify.calibration.calibration": ("Calibration", "calibrate"),
    "identify.calibration.measurements": ("Measurements",),
    "identify.calibration.reading": ("read_measurements",),
    "identify.force_estimation": ("ForceEstimate", "estimate_forces"),
    "tube_design.choice": ("RobotChoice", "choose_robot", "compare_robots"),
    "tube_design.groups": ("assign_to_robots", "divide_problems"),
    "tube_design.stock": ("StockTube", "read_stock"),
    "tube_design.co_design": ("Design", "design"),
    "exceptions": ("CtrError",),
    "view.exchange.configurations": ("plan_through", "read_configurations"),
    "view.exchange.robots": ("read_robot",),
    "ocp.settings": ("Settings",),
    "ocp.shared.manufacture": ("Manufacture",),
    "models.loads": ("Load", "LoadOverTime", "read_load"),
    "models.loaded.model": ("Loaded",),
    "plan.batch": ("batch",),
    "plan.metrics": ("by_frame", "summary"),
    "plan.plan": ("Plan",),
    "robot": ("Limits", "Robot", "Tolerances", "Tube", "table_i_robot"),
    "robot.samples": ("sample_robots",),
    "robot.shipped": ("read_robot_files",),
    "plan.sample_motions": ("simulate_samples",),
    "plan.simulation": ("shape_curve", "shapes"),
    "planning.horizon": ("solve_horizon",),
    "planning.per_frame": ("solve_per_frame",),
    "planning.steerer": ("Steerer",),
    "robust": ("solve_robust", "solve_robust_per_frame"),
    "loads.tip": ("Forces", "forces"),
    "loads.contact_plan": ("solve_on_wall",),
    "loads.wall": ("WallForces", "wall_forces"),
    "studies.grid.results": ("Results",),
    "studies.grid.study_file": ("Study",),
    "studies.reach.reach": ("Reach", "reach_tree"),
    "studies.workers.running": ("run_study",),
    "paths.curve": ("Curve", "curve_from_formula", "curve_from_points"),
    "paths.named_problems": ("named_problem",),
    "paths.problem": ("Problem",),
    "paths.target": ("Target", "growing", "sequence"),
    "paths.walls": ("Body",),
}
"""Module -> the public names that it holds."""


if not TYPE_CHECKING:  # type checkers know the names above, and no others

    def __getattr__(name: str) -> Any:
        for module, names in _HOMES.items():
            if name in names:
                globals()[name] = getattr(importlib.import_module(f"{__name__}.{module}"), name)
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
