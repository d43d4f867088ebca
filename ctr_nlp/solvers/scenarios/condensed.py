"""Derivatives of a shared motion with the scenarios' tips eliminated, to first order.

In every frame, scenario s has as many equations c(phi_s, q) = alpha(phi_s, beta) - alpha - offset_s = 0 (rad), and
under a load those of its base beside them, as it has tip unknowns phi_s. Linearised about a point, with A =
(dc/dphi)^-1,

    dphi_s = Z_s dq + c_s,     Z_s = -A dc/dq,     c_s = -A c    (the repair: it removes the equations' residual).

The remaining Newton system has the unknowns of q alone, Z' H Z, however many scenarios there are. The tips
themselves stay unknowns: they need not satisfy their equations at every iterate. Near a fold of the equilibria,
where A is large, steps of q would otherwise be tiny. Where frames have unknowns p in common, these stand beside q:
dphi_s = Z_s dq + W_s dp + c_s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.ocp.scenarios import SharedMotion
from ctr_nlp.solvers.scenarios.common import NO_COMMON_UNKNOWNS, CommonDerivatives, CommonQuantities, CommonValues
from ctr_nlp.solvers.scenarios.grouped_evaluator import FAR_WALL_COST_MM2, GroupedEvaluator
from ctr_nlp.solvers.scenarios.twists import TwistSteps
from ctr_nlp.typing import Array, Index


class Values(NamedTuple):
    """Values of a shared motion at a point.

    objective: mm^2; rows: q, the frames' rows, the links, steps of twists, p, p's own rows, in this order;
    equation_residuals (T, S, k): rad.
    """

    objective: float
    rows: Array
    equation_residuals: Array


@dataclass(frozen=True)
class Expansion:
    """Derivatives of a shared motion about a point.

    at: the values there. Of every scenario of every frame, with m unknowns x (phi, beta, theta, and what p gives):
    gradient (T, S, m) of the objective and hessian (T, S, m, m) of the Lagrangian; own (T, S, c, m): the Jacobian
    of its own rows; inverse (T, S, k, k): of the equations' Jacobian over phi; tips (k,): indices of phi among a
    robot's unknowns; unknowns_jacobian (T, S, m, n + P): dx over (dq, dp); repair (T, S, m): the constant part c
    of dx. Of the frames: jacobian (T, r, n + P) of the rows over q and p, and row_repair (T, r): their change by
    the repair; twists (T, d - 1, n + P): slopes of the first scenario's twists. common_derivatives: derivatives
    over p alone.
    """

    at: Values
    tips: Index
    gradient: Array
    hessian: Array
    own: Array
    inverse: Array
    unknowns_jacobian: Array
    repair: Array
    jacobian: Array
    row_repair: Array
    twists: Array
    common_derivatives: CommonDerivatives

    def over_q(self, of_x: Array) -> Array:
        """Convert a gradient over the scenarios' unknowns to one over q and p, (T, n + P), summed over scenarios.

        of_x: (T, S, m).
        """
        return np.asarray((self.unknowns_jacobian.swapaxes(-1, -2) @ of_x[..., None])[..., 0].sum(axis=1))

    def quadratic(self, damping: float) -> tuple[Array, Array]:
        """Return the Hessian over q and p, (T, n + P, n + P), and the repair's part of the gradient, (T, n + P).

        damping: added to every second derivative over q and over tips. Second derivatives over p alone are not
        included (common_derivatives).
        """
        tips = self.tips
        turns = self.unknowns_jacobian
        # With dx = Z du + c, the quadratic model dx' H dx / 2 has the Hessian Z' H Z and the extra slope Z'
        # H c.
        curved = self.hessian @ turns
        bent = (self.hessian @ self.repair[..., None])[..., 0]
        if damping:
            curved[..., tips, :] += damping * turns[..., tips, :]
            bent[..., tips] += damping * self.repair[..., tips]
        found = (turns.swapaxes(-1, -2) @ curved).sum(axis=1)
        n = found.shape[-1] - self.common_derivatives.hessian.shape[-1]
        # On q itself as well as on tips: near a fold tips turn far for little turns of motors, and damping
        # of the tips is what keeps such steps short.
        found[:, range(n), range(n)] += damping
        return found, self.over_q(bent)

    def step(self, dq: Array) -> Array:
        """Return the step (T, S, m) of the scenarios' unknowns that belongs to a step dq of q and
        p, (T, n + P).
        """
        return np.asarray((self.unknowns_jacobian @ dq[:, None, :, None])[..., 0] + self.repair)

    def multipliers(self, rows: Array, turned: Array, step: Array | None = None, damping: float = 0.0) -> Array:
        """Return the equations' multipliers (T, S, k) at which the Lagrangian is stationary over the tips.

        rows: multipliers (T, m) of the frames' rows; turned (T, d - 1): pull of the twists' multipliers on the
        first robot's tips. step (T, S, m): a step after which it is to be stationary, with its damping; None for
        the point itself.
        """
        (count, size), tips, relative = self.own.shape[1:3], self.tips, turned.shape[1]
        own = rows[:, : count * size].reshape(len(rows), count, size, 1)
        # Stationarity over phi: gradient_phi + own_phi' lam + (dc/dphi)' y = 0, so y = -A' (the rest), A =
        # (dc/dphi)^-1.
        slope = self.gradient[..., tips] + (self.own[..., tips].swapaxes(-1, -2) @ own)[..., 0]
        others = rows[:, count * size : count * size + (count - 1) * relative]
        # Rows phi_s - phi_1 pull scenario s by their multipliers, and the first scenario by minus their
        # sum.
        apart = others.reshape(len(rows), count - 1, relative)
        slope[:, 1:, :relative] += apart
        slope[:, 0, :relative] += turned - apart.sum(axis=1)
        if step is not None:
            slope += (self.hessian[..., tips, :] @ step[..., None])[..., 0] + damping * step[..., tips]
        return np.asarray(-(self.inverse.swapaxes(-1, -2) @ slope[..., None])[..., 0])


class Condensed:
    """Values and derivatives of a shared motion with eliminated tips. Not from two threads at once."""

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare."""
        self.motion = motion
        self.linking = motion.linking
        self._evaluated = GroupedEvaluator(motion)
        self._offsets = motion.offsets
        self._shares = np.tile(motion.weights, len(motion.lower))
        self.common = CommonValues(motion)
        self.twists = TwistSteps(motion)
        self.link_weight = motion.of_links("weight")
        self._link_offset = motion.of_links("offset")
        of_q = (motion.lower, motion.upper)
        names = ("lower", "upper")
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

    def value(self, q: Array, phi: Array, p: Array = NO_COMMON_UNKNOWNS) -> Values:
        """Return the values at q (T, n), phi (T, S, k) and p (P,)."""
        given = self.common(p)
        f, g = self._evaluated(0, self.motion.unknowns(q, phi, given.values))
        return self._values(q, phi, p, given, f, g)

    def update_local_parameters(
        self, q: Array, phi: Array, p: Array = NO_COMMON_UNKNOWNS, relative_tolerance: float = 0.0
    ) -> bool:
        """Linearise local parameters (of walls) at a point; return True if that changes the objective there.

        q (T, n), phi (T, S, k), p (P,): the point. relative_tolerance: the objective's change, added up robot by
        robot, is compared with this part of 1 + the objective. Where it is smaller, the former parameters stay,
        and the result is False.
        """
        motion = self.motion
        evaluated = self._evaluated
        if motion.local_parameters is None:
            return False
        x = motion.unknowns(q, phi, self.common(p).values)
        parameters = evaluated.parameters
        known = parameters.copy()
        far = evaluated.far
        before = evaluated(0, x)[0].ravel().copy()
        for name, value in motion.local_parameters(x).items():
            # Parameters are packed column by column: a matrix (rows, columns) a robot becomes (columns,
            # rows) and then a row.
            columns = value.reshape(len(known), *value.shape[2:], *(1,) * (4 - value.ndim))
            parameters[:, motion.frame.parameter_slice(name)] = columns.transpose(0, 2, 1).reshape(len(known), -1)
        evaluated.regroup(far if motion.without_wall is None else evaluated.contact_costs(x) <= FAR_WALL_COST_MM2)
        after = evaluated(0, x)[0].ravel()
        # Sizes, not the sum: changes of opposite sign on two robots would cancel.
        changed = self._shares @ abs(after - before) > relative_tolerance * (1 + self._shares @ abs(before))
        if not changed:
            parameters[:] = known
            evaluated.regroup(far)
        return bool(changed)

    def by_robot(self, q: Array, phi: Array, p: Array = NO_COMMON_UNKNOWNS) -> Array:
        """Return the objective of every robot in every frame, without links, (T, S) mm^2, at q (T, n), phi (T, S,
        k) and p (P,).
        """
        f, _ = self._evaluated(0, self.motion.unknowns(q, phi, self.common(p).values))
        return np.array(f.reshape(len(q), -1))

    def by_frame(self, q: Array, phi: Array) -> Array:
        """Return each frame's part of the objective at q (T, n) and phi (T, S, k), with links that end at it, (T,)
        mm^2.
        """
        found = self.by_robot(q, phi) @ self.motion.weights
        linked = self.linking @ q.ravel() + self._link_offset
        np.add.at(found, np.concatenate([link.frame for link in self.motion.links]), self.link_weight * linked**2)
        return np.asarray(found)

    def expand(
        self,
        q: Array,
        phi: Array,
        equations: Array,
        rows: Array,
        p: Array = NO_COMMON_UNKNOWNS,
        of_p: Array = NO_COMMON_UNKNOWNS,
    ) -> Expansion:
        """Return the derivatives at q (T, n), phi (T, S, k) and p (P,).

        equations (T, S, k), rows (T, r), of_p (c,): multipliers of the equations, of the frames' rows, and of p's
        own.
        """
        motion = self.motion
        given = self.common(p)
        frames, count, n, d = motion.sizes
        tips = motion.own
        own = motion.own_rows
        common = motion.common_rows
        k = len(tips)
        robot = len(tips) + len(motion.shared_entries)
        m = robot + given.values.shape[1]
        # Multipliers of each robot's g, in the order of the frame's program: equations, own rows, and
        # common rows, which are counted with the first robot alone.
        pulls = np.zeros((frames, count, motion.frame.g.numel()))
        pulls[..., :k] = equations
        pulls[..., own] = rows[:, : count * len(own)].reshape(frames, count, -1)
        pulls[:, 0, common] = rows[:, rows.shape[1] - len(common) :]
        x = motion.unknowns(q, phi, given.values)
        f, gradient, g, jacobian, hessian = self._evaluated(2, x, self._shares, pulls)
        at = self._values(q, phi, p, given, f, g)
        gradient = gradient.reshape(frames, count, m) * motion.weights[:, None]
        # Jacobians come by columns: (m, rows) of each robot, transposed to (rows, m).
        slopes = jacobian.reshape(frames, count, m, -1).swapaxes(-1, -2)
        # dL/dy of the further unknowns y that p gives (the robot's last entries), for the curvature of
        # y(p).
        pulled = gradient[..., robot:] + (slopes[..., robot:].swapaxes(-1, -2) @ pulls[..., None])[..., 0]
        of_given = self.common.slopes(p, pulled.sum(axis=0), of_p)
        inverse: Array = np.linalg.inv(slopes[..., :k, tips]).astype(float)
        # dx over (q, p): beta and theta are q's own entries from d on, further unknowns follow p, tips
        # follow both.
        turns = np.zeros((frames, count, m, n + len(p)))
        turns[..., motion.shared_entries, range(d, n)] = 1.0
        turns[..., robot:, n:] = of_given.values
        # dphi over (beta, theta, p) = -A dc/d(beta, theta, p). alpha enters c as -alpha, so dphi/dalpha =
        # A's first d columns.
        turned = -inverse @ (slopes[..., :k, :] @ turns)
        turned[..., :d] = inverse[..., :d]
        turns[..., tips, :] = turned
        repair = np.zeros((frames, count, m))
        repair[..., tips] = -(inverse @ at.equation_residuals[..., None])[..., 0]
        of_own = slopes[..., own, :]
        # The first d - 1 tips are relative to the innermost tube's; the innermost one's turn moves the
        # robot as a whole and need not agree between scenarios.
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

    def _values(self, q: Array, phi: Array, p: Array, given: CommonQuantities, f: Array, g: Array) -> Values:
        """Return the values from the results f, g of all robots' programs."""
        frames, count, _, d = self.motion.sizes
        each = g.reshape(frames, count, -1)
        own = each[..., self.motion.own_rows]
        apart = phi[:, 1:, : d - 1] - phi[:, :1, : d - 1]
        rows = [part.reshape(frames, -1) for part in (own, apart, each[:, 0, self.motion.common_rows])]
        linked = self.linking @ q.ravel() + self._link_offset
        # A robot without weight may have no finite objective, and 0 times that is not 0.
        counted = self._shares > 0
        objective = float(self._shares[counted] @ f.ravel()[counted] + self.link_weight @ linked**2) + given.cost
        of_frames = np.concatenate(rows, axis=1).ravel()
        twists = self.twists.values(q, phi)
        value = np.concatenate([q.ravel(), of_frames, linked, twists, p, given.rows])
        return Values(objective, value, self._missing(each, q))

    def _missing(self, rows: Array, q: Array) -> Array:
        """Return the residuals (T, S, k) of the equations of tips, from rows (T, S, m) of the frames, at q (T, n).

        Where the tip's axes are unknowns, angles of motors are known only up to whole turns of all tubes together.
        """
        k = len(self.motion.own)
        d = self.motion.d
        found = rows[..., :k].copy()
        found[..., :d] -= q[:, None, :d] + self._offsets
        if k > d:
            # The innermost tube's residual gives the number of whole turns of the robot, which all tubes
            # share.
            found[..., :d] -= 2 * np.pi * np.round(found[..., d - 1 : d] / (2 * np.pi))
        return np.asarray(found)
