"""Sensitivities of shapes, motors' angles and stability margins to the numbers p of tubes, to first order.

At a fixed configuration q the tips phi adapt: by the implicit function theorem d phi / d p = -(d alpha / d phi)^-1
d alpha / d p (models/implicit_derivatives.py). The stability margin mu is implicit, too: D(mu, p) = 0 for the
determinant D of the second variation shifted by mu, so that d mu / d p = -(dD / dp) / (dD / dmu). Units: mm, rad,
and those of the numbers.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.models import Model, model_named
from ctr_nlp.models.implicit_derivatives import make_total_derivative
from ctr_nlp.models.protocol import frame_and_load_symbol, symbolic_tubes
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure
from ctr_nlp.typing import Array


class Sensitivities(NamedTuple):
    """Derivatives over the numbers of tubes, (.., d, 8) in the order of TUBE_NUMBER_NAMES, at T equilibria.

    points (T, n, 3, d, 8): of the shape at uniform sigma, mm per unit, at fixed unknowns. alpha (T, d, d, 8): of
    the motors' angles, rad per unit, at fixed unknowns; 0 where alpha is an unknown itself. points_at_fixed_q
    (T, n, 3, d, 8): of the shape at a fixed configuration, as observed while motors stand still. margin (T, d, 8):
    of the stability margin at fixed unknowns; NaN where nothing can be unstable.
    """

    points: Array
    alpha: Array
    points_at_fixed_q: Array
    margin: Array


def sensitivities(robot: Robot, x: Array, model: str | Model, sigma: Array = SIGMA_GRID) -> Sensitivities:
    """Return the derivatives of a robot's shape, motors' angles and margin over the numbers of its tubes.

    x: (T, n_x), unknowns of the model. model: kinematic model. sigma: (n,), sample points of the shape. Near a
    fold derivatives at a fixed configuration grow without bound. Raises OptionError.
    """
    described = model_named(model)
    described.check(robot)
    x = np.atleast_2d(np.asarray(x, dtype=float))
    function = derivatives(described, robot.structure, len(sigma))
    # Where nothing can be unstable the margin is NaN and is not used: 0 keeps the function's other outputs finite.
    margins = np.nan_to_num(described.margins(robot, x))
    found = [function(row, sigma, robot.numbers, margin) for row, margin in zip(x, margins, strict=True)]
    size = robot.d, len(TUBE_NUMBER_NAMES)
    points, alpha, moved, margin = (np.array([each[k].full() for each in found]) for k in range(4))
    return Sensitivities(
        _unflatten_derivatives(points, (3, len(sigma)), size).swapaxes(1, 2),
        _unflatten_derivatives(alpha, (robot.d,), size),
        _unflatten_derivatives(moved, (3, len(sigma)), size).swapaxes(1, 2),
        _unflatten_derivatives(margin, (), size),
    )


def _unflatten_derivatives(found: Array, rows: tuple[int, ...], size: tuple[int, int]) -> Array:
    """Return derivatives (T, rows, 8 d) as (T, *rows, d, 8); size: (d, 8)."""
    # CasADi stores matrices by columns: all tubes' first number, then all tubes' second number.
    split: Array = found.reshape(len(found), *rows, *size[::-1])
    return split.swapaxes(-1, -2)


@functools.lru_cache(maxsize=16)
def derivatives(model: Model, structure: Structure, count: int) -> ca.Function:
    """Build the function (x, sigma (count,), numbers (d, 8), margin) -> derivatives over numbers.

    model, structure: of the robot. count: number of sample points. The outputs are the derivatives of points
    (3 count, 8 d) and of alpha (d, 8 d) at fixed x, of points (3 count, 8 d) at a fixed configuration, and of the
    margin (1, 8 d).
    """
    d = structure.d
    sigma = ca.SX.sym("sigma", count)
    margin = ca.SX.sym("margin")
    numbers = ca.SX.sym("numbers", d, len(TUBE_NUMBER_NAMES))
    tubes = symbolic_tubes(structure, numbers)
    asked = margin if model.can_snap else None
    shape = model.frame(structure, tubes, lambda beta: sigma * beta[-1], asked)
    stable = ca.SX(1, 1) if shape.stability is None else shape.stability[-1]
    points = ca.vertcat(*(ca.SX(axis) for axis in shape.to_base_frame(shape.points)))
    written = [points, ca.vertcat(*shape.rows.values()), shape.alpha, stable]
    symbols, values = shape.inner.columns
    # Inner values are symbols of their own, which depend on the tubes' numbers: substituted before
    # differentiating.
    points, rows, alpha, determinant = ca.substitute(written, [symbols], [values])
    over = ca.vec(numbers)
    of_points, of_alpha, of_determinant = (ca.jacobian(each, over) for each in (points, alpha, determinant))
    # The first 2d + 2 columns are derivatives over the configuration.
    moved = make_total_derivative(shape, rows, over)(points)[:, 2 * d + 2 :]
    slope = ca.jacobian(determinant, margin)
    of_margin = -of_determinant / slope if shape.stability is not None else ca.SX.nan(1, over.numel())
    outputs = [ca.densify(each) for each in (of_points, of_alpha, moved, of_margin)]
    return ca.Function("derivatives", [shape.x, sigma, numbers, margin], outputs, {"cse": True})


@functools.lru_cache(maxsize=16)
def shape_derivatives_at_q(model: Model, structure: Structure, count: int) -> ca.Function:
    """Build the function (x, sigma (count,), numbers (d, 8), load) -> derivatives of the points of the shape.

    model, structure: of the robot. count: number of sample points. Points are (3 count,), x of all before y and z.
    The outputs are their derivatives over numbers at a fixed configuration (3 count, 8 d), and over the
    configuration (3 count, 2d + 2). load: its numbers, empty on a model without a load.
    """
    d = structure.d
    sigma = ca.SX.sym("sigma", count)
    numbers = ca.SX.sym("numbers", structure.d, len(TUBE_NUMBER_NAMES))
    tubes = symbolic_tubes(structure, numbers)
    shape, load = frame_and_load_symbol(model, structure, tubes, lambda beta: sigma * beta[-1])
    symbols, values = shape.inner.columns
    written = [
        ca.vertcat(*(ca.SX(axis) for axis in shape.to_base_frame(shape.points))),
        ca.vertcat(*shape.rows.values()),
    ]
    points, rows = ca.substitute(written, [symbols], [values])
    found = make_total_derivative(shape, rows, ca.vec(numbers))(points)
    outputs = [ca.densify(each) for each in (found[:, 2 * d + 2 :], found[:, : 2 * d + 2])]
    return ca.Function("shown_changes", [shape.x, sigma, numbers, load], outputs, {"cse": True})
