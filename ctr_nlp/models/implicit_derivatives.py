"""Derivatives of a robot's shape over its motors, and over other quantities while the motors stand still.

Let y be the unknowns x of a model that are no part of the configuration q, r those that are, c(x; z) the part of q
that x does not contain (the motors' angles and, of loaded robots, the tilt), and z other quantities, such as
numbers of tubes. By the implicit function theorem, with A = (c_y)^-1, a shape p(x; z) changes

    over z at fixed q:     dp = (p_z - p_y A c_z) dz
    over c, a part of q:   dp = p_y A dc
    over r at fixed c:     dp = (p_r - p_y A c_r) dr

in mm per rad or mm. This is dphi/dp = -(dalpha/dphi)^-1 dalpha/dp in docs/method.md, "Derivatives with respect
to tube parameters". A does not exist at a snap, where c_y = dalpha/dphi is singular.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from ctr_nlp.models.protocol import SymbolicShape


def make_total_derivative(shape: SymbolicShape, rows: ca.SX, others: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """Return a function that maps an expression in x and others to its total derivatives (.., 2d + 2 + k).

    They are over alpha, beta, theta, and over others (k, 1) with these fixed; unknowns that are no part of the
    configuration are eliminated by the implicit function theorem. shape: the model's frame. rows: the values of
    SymbolicShape.rows in one column, in x and others: the part of the configuration that x does not contain.
    """
    unknowns = shape.x.numel()
    places = shape.picks or tuple(range(shape.x.numel()))
    q = list(places[: 2 * len(shape.beta) + 2])
    own = [k for k in range(unknowns) if k not in q]
    # A = (c_y)^-1; where x is q itself, nothing has to be eliminated.
    into = ca.inv(ca.jacobian(rows, shape.x)[:, own]) if own else ca.SX(0, 0)

    def straight(of: ca.SX) -> ca.SX:
        """Return partial derivatives over q, as far as x contains it, and over others."""
        # The configuration is picked from x followed by rows. Rows are results, over which a partial derivative is
        # 0.
        over_x = ca.horzcat(ca.jacobian(of, shape.x), ca.SX(of.numel(), rows.numel()))
        return ca.horzcat(over_x[:, q], ca.jacobian(of, others))

    def slopes(of: ca.SX) -> ca.SX:
        if not own:
            return straight(of)
        # Derivatives of y: A in the columns of q that are rows, and -A c_(r, others) in the other columns.
        held = ca.horzcat(ca.SX(len(own), unknowns), into)[:, q]
        of_own = ca.horzcat(held, ca.SX(len(own), others.numel())) - into @ straight(rows)
        return straight(of) + ca.jacobian(of, shape.x)[:, own] @ of_own

    return slopes
