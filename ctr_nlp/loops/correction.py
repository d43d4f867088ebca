"""Where an estimated robot has a planned shape, to first order: near the planned configuration and within limits."""

from __future__ import annotations

import math
from typing import NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.loops.prediction import Predicted
from ctr_nlp.nlp.nlp import Constraint, Cost, Nlp, Residual
from ctr_nlp.robot import Robot
from ctr_nlp.solvers.frame.adapter import FEASIBLE
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.typing import Array

SHORT = 30.0
"""mm^2 that a margin costs which is missed by 1, so that it is held unless limits of speed do not allow it."""


class Linear(NamedTuple):
    """A robot at q (2d + 2,) of its tubes and what is predicted there, at the places in shape; margin: there."""

    q: Array
    predicted: Predicted
    margin: float


class Correction:
    """A quadratic program over the configuration of the tubes, whose numbers are given every time."""

    def __init__(self, robot: Robot, roots: Array, pull: float) -> None:
        """roots (n,): square roots of the weights of places of the shape, whose squares sum to 1.

        pull: mm^2 that a mm away from the planned configuration costs. Raises OptionError where nothing can be
        compiled.
        """
        self._scale = math.sqrt(pull) * robot.mm_per_unit
        self._roots, self._size = np.repeat(roots, 3), len(robot.axes)
        self._program = Program(_nlp(robot), wait=True)
        nlp = self._program.nlp
        self._root, self._wanted, self._margin = (
            self._program.p[nlp.place(name)] for name in ("root", "wanted", "margin")
        )

    def __call__(self, at: Linear, points: Array, planned: Array, low: Array, high: Array, margin: float) -> Array | None:
        """The configuration of the tubes (2d + 2,) within low and high; None where none is found.

        points (n, 3): where the places are to be, mm; planned (2d + 2,): where the tubes were planned to be. margin:
        the least, which is missed where limits do not allow it.
        """
        size, program = self._size, self._program
        slopes = at.predicted.of_points[:size].reshape(size, -1).T * self._roots[:, None]
        away = (points - at.predicted.points).ravel() * self._roots
        whole = np.vstack([slopes, np.diag(self._scale)])
        right = np.concatenate([away + slopes @ at.q, self._scale * planned])
        factor, root = np.linalg.qr(whole)
        self._root[:], self._wanted[:] = root.ravel("F"), right @ factor
        slope = np.zeros(size) if math.isnan(at.margin) else at.predicted.of_margin[:size]
        least = 0.0 if math.isnan(at.margin) else margin - at.margin
        self._margin[:] = np.append(slope, least + slope @ at.q)
        program.lower[:size], program.upper[:size] = low, high
        program.x[:] = np.append(np.clip(planned, low, high), 0.0)
        program.multipliers[:] = 0.0
        found = program.run()
        return None if found.violation > FEASIBLE else np.clip(program.x[:size], low, high)


def _nlp(robot: Robot) -> Nlp:
    """|root q - wanted|^2 with the order of tubes, the carriages' gap and a margin that may be missed at a cost."""
    size, d = len(robot.axes), robot.d
    q, short = ca.SX.sym("q", size), ca.SX.sym("short")
    root, wanted, margin = ca.SX.sym("root", size, size), ca.SX.sym("wanted", size), ca.SX.sym("margin", size + 1)
    growth = ca.diff(q[d : 2 * d])
    free = np.full(size + 1, np.inf)
    held = ca.dot(margin[:size], q) - margin[size] + short
    return Nlp(
        "correction",
        ca.vertcat(q, short),
        np.append(-free[:-1], 0.0),
        free,
        {"root": root, "wanted": wanted, "margin": margin},
        residuals=(Residual("shape", ca.triu(root) @ q - wanted),),
        costs=(Cost("margin", SHORT * short),),
        constraints=(
            Constraint("order", growth, np.zeros(d - 1), np.asarray(robot.most_growth)),
            Constraint("margin", held, np.zeros(1), np.full(1, np.inf)),
        ),
        slacks=1,
    )
