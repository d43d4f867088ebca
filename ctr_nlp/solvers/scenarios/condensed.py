"""Derivatives of a shared motion with the scenarios' tips eliminated, as far as they are linear.

Every scenario of a frame has as many equations, alpha(phi_s, beta) = alpha + offset_s, as tips, so that about a
point a step of the tips is one of q: dphi_s = Z_s dq + c_s, where c_s makes good what the equations miss. What is
left of a Newton system then has the unknowns of q alone, however many scenarios there are. The tips themselves
stay unknowns: they need not keep their equations on the way, which near a fold is what lets a method move at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.codegen.mapped import Mapped
from ctr_nlp.nlp.scenarios import SharedMotion
from ctr_nlp.typing import Array


class Values(NamedTuple):
    """At a point. objective: mm^2; rows: q, the frames' rows, the links; missing (T, S, d): of the
    equations, rad.
    """

    objective: float
    rows: Array
    missing: Array


@dataclass(frozen=True)
class Expansion:
    """About a point. at: the values there. Of every scenario of every frame, with n unknowns x = (phi, beta,
    theta): gradient (T, S, n) and hessian (T, S, n, n) of the objective and, of the latter, of the Lagrangian; own
    (T, S, k, n): the Jacobian of its own rows; inverse (T, S, d, d): of the equations' over phi; turns (T, S, n,
    n): dx over dq; repair (T, S, n): the c of dx. Of the frames: jacobian (T, m, n) of the rows over q, and ahead
    (T, m): what the repair changes them by.
    """

    at: Values
    gradient: Array
    hessian: Array
    own: Array
    inverse: Array
    turns: Array
    repair: Array
    jacobian: Array
    ahead: Array

    def over_q(self, of_x: Array) -> Array:
        """A gradient (T, S, n) over the scenarios' unknowns as one over q, (T, n)."""
        return np.asarray((self.turns.swapaxes(-1, -2) @ of_x[..., None])[..., 0].sum(axis=1))

    def quadratic(self, damping: float) -> tuple[Array, Array]:
        """The Hessian (T, n, n) over q, and what the repair adds to the gradient (T, n); damping: added to every
        second derivative over q and over tips.
        """
        d, turns = self.inverse.shape[-1], self.turns
        curved = self.hessian @ turns
        bent = (self.hessian @ self.repair[..., None])[..., 0]
        if damping:
            curved[..., :d, :] += damping * turns[..., :d, :]
            bent[..., :d] += damping * self.repair[..., :d]
        found = (turns.swapaxes(-1, -2) @ curved).sum(axis=1)
        return found + damping * np.eye(found.shape[-1]), self.over_q(bent)

    def step(self, dq: Array) -> Array:
        """The step (T, S, n) of the scenarios' unknowns that belongs to one of q, (T, n)."""
        return np.asarray((self.turns @ dq[:, None, :, None])[..., 0] + self.repair)

    def multipliers(self, rows: Array, step: Array | None = None, damping: float = 0.0) -> Array:
        """Of the equations, (T, S, d): those at which tips are stationary, after a step where there is one.

        rows: multipliers (T, m) of the frames' rows.
        """
        count, d = self.inverse.shape[1], self.inverse.shape[-1]
        k = self.own.shape[2]
        own = rows[:, : count * k].reshape(len(rows), count, k, 1)
        slope = self.gradient[..., :d] + (self.own[..., :d].swapaxes(-1, -2) @ own)[..., 0]
        apart = rows[:, count * k : count * k + (count - 1) * (d - 1)].reshape(len(rows), count - 1, d - 1)
        slope[:, 1:, : d - 1] += apart
        slope[:, 0, : d - 1] -= apart.sum(axis=1)
        if step is not None:
            slope += (self.hessian[..., :d, :] @ step[..., None])[..., 0] + damping * step[..., :d]
        return np.asarray(-(self.inverse.swapaxes(-1, -2) @ slope[..., None])[..., 0])


