"""Derivatives of a shared motion with the scenarios' tips eliminated, as far as they are linear.

Every scenario of a frame has as many equations, alpha(phi_s, beta) = alpha + offset_s and under a load those of
its base beside them, as its tips have unknowns, so that about a point a step of the tips is one of q:
dphi_s = Z_s dq + c_s, where c_s makes good what the equations miss. What is
left of a Newton system then has the unknowns of q alone, however many scenarios there are. The tips themselves
stay unknowns: they need not keep their equations on the way, which near a fold is what lets a method move at all.
Where frames have unknowns p in common, these stand beside q: dphi_s = Z_s dq + W_s dp + c_s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.nlp.scenarios import SharedMotion
from ctr_nlp.solvers.scenarios.common import NONE, CommonValues, Given, GivenSlopes
from ctr_nlp.solvers.scenarios.grouped import FAR_COST, Grouped
from ctr_nlp.solvers.scenarios.twists import TwistSteps
from ctr_nlp.typing import Array, Index


class Values(NamedTuple):
    """At a point. objective: mm^2; rows: q, the frames' rows, the links, steps of twists, p, p's own rows;
    missing (T, S, k): of the equations, rad.
    """

    objective: float
    rows: Array
    missing: Array


@dataclass(frozen=True)
class Expansion:
    """About a point. at: the values there. Of every scenario of every frame, with m unknowns x (phi, beta,
    theta, what p gives): gradient (T, S, m) and hessian (T, S, m, m) of the objective and, of the latter, of the
    Lagrangian; own (T, S, c, m): the Jacobian of its own rows; inverse (T, S, k, k): of the equations' over phi,
    whose places (k,) among a robot's unknowns are tips; turns (T, S, m, n + P): dx over (dq, dp); repair
    (T, S, m): the c of dx. Of the frames: jacobian (T, r, n + P)
    of the rows over q and p, and ahead (T, r): what the repair changes them by; twists (T, d - 1, n + P): that of
    the first scenario's twists. given: of p alone.
    """

    at: Values
    tips: Index
    gradient: Array
    hessian: Array
    own: Array
    inverse: Array
    turns: Array
    repair: Array
    jacobian: Array
    ahead: Array
    twists: Array
    given: GivenSlopes

    def over_q(self, of_x: Array) -> Array:
        """A gradient (T, S, m) over the scenarios' unknowns as one over q and p, (T, n + P)."""
        return np.asarray((self.turns.swapaxes(-1, -2) @ of_x[..., None])[..., 0].sum(axis=1))

    def quadratic(self, damping: float) -> tuple[Array, Array]:
        """The Hessian (T, n + P, n + P) over q and p, but for what p adds by itself, and what the repair adds to
        the gradient (T, n + P); damping: added to every second derivative over q and over tips.
        """
        tips, turns = self.tips, self.turns
        curved = self.hessian @ turns
        bent = (self.hessian @ self.repair[..., None])[..., 0]
        if damping:
            curved[..., tips, :] += damping * turns[..., tips, :]
            bent[..., tips] += damping * self.repair[..., tips]
        found = (turns.swapaxes(-1, -2) @ curved).sum(axis=1)
        n = found.shape[-1] - self.given.hessian.shape[-1]
        found[:, range(n), range(n)] += damping
        return found, self.over_q(bent)

    def step(self, dq: Array) -> Array:
        """The step (T, S, m) of the scenarios' unknowns that belongs to one of q and p, (T, n + P)."""
        return np.asarray((self.turns @ dq[:, None, :, None])[..., 0] + self.repair)

    def multipliers(self, rows: Array, turned: Array, step: Array | None = None, damping: float = 0.0) -> Array:
        """Of the equations, (T, S, k): those at which tips are stationary, after a step where there is one.

        rows: multipliers (T, m) of the frames' rows; turned (T, d - 1): what those of twists pull the first
        robot's tips with.
        """
        (count, size), tips, relative = self.own.shape[1:3], self.tips, turned.shape[1]
        own = rows[:, : count * size].reshape(len(rows), count, size, 1)
        slope = self.gradient[..., tips] + (self.own[..., tips].swapaxes(-1, -2) @ own)[..., 0]
        others = rows[:, count * size : count * size + (count - 1) * relative]
        apart = others.reshape(len(rows), count - 1, relative)
        slope[:, 1:, :relative] += apart
        slope[:, 0, :relative] += turned - apart.sum(axis=1)
        if step is not None:
            slope += (self.hessian[..., tips, :] @ step[..., None])[..., 0] + damping * step[..., tips]
        return np.asarray(-(self.inverse.swapaxes(-1, -2) @ slope[..., None])[..., 0])


