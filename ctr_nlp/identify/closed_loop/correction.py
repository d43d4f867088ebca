"""Correction of tubes towards a planned shape: a quadratic program around the estimated robot.

With the step s of the configuration, J the slopes of the shape, e what is missing of the planned shape, m the
stability margin with slopes g, and a slack z >= 0,

    min  |J s - e|^2 + pull |W (q + s - q_planned)|^2 + c z   subject to  m + g . s + z >= m_least,

the limits of q and s, the order of tubes and the distance of carriages. The slack makes it always feasible. W is
10 mm/rad for angles and 1 for extensions, as in the motion term of eq. (9).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import lapack

from ctr_nlp.ocp.nlp import Constraint, CostTerm, Nlp, Residual
from ctr_nlp.robot import Robot
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.typing import Array

MARGIN_SHORTFALL_COST_MM2 = 30.0
"""Cost c, mm^2, of a shortfall of the margin by 1: it is satisfied unless limits of speed do not allow it."""
MAX_CORRECTION_VIOLATION = 1e-3
"""Largest violation, rad, mm and parts of a margin, of a solution that is used after clipping to its limits."""


class LinearisedRobot(NamedTuple):
    """The estimated robot with its tubes at q (2d + 2,), linearised in these.

    points (n, 3): of its shape, mm, with point_slopes (2d + 2, n, 3). margin: NaN where nothing can be unstable,
    with slopes of_margin (2d + 2,).
    """

    q: Array
    points: Array
    point_slopes: Array
    margin: float
    of_margin: Array


class Correction:
    """The quadratic program over the configuration of the tubes, compiled once and solved with new numbers."""

    def __init__(self, robot: Robot, roots: Array) -> None:
        """Build the program; roots (n,): square roots of the weights of points, which sum to 1.

        Raises OptionError where nothing can be compiled.
        """
        self._mm_per_unit = robot.mm_per_unit
        self._roots = np.repeat(roots, 3)
        self._size = len(robot.axes)
        self._program = Program(_nlp(robot), wait=True)
        nlp = self._program.nlp
        self._root, self._wanted, self._margin, self._growth = (
            self._program.p[nlp.parameter_slice(name)] for name in ("root", "wanted", "margin", "growth")
        )
        self._betas = slice(robot.d, 2 * robot.d)

    def __call__(
        self,
        at: LinearisedRobot,
        wanted: Array,
        planned: Array,
        low: Array,
        high: Array,
        margin: float,
        pull: float,
    ) -> Array | None:
        """Return the configuration of the tubes (2d + 2,) within low and high (2d + 2,); None where none is found.

        at: the linearised robot. wanted: (n, 3), planned points of the shape, mm. planned: (2d + 2,), planned
        configuration. margin: the least stability margin. pull: cost, mm^2, of a mm away from the planned
        configuration.
        """
        q = at.q
        size = self._size
        program = self._program
        scale = math.sqrt(pull) * self._mm_per_unit
        slopes = at.point_slopes.reshape(size, -1).T * self._roots[:, None]
        away = (wanted - at.points).ravel() * self._roots
        # Shape and pull together, |J s - away|^2 + |scale (s + q - planned)|^2, are |R s - r|^2 but for a
        # constant, with R'R = J'J + scale^2: a small triangular system instead of a row for each point. The pull
        # makes it positive definite.
        root = np.linalg.cholesky(slopes.T @ slopes + np.diag(scale**2)).T
        towards = slopes.T @ away + scale**2 * (planned - q)
        self._root[:], self._wanted[:] = root.ravel("F"), lapack.dtrtrs(root, towards, trans=1)[0]
        # On a model that cannot snap, 0 s - (-1) + short >= 0: the row stays in the program and is never active.
        stable = math.isnan(at.margin)
        self._margin[:] = (
            np.append(np.zeros(size), -1.0) if stable else np.append(at.of_margin, margin - at.margin)
        )
        self._growth[:] = np.diff(q[self._betas])
        program.lower[:size], program.upper[:size] = low - q, high - q
        program.x[:] = np.append(np.clip(0.0, low - q, high - q), 0.0)
        program.multipliers[:] = 0.0
        found = program.run()
        return None if found.violation > MAX_CORRECTION_VIOLATION else np.clip(q + program.x[:size], low, high)


def _nlp(robot: Robot) -> Nlp:
    """Build the program: |root step - wanted|^2, with the order of tubes, carriages, and a soft margin."""
    size = len(robot.axes)
    d = robot.d
    step = ca.SX.sym("step", size)
    short = ca.SX.sym("short")
    root = ca.SX.sym("root", size, size)
    wanted = ca.SX.sym("wanted", size)
    growth = ca.SX.sym("growth", d - 1)
    margin = ca.SX.sym("margin", size + 1)
    held = ca.dot(margin[:size], step) - margin[size] + short
    free = np.full(size + 1, np.inf)
    order = growth + ca.diff(step[d : 2 * d])
    return Nlp(
        "correction",
        ca.vertcat(step, short),
        np.append(-free[:-1], 0.0),
        free,
        {"root": root, "wanted": wanted, "margin": margin, "growth": growth},
        residuals=(Residual("shape", ca.triu(root) @ step - wanted),),
        costs=(CostTerm("short", MARGIN_SHORTFALL_COST_MM2 * short),),
        constraints=(
            Constraint("order", order, np.zeros(d - 1), np.asarray(robot.max_extension_differences)),
            Constraint("margin", held, np.zeros(1), np.full(1, np.inf)),
        ),
        slacks=1,
    )
