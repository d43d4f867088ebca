"""What tests compute over all rows of a chain and the product does row by row in C, and a chain of bent links."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.links import FrameLink, differences
from ctr_nlp.ocp.nlp import Constraint, Nlp, Residual
from ctr_nlp.typing import Array


def times(chain: Chain, jacobian: Array, x: Array) -> Array:
    """The Jacobian of all rows, with that of the frames' constraints (T, m, n), times x: (rows,)."""
    frames, _, n = jacobian.shape
    own = np.concatenate([x, (jacobian @ x.reshape(frames, n, 1)).ravel()])
    return np.concatenate([own, chain.linking @ own])


def whole_jacobian(chain: Chain, jacobian: Array) -> Array:
    """The Jacobian of all rows, (rows, T n), with that of the frames' constraints (T, m, n)."""
    return np.stack([times(chain, jacobian, e) for e in np.eye(chain.lower.size)], axis=-1)


def links_hessian(chain: Chain, jacobian: Array) -> Array:
    """What the links' costs add to the frames' Hessians, (T n, T n), from the Jacobian of all rows."""
    of_links = jacobian[len(jacobian) - len(chain.offset) :]
    return of_links.T @ np.diag(2 * chain.weight) @ of_links


def central(function, x: Array, h: float = 1e-5) -> Array:
    """The Jacobian (.., x.size) of function by central differences."""
    return np.stack([(function(x + e) - function(x - e)) / (2 * h) for e in h * np.eye(x.size)], axis=-1)


# A chain whose links are bent

START, END = np.array([0.4, 3.0, 0.1]), np.array([0.7, 10.0, 0.2])
"""x = (phi, beta, theta) before the first frame and in the last."""
MOST = np.array([0.35, 2.5, 0.3]), np.array([0.25, 1.5, 0.15])
"""Of steps and of steps' steps."""
COST = np.array([2.0, 0.05, 1.0])


def alpha(phi, beta, sin=np.sin):
    """The angle at the base of a tube that is turned by phi at its tip."""
    return phi + 0.03 * beta * sin(phi)


def configuration(x: Array) -> Array:
    """q = (alpha, beta, theta) of x (.., 3)."""
    return np.concatenate([alpha(x[..., :1], x[..., 1:2]), x[..., 1:]], axis=-1)


def twisted(as_unknown: bool = False) -> Nlp:
    """x = (phi, beta, theta), whose configuration has alpha for phi; as_unknown: alpha is the fourth unknown, and
    an equation says what it is.
    """
    x, aim = ca.SX.sym("x", 4 if as_unknown else 3), ca.SX.sym("aim", 3)
    phi, beta, theta = x[0], x[1], x[2]
    own, limit = alpha(phi, beta, ca.sin), np.array([1.3])
    tip = ca.vertcat(beta * ca.sin(phi) - aim[0], beta * ca.cos(phi) - aim[1], 5 * (theta - aim[2]))
    base = Constraint("base", own, -limit, limit)
    if as_unknown:
        base = Constraint("base", own - x[3], np.zeros(1), np.zeros(1))
    bowl = Constraint("bowl", phi**2 + beta * theta / 5, np.array([-np.inf]), np.array([0.95]))
    low, high = np.array([-3.0, 0.5, -1.0]), np.array([3.0, 15.0, 1.0])
    if as_unknown:
        low, high = np.append(low, -limit), np.append(high, limit)
    pull = Residual("pull", tip)
    return Nlp("twisted", x, low, high, {"aim": aim}, (pull,), constraints=(base, bowl), picks=(3, 1, 2))


def bent(ends: bool = True, as_unknown: bool = False, frames: int = 6) -> Chain:
    """Twisted frames, drawn along a spiral, whose configurations are linked by steps and steps' steps."""
    nlp, u = twisted(as_unknown), np.linspace(0, 1, frames)
    before, after = ([configuration(end)] if ends else [] for end in (START, END))
    links = []
    for order, most in enumerate(MOST, start=1):
        known = before * order, after * (order - 1)
        matrix, offset, frame, axis = differences(frames, order, *known, 3)
        cost = COST / order**2
        links.append(FrameLink(f"order {order}", matrix, offset, -most[axis], most[axis], cost[axis], frame, axis))
    lower, upper = np.tile(nlp.lower, (frames, 1)), np.tile(nlp.upper, (frames, 1))
    if ends:
        lower[-1] = upper[-1] = np.append(END, configuration(END)[0]) if as_unknown else END
    to = np.stack([(4 + 8 * u) * np.sin(1.6 * u), (4 + 8 * u) * np.cos(1.6 * u), 0.4 * np.sin(5 * u)])
    axes = "alpha", "beta", "theta"
    return Chain(nlp, axes, np.array([2.0, 1.0, 5.0]), to, lower, upper, tuple(links), lambda: nlp.functions)
