"""A point of a shared motion's barrier problem: its rows with slacks and multipliers, and its errors.

The barrier problem is that of solvers/motion/rows.py, rows r = s with l <= s <= u and a barrier in mm^2, with the
tips' equations (rad) beside the rows. Jacobians are those of condensed.py, over (q, p) with tips eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ctr_nlp.ocp.scenarios import SharedMotion, assemble_robot_unknowns
from ctr_nlp.solvers.barrier import BOUND_RELAXATION, INFINITE_BOUND
from ctr_nlp.solvers.frame.adapter import FEASIBILITY_TOLERANCE, KKT_TOLERANCE
from ctr_nlp.solvers.scenarios.common import NO_COMMON_UNKNOWNS
from ctr_nlp.solvers.scenarios.condensed import Condensed, Expansion, Values
from ctr_nlp.solvers.scenarios.filter import Merit
from ctr_nlp.solvers.scenarios.links import LinkBand
from ctr_nlp.typing import Array, Flags, Index

SHARED_SLACK_PUSH = 1e-2
"""How far slacks start within their bounds, rad or mm."""
MIN_BOUND_DISTANCE_FRACTION = 0.005
"""Part of its distance from a bound that a step leaves."""


@dataclass(frozen=True)
class SharedSolution:
    """A point of a shared motion: q (T, n), tips phi (T, S, k), the objective in mm^2, common unknowns p (P,).

    violation: of bounds; equation_violation: of the scenarios' equations; kkt: residual of all conditions of
    optimality, from the program itself. success: whether it is a solution. shared_entries (n - d,): indices of
    beta and theta among a robot's unknowns (SharedMotion). common_multipliers (c,): of p's own rows, mm^2 a unit,
    positive at upper bounds. constraint_multipliers (T, S): cost of the constraints of a robot in a frame, the sum
    of the absolute values of its multipliers, mm^2 a unit. rough: whether the solve was to end near a solution.
    """

    q: Array
    phi: Array
    objective: float
    violation: float
    equation_violation: float
    kkt: float
    status: str
    iterations: int
    shared_entries: Index
    p: Array = field(default_factory=lambda: NO_COMMON_UNKNOWNS)
    common_multipliers: Array = field(default_factory=lambda: NO_COMMON_UNKNOWNS)
    constraint_multipliers: Array = field(default_factory=lambda: NO_COMMON_UNKNOWNS)
    rough: bool = False

    @property
    def x(self) -> Array:
        """Unknowns (T, n) of the model for the first robot, without a tilt that is stored beside them."""
        return assemble_robot_unknowns(self.q, self.phi[:, :1], self.shared_entries)[:, 0, : self.q.shape[1]]

    @property
    def success(self) -> bool:
        """Whether this is a solution: all robots are in equilibrium and satisfy their rows, at a KKT point.

        After a rough solve: whether it ended as it should.
        """
        if self.rough:
            return self.status.startswith("Solve")
        return max(self.violation, self.equation_violation) <= FEASIBILITY_TOLERANCE and self.kkt <= KKT_TOLERANCE


@dataclass(frozen=True)
class SharedPoint:
    """Unknowns, slacks of all rows, and multipliers of their bounds and of the equations."""

    q: Array
    phi: Array
    p: Array
    slack: Array
    at_lower: Array
    at_upper: Array
    equations: Array

    @property
    def multipliers(self) -> Array:
        """Multipliers of all rows, positive at upper bounds."""
        return self.at_upper - self.at_lower


class BarrierErrors(NamedTuple):
    """Residuals of the barrier problem's conditions at a point.

    stationarity: of the Lagrangian, mm^2 per unit of q; infeasibility: by rows and equations, rad and mm; least,
    most: smallest and largest product of a slack's distance and its multiplier, mm^2.
    """

    stationarity: float
    infeasibility: float
    least: float
    most: float

    def residual(self, barrier: float) -> float:
        """Return the residual of the barrier problem, barrier in mm^2; with barrier 0, of the problem itself."""
        return max(self.stationarity, self.infeasibility, abs(self.least - barrier), abs(self.most - barrier))


class RowsByKind(NamedTuple):
    """A vector over all rows by kind: q (T, n), frames (T, m), links (l,), steps of twists (k,), p (P,), p's own
    (c,).
    """

    q: Array
    frames: Array
    links: Array
    twists: Array
    p: Array
    own: Array

    @property
    def as_vector(self) -> Array:
        """All kinds in one vector, in this order."""
        return np.concatenate([part.ravel() for part in self])


class SharedRows:
    """Rows of a shared motion: q itself, the frames' rows, the links, steps of twists, p itself, p's own rows.

    A step of q and p is one vector, q's entries first, (T n + P,); free: which of them may change.
    """

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare."""
        self.condensed = Condensed(motion)
        self.links = LinkBand(motion)
        common = self.condensed.common
        of_q = motion.lower < motion.upper
        of_p = common.lower < common.upper
        self.free: Flags = np.append(of_q.ravel(), of_p)
        frames, _, n, _ = motion.sizes
        lower = self.condensed.lower
        upper = self.condensed.upper
        self._shape = (frames, n)
        self._size = of_p.size
        self.twists = self.condensed.twists
        sizes = of_q.size, motion.row_bounds[0].size, len(self.links.weight), self.twists.bounds[0].size, of_p.size
        self._ends = np.cumsum(sizes)
        still = self._constant_rows(motion, of_q, of_p)
        # As in motion/rows.py: constant rows get no bounds, the others are relaxed by BOUND_RELAXATION.
        self.low = np.where(still | np.isinf(lower), -INFINITE_BOUND, lower - BOUND_RELAXATION)
        self.high = np.where(still | np.isinf(upper), INFINITE_BOUND, upper + BOUND_RELAXATION)
        self._bounds = np.where(still, -np.inf, lower), np.where(still, np.inf, upper)
        self._box = (motion.lower, motion.upper)
        self._common_box = (common.lower, common.upper)

    def _constant_rows(self, motion: SharedMotion, of_q: Flags, of_p: Flags) -> Flags:
        """Return which rows no free unknown changes: they get no bounds, which rounding could violate."""
        rows = np.ones(motion.row_bounds[0].shape, dtype=bool)
        if len(motion.common_rows):
            depends = motion.frame.g_depends[np.ix_(motion.common_rows, motion.shared_entries)]
            # Rows that depend on tips always change with these; common rows depend on beta and theta alone.
            rows[:, -len(motion.common_rows) :] = of_q[:, motion.d :] @ depends.T
        links = abs(motion.linking) @ of_q.ravel() > 0
        own = np.full(len(self.condensed.common.row_lower), of_p.any())
        parts = of_q, rows, links, self.condensed.twists.free(of_q), of_p, own
        return ~np.concatenate([part.ravel() for part in parts])

    def start(self, q: Array, phi: Array, p: Array, barrier: float) -> SharedPoint:
        """Return a point at q (T, n), phi (T, S, k) and p (P,), with slacks within their bounds and multipliers
        for a barrier, mm^2.
        """
        q = np.clip(q, *self._box)
        p = np.clip(p, *self._common_box)
        rows = self.condensed.value(q, phi, p).rows
        # As in motion/rows.py: at most a tenth of the room between two bounds.
        within = np.minimum(SHARED_SLACK_PUSH, 0.1 * (self.high - self.low))
        slack = np.clip(rows, self.low + within, self.high - within)
        # On the central path: z (s - l) = mu.
        pulls = barrier / (slack - self.low), barrier / (self.high - slack)
        return SharedPoint(q, np.array(phi), p, slack, *pulls, np.zeros(phi.shape))

    def expand(self, point: SharedPoint) -> Expansion:
        """Return the derivatives at a point."""
        return self._expand_at(point, point.q, point.p)

    def _expand_at(self, point: SharedPoint, q: Array, p: Array) -> Expansion:
        rows = self.split(point.multipliers)
        return self.condensed.expand(q, point.phi, point.equations, rows.frames, p, rows.own)

    def split(self, rows: Array) -> RowsByKind:
        """Split a vector over all rows by kind."""
        of_q, of_frames, *others = np.split(rows, self._ends)
        return RowsByKind(of_q.reshape(self._shape), of_frames.reshape(self._shape[0], -1), *others)

    def equations(self, about: Expansion, rows: Array, step: Array | None = None, damping: float = 0.0) -> Array:
        """Return the equations' multipliers (T, S, k) for given ones of all rows, rows (Expansion.multipliers).

        about: the expansion; step, damping: a step after which the Lagrangian is to be stationary over tips.
        """
        parts = self.split(rows)
        return about.multipliers(parts.frames, self.twists.of_tips(parts.twists), step, damping)

    def by_frame(self, step: Array) -> Array:
        """Return for every frame its own part of a step (T n + P,): that of its q, and that of p, (T, n + P)."""
        of_q, of_p = np.split(step, [step.size - self._size])
        frames = self._shape[0]
        return np.concatenate([of_q.reshape(self._shape), np.broadcast_to(of_p, (frames, of_p.size))], axis=1)

    def sum_over_frames(self, of_frames: Array) -> Array:
        """Join slopes of_frames (T, n + P) of all frames into one vector (T n + P,), with p's parts added up."""
        n = self._shape[1]
        return np.append(of_frames[:, :n].ravel(), of_frames[:, n:].sum(axis=0))

    def multiply_transposed_jacobian(self, about: Expansion, rows: Array) -> Array:
        """Return the transposed Jacobian of all rows over (q, p), times a vector `rows`: (T n + P,).

        about: the expansion with the Jacobian.
        """
        parts = self.split(rows)
        # Frames' rows reach q and p through tips, too: about.jacobian has these eliminated.
        through = (about.jacobian.swapaxes(1, 2) @ parts.frames[..., None])[..., 0]
        through += self.twists.multiply_transposed_jacobian(about.twists, parts.twists)
        # Rows q and p have unit Jacobians; links and p's own rows depend on q and p without tips.
        direct = (
            parts.q + self.links.multiply_transposed_jacobian(parts.links),
            parts.p + about.common_derivatives.rows.T @ parts.own,
        )
        return self.sum_over_frames(through) + np.append(*direct)

    def linearised_change(self, about: Expansion, step: Array) -> Array:
        """Return the change of all rows by a step (T n + P,) of q and p, including that by the equations' repair.

        about: the expansion at the point.
        """
        of_frames = self.by_frame(step)
        through = (about.jacobian @ of_frames[..., None])[..., 0]
        dq, dp = np.split(step, [step.size - self._size])
        twists = self.twists.multiply_jacobian(about.twists, of_frames)
        direct = RowsByKind(
            dq, through, self.links.multiply_jacobian(dq), twists, dp, about.common_derivatives.rows @ dp
        )
        return direct.as_vector + self.change_by_repair(about)

    def change_by_repair(self, about: Expansion) -> Array:
        """Return the change of all rows by the equations' repair alone, at fixed q and p; about: the expansion."""
        none = self.split(np.zeros(len(self.low)))
        twists = self.twists.change_by_repair(about.repair[:, 0])
        return none._replace(frames=about.row_repair, twists=twists).as_vector

    def own_slope(self, about: Expansion) -> Array:
        """Return the gradient (T n + P,) of the links' costs and of p's own cost; about: the expansion."""
        return np.append(self.links.slope(self.split(about.at.rows).links), about.common_derivatives.cost)

    def slope(self, about: Expansion) -> Array:
        """Return the gradient (T n + P,) of the objective, with tips as functions of q and p; about: the
        expansion.
        """
        return self.sum_over_frames(about.over_q(about.gradient)) + self.own_slope(about)

    def errors(self, point: SharedPoint, about: Expansion) -> BarrierErrors:
        """Return the residuals of the barrier problem's conditions at a point; about: its expansion."""
        lower = point.at_lower * (point.slack - self.low)
        upper = point.at_upper * (self.high - point.slack)
        # Rows against their slacks, and the tips' equations.
        missed = abs(about.at.rows - point.slack).max(), abs(about.at.equation_residuals).max()
        spread = min(lower.min(), upper.min()), max(lower.max(), upper.max())
        return BarrierErrors(
            self._stationarity(point, about), float(max(missed)), float(spread[0]), float(spread[1])
        )

    def _stationarity(self, point: SharedPoint, about: Expansion) -> float:
        """Return the largest slope of the Lagrangian over free unknowns; tips are stationary by their equations'
        multipliers.
        """
        return float(
            abs(
                (self.slope(about) + self.multiply_transposed_jacobian(about, point.multipliers)) * self.free
            ).max()
        )

    def merit(self, values: Values, slack: Array, barrier: float) -> Merit:
        """Return the merit of a point: the sum of all residuals, and the objective with the barrier.

        values: of the motion there. slack: of all rows. barrier: mm^2.
        """
        # A slack at or beyond its bound makes the logarithm infinite or NaN: the filter refuses such a
        # point.
        with np.errstate(invalid="ignore", divide="ignore"):
            logs = np.log(slack - self.low).sum() + np.log(self.high - slack).sum()
        missing = abs(values.rows - slack).sum() + abs(values.equation_residuals).sum()
        return Merit(float(missing), float(values.objective - barrier * logs))

    def trial_slack(self, rows: Array, slack: Array, before: Array) -> Array:
        """Return the slacks of a trial point with row values `rows`.

        slack: where the step leads, before: where it began. A slack becomes the row's own value where that keeps
        the part MIN_BOUND_DISTANCE_FRACTION of its former distance from both bounds. That row then has no
        residual, however curved it is.
        """
        # Rounding must not put a slack on its bound.
        edge = 1e-14 * (1 + np.minimum(abs(self.low), abs(self.high)))
        # The rule that a step must leave a part of the distance to bounds, asked of the rows' true values.
        good = (rows - self.low >= MIN_BOUND_DISTANCE_FRACTION * (before - self.low)) & (
            self.high - rows >= MIN_BOUND_DISTANCE_FRACTION * (self.high - before)
        )
        return np.where(good, rows, np.clip(slack, self.low + edge, self.high - edge))

    def evaluate_solution(
        self, point: SharedPoint, status: str, iterations: int, rough: bool = False
    ) -> SharedSolution:
        """Return the point as a solution, judged by the program itself and within bounds as they were given.

        status, iterations: of the solver; rough: whether it was to end near a solution only.
        """
        q, p, (lower, upper) = np.clip(point.q, *self._box), np.clip(point.p, *self._common_box), self._bounds
        # Of the point after clipping, which is the one that is returned; multipliers stay.
        about = self._expand_at(point, q, p)
        violation = float(np.maximum(lower - about.at.rows, about.at.rows - upper).max(initial=0.0))
        # Complementarity at the bounds as given, not at the relaxed ones that the method works with.
        to_bound = abs(np.where(point.multipliers > 0, upper, lower) - about.at.rows)
        products = abs(point.multipliers) * np.where(np.isfinite(to_bound), to_bound, 1.0)
        missing = float(abs(about.at.equation_residuals).max())
        kkt = max(self._stationarity(point, about), float(products.max()), violation, missing)
        found = float(about.at.objective), violation, missing, float(kkt)
        split = self.split(point.multipliers)
        motion = self.condensed.motion
        burdens = motion.by_robot(abs(split.frames))
        return SharedSolution(
            q, point.phi, *found, status, iterations, motion.shared_entries, p, split.own, burdens, rough
        )
