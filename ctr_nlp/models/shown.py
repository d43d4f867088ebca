"""How what a robot shows changes with its motors, and with other quantities while these stand still.

Let y be those unknowns x of a model that are no part of the configuration, and c(x; z) what of the
configuration x does not hold: the motors' angles and, of loaded robots, the tilt. A shape p(x; z) changes at a
held configuration by dp = p_z dz + p_y dy with dy = -A c_z dz, A = (c_y)^-1; with what of the configuration c is,
by p_y A dc; and with what of it x holds, r, by (p_r - p_y A c_r) dr.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from ctr_nlp.models.protocol import Shape


def shown_slopes(shape: Shape, rows: ca.SX, others: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """What makes of expressions in x and others (k, 1) their slopes (.., 2d + 2 + k) over alpha, beta, theta, and
    over others with these held.

    rows: Shape.rows side by side, in x and others: what of the configuration x does not hold.
    """
    unknowns, places = shape.x.numel(), shape.picks or tuple(range(shape.x.numel()))
    q = list(places[: 2 * len(shape.beta) + 2])
    own = [k for k in range(unknowns) if k not in q]
    into = ca.inv(ca.jacobian(rows, shape.x)[:, own]) if own else ca.SX(0, 0)

    def straight(of: ca.SX) -> ca.SX:
        """Slopes over q, as far as x holds it, and over others."""
        over_x = ca.horzcat(ca.jacobian(of, shape.x), ca.SX(of.numel(), rows.numel()))
        return ca.horzcat(over_x[:, q], ca.jacobian(of, others))

    def slopes(of: ca.SX) -> ca.SX:
        if not own:
            return straight(of)
        held = ca.horzcat(ca.SX(len(own), unknowns), into)[:, q]
        of_own = ca.horzcat(held, ca.SX(len(own), others.numel())) - into @ straight(rows)
        return straight(of) + ca.jacobian(of, shape.x)[:, own] @ of_own

    return slopes
