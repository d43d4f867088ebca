"""Models as symbols: what a frame's nonlinear program is made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ctr_nlp.models import dominant
from ctr_nlp.models.elastic import shape as elastic
from ctr_nlp.models.elastic import stability, torsion
from ctr_nlp.nlp.nlp import Inner
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Vector

Places = Callable[[Sequence[ca.SX]], ca.SX]
"""Arc lengths (n, 1) of samples, mm, for beta."""

STEPS = 2
"""Steps of integration a section in a nonlinear program: 0.02 mm, where a forward solution has 0.002."""


@dataclass(frozen=True)
class Shape:
    """A robot's shape at some samples; everything but x is written in inner's symbols.

    x (n, 1): the unknowns, within lower and upper (n,). alpha (d, 1): the motors' angles; beta. picks: where the
    configuration stands among x's entries and then alpha's, and after it the tips' angles, which say on what
    branch of equilibria it is; None where x is q. points: x, y, z of the samples, mm, in axes whose directions are
    base. stability: determinants that are positive where the margin asked for is held.
    """

    x: ca.SX
    lower: Array
    upper: Array
    alpha: ca.SX
    beta: tuple[ca.SX, ...]
    points: Vector
    inner: Inner
    base: tuple[Vector, Vector, Vector] | None = None
    stability: tuple[ca.SX, ...] = ()
    picks: tuple[int, ...] | None = None

    def seen(self, target: ca.SX) -> Vector:
        """Points (n, 3) of the base frame in the axes of `points`."""
        if self.base is None:
            return columns_of(target)
        x, y, z = (sum(target[:, i] * axis[i] for i in range(3)) for axis in self.base)
        return x, y, z

    def placed(self) -> Vector:
        """Points in the base frame."""
        return self.points if self.base is None else elastic.combination(self.points, self.base)


def dominant_shape(robot: Robot, places: Places, margin: ca.SX | None) -> Shape:
    """On the dominant-stiffness model: x is q, and nothing can be unstable."""
    x, d = ca.SX.sym("q", 2 * robot.d + 2), robot.d
    q = ca.vertsplit(x)
    travelled = [
        ca.horzcat(side, along) for side, along, _ in dominant.arms(robot, q[d : 2 * d], places(q[d : 2 * d]), ca)
    ]
    planes = [_matrix(plane) for plane in dominant.directions(robot, q, ca)]
    inner = Inner.of(travelled + planes)
    arms = [ca.horzsplit(symbol) for symbol in inner.symbols[:d]]
    points = dominant.points(arms, [_vectors(symbol) for symbol in inner.symbols[d:]])
    return Shape(x, robot.lower, robot.upper, x[:d], tuple(q[d : 2 * d]), points, inner)


def elastic_shape(robot: Robot, places: Places, margin: ca.SX | None) -> Shape:
    """On the elastic model; margin: the least stability margin, None for none."""
    d, x = robot.d, ca.SX.sym("x", 2 * robot.d + 2)
    entries = ca.vertsplit(x)
    beta = entries[d : 2 * d]
    parts = torsion.sections(robot, beta, ca)
    twisted = torsion.twist(robot, entries, parts, ca, STEPS)
    lengths, _ = elastic.arms(robot, beta, parts, places(beta), ca, STEPS)
    vectors = elastic.curves(robot, entries, parts, twisted, ca)
    base = elastic.turned_base(robot, entries, ca)
    alpha = ca.vertcat(*torsion.motors(robot, entries, twisted))
    determinants = []
    if margin is not None and d > 1:
        responses = stability.responses(robot, entries, parts, twisted, margin, ca)
        determinants = [ca.vertcat(*(stability.determinant(response) for response in responses))]
    inner = Inner.of([ca.horzcat(*lengths), _matrix(vectors), _matrix(base), alpha, *determinants])
    travelled, directions, axes, motors, *stable = inner.symbols
    points = elastic.combination(ca.horzsplit(travelled), _vectors(directions))
    lower, upper = robot.lower.copy(), robot.upper.copy()
    lower[:d], upper[:d] = -np.inf, np.inf
    first, second, third = _vectors(axes)
    picks = (*range(2 * d + 2, 3 * d + 2), *range(d, 2 * d + 2), *range(d))
    return Shape(x, lower, upper, motors, tuple(beta), points, inner, (first, second, third), tuple(stable), picks)


def columns_of(points: ca.SX) -> Vector:
    """x, y and z of points (n, 3)."""
    x, y, z = ca.horzsplit(points)
    return x, y, z


def _matrix(vectors: Sequence[Vector]) -> ca.SX:
    """Vectors side by side, (3, n)."""
    return ca.horzcat(*(ca.vertcat(ca.SX(0, 1), *vector) for vector in vectors))


def _vectors(matrix: ca.SX) -> list[Vector]:
    """The columns of a matrix (3, n)."""
    columns = (ca.vertsplit(column) for column in ca.horzsplit(matrix))
    return [(x, y, z) for x, y, z in columns]
