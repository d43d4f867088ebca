"""Plans of robots that are loaded in tests."""

from __future__ import annotations

import numpy as np
from malformed import plan as three_tubes

from ctr_nlp import Plan, Problem, Robot, Tube, curve_from_formula, growing
from ctr_nlp.paths.curve import Curve
from ctr_nlp.plan.plan import plan_from_configurations

TWO = Robot((Tube(90, 70, 0.01, 4.0, 3.2), Tube(150, 90, 0.01, 2.6, 1.6)))
"""Moduli are ratios."""
FRAMES = 4


def made(robot: Robot, q: np.ndarray, path: Curve | None = None) -> Plan:
    """On the elastic model; that its shapes are not those of its target does not matter."""
    each = dict.fromkeys(("solve_time", "objective", "kkt"), np.arange(len(q), dtype=float))
    told = dict(three_tubes().meta) | {"model": "elastic"}
    path = path or curve_from_formula(lambda u: (0.0 * u, 0.0, u), 0.0, 80.0)
    problem = Problem("turned", robot, growing(path, len(q)))
    return plan_from_configurations(problem, q, told, success=np.full(len(q), True), **each)


def through_the_pole() -> np.ndarray:
    """Configurations (5, 6) of two tubes whose base goes through theta_x = 90 deg."""
    q = np.zeros((5, 6))
    q[:, 0], q[:, 2], q[:, 3] = np.linspace(0, 0.4, 5), np.linspace(20, 60, 5), np.linspace(40, 80, 5)
    q[:, 4], q[:, 5] = np.pi / 2 + np.linspace(-0.3, 0.3, 5), np.linspace(-0.2, 0.2, 5)
    return q


def turned() -> Plan:
    """Two tubes that turn against each other a little."""
    q = np.zeros((FRAMES, 6))
    q[:, 0], q[:, 2:4] = np.linspace(0, 0.6, FRAMES), (60.0, 80.0)
    return made(TWO, q)