class Condensed:
    """Values and derivatives of a shared motion. Not from two threads at once."""

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare."""
        functions, scenarios = motion.functions(), motion.scenarios
        self.motion, self.linking = motion, motion.linking
        self._maps = [Mapped(each, len(motion.parameters), functions.lanes) for each in functions[:3]]
        for each in self._maps:
            each.inputs[1][:] = motion.parameters
        self._offsets, self._shares = scenarios.offsets, np.tile(motion.weights, len(motion.lower))
        self.link_weight, self._link_offset = motion.of_links("weight"), motion.of_links("offset")
        bounds = zip((motion.lower, motion.upper), motion.row_bounds, ("lower", "upper"), strict=True)
        self.lower, self.upper = (
            np.concatenate([of_q.ravel(), rows.ravel(), motion.of_links(name)]) for of_q, rows, name in bounds
        )

    def value(self, q: Array, phi: Array) -> Values:
        """At q (T, n) and phi (T, S, d)."""
        f, g = self._maps[0](self.motion.unknowns(q, phi).ravel())
        return self._values(q, phi, f, g)

    def look(self, q: Array, phi: Array, settled: float = 0.0) -> bool:
        """Describe what surrounds the robots as it is near to a point; whether that changes the objective there,
        robot by robot, by more than this part. Where it does not, what was described stays.
        """
        motion, parameters = self.motion, self._maps[0].inputs[1]
        if motion.surroundings is None:
            return False
        x, known = motion.unknowns(q, phi), parameters.copy()
        before = self._maps[0](x.ravel())[0].ravel().copy()
        for name, value in motion.surroundings(x).items():
            columns = value.reshape(len(known), *value.shape[2:], *(1,) * (4 - value.ndim))
            parameters[:, motion.frame.place(name)] = columns.transpose(0, 2, 1).reshape(len(known), -1)
        after = self._maps[0](x.ravel())[0].ravel()
        changed = self._shares @ abs(after - before) > settled * (1 + self._shares @ abs(before))
        for each in self._maps:
            each.inputs[1][:] = parameters if changed else known
        return bool(changed)

    def by_robot(self, q: Array, phi: Array) -> Array:
        """The objective of every robot in every frame, without links, (T, S) mm^2."""
        f, _ = self._maps[0](self.motion.unknowns(q, phi).ravel())
        return np.array(f.reshape(len(q), -1))

    def by_frame(self, q: Array, phi: Array) -> Array:
        """What each frame adds to the objective, with the links that end at it, (T,) mm^2."""
        found = self.by_robot(q, phi) @ self.motion.weights
        linked = self.linking @ q.ravel() + self._link_offset
        np.add.at(found, np.concatenate([link.frame for link in self.motion.links]), self.link_weight * linked**2)
        return np.asarray(found)

    def expand(self, q: Array, phi: Array, equations: Array, rows: Array) -> Expansion:
        """About q and phi, with multipliers of the equations (T, S, d) and of the frames' rows (T, m)."""
        motion = self.motion
        frames, count, n, d = motion.sizes
        own, common = motion.own_rows, motion.common_rows
        pulls = np.zeros((frames, count, motion.frame.g.numel()))
        pulls[..., :d] = equations
        pulls[..., own] = rows[:, : count * len(own)].reshape(frames, count, -1)
        pulls[:, 0, common] = rows[:, rows.shape[1] - len(common) :]
        x = motion.unknowns(q, phi).ravel()
        f, gradient, g, jacobian, hessian = self._maps[2](x, self._shares, pulls.ravel())
        at, shape = self._values(q, phi, f, g), (frames, count, n, n)
        slopes = jacobian.reshape(frames, count, n, -1).swapaxes(-1, -2)
        inverse: Array = np.linalg.inv(slopes[..., :d, :d]).astype(float)
        turns = np.zeros(shape)
        turns[..., :d, :d], turns[..., :d, d:] = inverse, -inverse @ slopes[..., :d, d:]
        turns[..., range(d, n), range(d, n)] = 1.0
        repair = np.zeros((frames, count, n))
        repair[..., :d] = -(inverse @ at.missing[..., None])[..., 0]
        of_own = slopes[..., own, :]
        tips = turns[:, 1:, : d - 1] - turns[:, :1, : d - 1]
        moved = repair[:, 1:, : d - 1] - repair[:, :1, : d - 1]
        parts = [of_own @ turns, tips, slopes[:, 0, common, :]]
        ahead = [(of_own @ repair[..., None])[..., 0], moved, np.zeros((frames, len(common)))]
        return Expansion(
            at,
            gradient.reshape(frames, count, n) * motion.weights[:, None],
            hessian.reshape(shape),
            of_own,
            inverse,
            turns,
            repair,
            np.concatenate([part.reshape(frames, -1, n) for part in parts], axis=1),
            np.concatenate([part.reshape(frames, -1) for part in ahead], axis=1),
        )

    def _values(self, q: Array, phi: Array, f: Array, g: Array) -> Values:
        frames, count, _, d = self.motion.sizes
        each = g.reshape(frames, count, -1)
        own, tips = each[..., self.motion.own_rows], phi[:, 1:, : d - 1] - phi[:, :1, : d - 1]
        rows = [part.reshape(frames, -1) for part in (own, tips, each[:, 0, self.motion.common_rows])]
        linked = self.linking @ q.ravel() + self._link_offset
        counted = self._shares > 0  # others may be anywhere on the way
        objective = float(self._shares[counted] @ f.ravel()[counted] + self.link_weight @ linked**2)
        value = np.concatenate([q.ravel(), np.concatenate(rows, axis=1).ravel(), linked])
        return Values(objective, value, each[..., :d] - q[:, None, :d] - self._offsets)
