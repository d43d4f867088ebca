"""Plans of two tubes that are turned against each other, towards where their branch of equilibria ends."""

import numpy as np

from ctr_nlp import Limits, Robot, Tolerances, Tube
from ctr_nlp.paths.curve import curve_from_points
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import growing
from ctr_nlp.plan.plan import plan_from_configurations

LONG = Robot(
    (Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)),
    Limits(alpha_speed=100.0),
    Tolerances(curvature=(0.02, 0), bending_stiffness=0, motor_zero=(0.3, 0)),
)


def plan_through(q, robot=LONG, model="elastic", radius=None):
    """A plan that moves a robot through q, along a straight path."""
    path = curve_from_points(np.outer(np.linspace(0, 80, 20), [0, 0, 1.0]))
    lumen = (
        None
        if radius is None
        else curve_from_points(path.point(np.linspace(0, 80, 20)), radius=np.full(20, radius))
    )
    problem = Problem("made", robot, growing(path, len(q)), lumen=lumen)
    meta = {
        "model": model,
        "formulation": "made",
        "solver": "none",
        "options": {},
        "failures": {},
        "interrupted": False,
    }
    known = {"solve_time": np.zeros(len(q)), "objective": np.zeros(len(q)), "kkt": np.zeros(len(q))}
    return plan_from_configurations(problem, q, meta, success=np.ones(len(q), dtype=bool), **known)


def near_the_fold(last=4.2, frames=12):
    """The outer tube turned against the inner one, up to shortly before the robot snaps, at 4.29 rad."""
    q = np.zeros((frames, 6))
    q[:, 0], q[:, 2:4] = np.linspace(0.0, last, frames), (60.0, 80.0)
    return q
