"""Where an estimated robot has a planned shape, to first order: near the planned place and within limits."""

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
"""mm^2 that what must hold costs where it is missed by 1: it is held unless limits of speed do not allow it."""
MAX_CORRECTION_VIOLATION = 1e-3
"""rad, mm and parts of a margin by which limits may be missed for want of digits, before they are held."""


class LinearisedRobot(NamedTuple):
    """The estimated robot where its tubes are at q (2d + 2,), and how it changes to first order with them.

    seen (n, 3): places of its shape, mm, with slopes over (2d + 2, n, 3); margin, NaN where nothing can be
    unstable, with slopes of_margin (2d + 2,).
    """

    q: Array
    points: Array
    point_slopes: Array
    margin: float
    of_margin: Array


class Correction:
    """A quadratic program over the configuration of the tubes, whose numbers are given every time."""

    def __init__(self, robot: Robot, roots: Array) -> None:
        """Build; roots (n,): square roots of the weights of places of the shape, whose squares sum to 1.

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
        """The configuration of the tubes (2d + 2,) within low and high; None where none is found.

        wanted (n, 3): where the places of the shape are to be, mm; planned (2d + 2,): where the tubes were planned
        to be. margin: the least, which is missed where limits do not allow it. pull: mm^2 that a mm away from the
        planned configuration costs.
        """
        q = at.q
        size = self._size
        program = self._program
        scale = math.sqrt(pull) * self._mm_per_unit
        slopes = at.point_slopes.reshape(size, -1).T * self._roots[:, None]
        away = (wanted - at.points).ravel() * self._roots
        # Shape and pull together, |J s - away|^2 + |scale (s + q - planned)|^2, are |R s - r|^2 but for a
        # constant, with R'R = J'J + scale^2: a small triangular program in place of a row for each place. The pull
        # makes it positive definite.
        root = np.linalg.cholesky(slopes.T @ slopes + np.diag(scale**2)).T
        towards = slopes.T @ away + scale**2 * (planned - q)
        self._root[:], self._wanted[:] = root.ravel("F"), lapack.dtrtrs(root, towards, trans=1)[0]
        # 0 s - (-1) + short >= 0 holds always: the row stays, and constrains nothing.
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
    """|root step - wanted|^2, with the order of tubes, carriages apart, and a margin missed only at a cost."""
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