class Condensed:
    """Values and derivatives of a shared motion. Not from two threads at once."""

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare."""
        self.motion, self.linking = motion, motion.linking
        self._evaluated = Grouped(motion)
        self._offsets, self._shares = motion.offsets, np.tile(motion.weights, len(motion.lower))
        self.common, self.twists = CommonValues(motion), TwistSteps(motion)
        self.link_weight, self._link_offset = motion.of_links("weight"), motion.of_links("offset")
        of_q, names = (motion.lower, motion.upper), ("lower", "upper")
        bounds = zip(of_q, motion.row_bounds, self.twists.bounds, names, strict=True)
        self.lower, self.upper = (
            np.concatenate(
                [
                    *(of_q.ravel(), rows.ravel(), motion.of_links(name), twists),
                    *(getattr(self.common, each) for each in (name, f"row_{name}")),
                ]
            )
            for of_q, rows, twists, name in bounds
        )

    def value(self, q: Array, phi: Array, p: Array = NONE) -> Values:
        """At q (T, n), phi (T, S, k) and p (P,)."""
        given = self.common(p)
        f, g = self._evaluated(0, self.motion.unknowns(q, phi, given.values))
        return self._values(q, phi, p, given, f, g)

    def look(self, q: Array, phi: Array, p: Array = NONE, settled: float = 0.0) -> bool:
        """Describe what surrounds the robots as it is near to a point; whether that changes the objective there,
        robot by robot, by more than this part. Where it does not, what was described stays.
        """
        motion, evaluated = self.motion, self._evaluated
        if motion.surroundings is None:
            return False
        x, parameters = motion.unknowns(q, phi, self.common(p).values), evaluated.parameters
        known, far = parameters.copy(), evaluated.far
        before = evaluated(0, x)[0].ravel().copy()
        for name, value in motion.surroundings(x).items():
            columns = value.reshape(len(known), *value.shape[2:], *(1,) * (4 - value.ndim))
            parameters[:, motion.frame.place(name)] = columns.transpose(0, 2, 1).reshape(len(known), -1)
        evaluated.regroup(far if motion.free is None else evaluated.contact_costs(x) <= FAR_COST)
        after = evaluated(0, x)[0].ravel()
        changed = self._shares @ abs(after - before) > settled * (1 + self._shares @ abs(before))
        if not changed:
            parameters[:] = known
            evaluated.regroup(far)
        return bool(changed)

    def by_robot(self, q: Array, phi: Array, p: Array = NONE) -> Array:
        """The objective of every robot in every frame, without links, (T, S) mm^2."""
        f, _ = self._evaluated(0, self.motion.unknowns(q, phi, self.common(p).values))
        return np.array(f.reshape(len(q), -1))

    def by_frame(self, q: Array, phi: Array) -> Array:
        """What each frame adds to the objective, with the links that end at it, (T,) mm^2."""
        found = self.by_robot(q, phi) @ self.motion.weights
        linked = self.linking @ q.ravel() + self._link_offset
        np.add.at(found, np.concatenate([link.frame for link in self.motion.links]), self.link_weight * linked**2)
        return np.asarray(found)

    def expand(
        self, q: Array, phi: Array, equations: Array, rows: Array, p: Array = NONE, of_p: Array = NONE
    ) -> Expansion:
        """About q, phi and p, with multipliers of the equations (T, S, k), of the frames' rows (T, r), and of p's
        own rows, of_p (c,).
        """
        motion, given = self.motion, self.common(p)
        frames, count, n, d = motion.sizes
        tips, own, common = motion.own, motion.own_rows, motion.common_rows
        k, robot = len(tips), len(tips) + len(motion.held)
        m = robot + given.values.shape[1]
        pulls = np.zeros((frames, count, motion.frame.g.numel()))
        pulls[..., :k] = equations
        pulls[..., own] = rows[:, : count * len(own)].reshape(frames, count, -1)
        pulls[:, 0, common] = rows[:, rows.shape[1] - len(common) :]
        x = motion.unknowns(q, phi, given.values)
        f, gradient, g, jacobian, hessian = self._evaluated(2, x, self._shares, pulls)
        at = self._values(q, phi, p, given, f, g)
        gradient = gradient.reshape(frames, count, m) * motion.weights[:, None]
        slopes = jacobian.reshape(frames, count, m, -1).swapaxes(-1, -2)
        pulled = gradient[..., robot:] + (slopes[..., robot:].swapaxes(-1, -2) @ pulls[..., None])[..., 0]
        of_given = self.common.slopes(p, pulled.sum(axis=0), of_p)
        inverse: Array = np.linalg.inv(slopes[..., :k, tips]).astype(float)
        turns = np.zeros((frames, count, m, n + len(p)))
        turns[..., motion.held, range(d, n)] = 1.0
        turns[..., robot:, n:] = of_given.values
        turned = -inverse @ (slopes[..., :k, :] @ turns)
        turned[..., :d] = inverse[..., :d]
        turns[..., tips, :] = turned
        repair = np.zeros((frames, count, m))
        repair[..., tips] = -(inverse @ at.missing[..., None])[..., 0]
        of_own = slopes[..., own, :]
        apart = turns[:, 1:, : d - 1] - turns[:, :1, : d - 1]
        moved = repair[:, 1:, : d - 1] - repair[:, :1, : d - 1]
        parts = [of_own @ turns, apart, slopes[:, 0, common, :] @ turns[:, 0]]
        ahead = [(of_own @ repair[..., None])[..., 0], moved, np.zeros((frames, len(common)))]
        return Expansion(
            at,
            tips,
            gradient,
            hessian.reshape(frames, count, m, m),
            of_own,
            inverse,
            turns,
            repair,
            np.concatenate([part.reshape(frames, -1, n + len(p)) for part in parts], axis=1),
            np.concatenate([part.reshape(frames, -1) for part in ahead], axis=1),
            self.twists.slopes(turns[:, 0]),
            of_given,
        )

    def _values(self, q: Array, phi: Array, p: Array, given: Given, f: Array, g: Array) -> Values:
        frames, count, _, d = self.motion.sizes
        each = g.reshape(frames, count, -1)
        own, apart = each[..., self.motion.own_rows], phi[:, 1:, : d - 1] - phi[:, :1, : d - 1]
        rows = [part.reshape(frames, -1) for part in (own, apart, each[:, 0, self.motion.common_rows])]
        linked = self.linking @ q.ravel() + self._link_offset
        counted = self._shares > 0  # others may be anywhere on the way
        objective = float(self._shares[counted] @ f.ravel()[counted] + self.link_weight @ linked**2) + given.cost
        of_frames, twists = np.concatenate(rows, axis=1).ravel(), self.twists.values(q, phi)
        value = np.concatenate([q.ravel(), of_frames, linked, twists, p, given.rows])
        return Values(objective, value, self._missing(each, q))

    def _missing(self, rows: Array, q: Array) -> Array:
        """By what rows (T, S, m) of the frames say that tips miss their equations at q (T, n), (T, S, k).

        Where the tip's axes are unknowns, angles of motors are known but for whole turns of all tubes together.
        """
        k, d = len(self.motion.own), self.motion.d
        found = rows[..., :k].copy()
        found[..., :d] -= q[:, None, :d] + self._offsets
        if k > d:
            found[..., :d] -= 2 * np.pi * np.round(found[..., d - 1 : d] / (2 * np.pi))
        return np.asarray(found)
