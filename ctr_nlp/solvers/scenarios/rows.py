"""A point of a shared motion's barrier problem: its rows with slacks and multipliers, and what it misses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.nlp.scenarios import SharedMotion
from ctr_nlp.solvers.frame.adapter import FEASIBLE, OPTIMAL
from ctr_nlp.solvers.scenarios.condensed import Condensed, Expansion, Values
from ctr_nlp.solvers.scenarios.filter import Merit
from ctr_nlp.solvers.scenarios.links import LinkBand
from ctr_nlp.typing import Array, Flags

PUSH, RELAX, INFINITE, LEFT = 1e-3, 1e-9, 1e20, 0.005
"""How far slacks start within bounds, how far bounds are moved outwards, what stands for none, and what part of
its distance from a bound a step leaves."""


@dataclass(frozen=True)
class SharedSolution:
    """A point of a shared motion: q (T, n), tips phi (T, S, d), the objective in mm^2.

    violation: of bounds; missing: of the scenarios' equations; kkt: residual of all conditions of optimality, from
    the program itself. success: whether it is a solution.
    """

    q: Array
    phi: Array
    objective: float
    violation: float
    missing: float
    kkt: float
    status: str
    iterations: int

    @property
    def success(self) -> bool:
        """Whether this is a solution: all robots are in equilibrium and keep their rows, and none
        is better nearby.
        """
        return max(self.violation, self.missing) <= FEASIBLE and self.kkt <= OPTIMAL


@dataclass(frozen=True)
class Point:
    """Unknowns, slacks of all rows, and multipliers of their bounds and of the equations."""

    q: Array
    phi: Array
    slack: Array
    at_lower: Array
    at_upper: Array
    equations: Array

    @property
    def multipliers(self) -> Array:
        """Of all rows, positive at upper bounds."""
        return self.at_upper - self.at_lower


class Errors(NamedTuple):
    """Of a point. stationarity: of the Lagrangian; missed: by rows and equations; least, most: products of slacks
    and multipliers, mm^2.
    """

    stationarity: float
    missed: float
    least: float
    most: float

    def against(self, barrier: float) -> float:
        """The residual of a barrier problem; with barrier 0, of the problem itself."""
        return max(self.stationarity, self.missed, abs(self.least - barrier), abs(self.most - barrier))


class SharedRows:
    """The rows of a shared motion: q itself, the frames' rows, the links."""

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare."""
        self.condensed, self.links = Condensed(motion), LinkBand(motion)
        self.free: Flags = motion.lower < motion.upper
        frames, _, n, _ = motion.sizes
        lower, upper = self.condensed.lower, self.condensed.upper
        self._ends = [frames * n, lower.size - len(self.links.weight)]
        still = self._still(motion)
        self.low = np.where(still | np.isinf(lower), -INFINITE, lower - RELAX)
        self.high = np.where(still | np.isinf(upper), INFINITE, upper + RELAX)
        self._bounds = np.where(still, -np.inf, lower), np.where(still, np.inf, upper)
        self._box = motion.lower, motion.upper

    def _still(self, motion: SharedMotion) -> Flags:
        """Rows that no free unknown changes."""
        d = motion.d
        rows = np.ones(motion.row_bounds[0].shape, dtype=bool)
        if len(motion.common_rows):
            depends = motion.frame.g_depends[motion.common_rows, d:]
            rows[:, -len(motion.common_rows) :] = self.free[:, d:] @ depends.T
        links = abs(motion.linking) @ self.free.ravel() > 0
        return np.asarray(~np.concatenate([self.free.ravel(), rows.ravel(), links]))

    def start(self, q: Array, phi: Array, barrier: float) -> Point:
        """A point at q and phi, with slacks within their bounds."""
        q = np.clip(q, *self._box)
        rows = self.condensed.value(q, phi).rows
        within = np.minimum(PUSH, 0.1 * (self.high - self.low))
        slack = np.clip(rows, self.low + within, self.high - within)
        pulls = barrier / (slack - self.low), barrier / (self.high - slack)
        return Point(q, np.array(phi), slack, *pulls, np.zeros(phi.shape))

    def expand(self, point: Point) -> Expansion:
        """Derivatives about a point."""
        return self.condensed.expand(point.q, point.phi, point.equations, self.split(point.multipliers)[1])

    def split(self, rows: Array) -> tuple[Array, Array, Array]:
        """Values of all rows as those of q (T, n), of frames (T, m) and of links (l,)."""
        of_q, of_frames, links = np.split(rows, self._ends)
        shape = self.free.shape
        return of_q.reshape(shape), of_frames.reshape(shape[0], -1), links

    def joined(self, of_q: Array, of_frames: Array, links: Array) -> Array:
        """The opposite of split."""
        return np.concatenate([of_q.ravel(), of_frames.ravel(), links])

    def pulled(self, about: Expansion, rows: Array) -> Array:
        """The transposed Jacobian of all rows, over q, times rows: (T, n)."""
        of_q, of_frames, links = self.split(rows)
        through = (about.jacobian.swapaxes(1, 2) @ of_frames[..., None])[..., 0]
        return np.asarray(of_q + through + self.links.pulled(links))

    def moved(self, about: Expansion, dq: Array) -> Array:
        """By what a step dq (T, n) changes all rows, with what the equations' repair does."""
        through = (about.jacobian @ dq[..., None])[..., 0] + about.ahead
        return self.joined(dq, through, self.links.moved(dq))

    def repaired(self, about: Expansion) -> Array:
        """By what the equations' repair alone changes all rows."""
        return self.joined(np.zeros(self.free.shape), about.ahead, np.zeros(len(self.links.weight)))

    def link_slope(self, about: Expansion) -> Array:
        """The gradient (T, n) of the links' costs."""
        return self.links.slope(about.at.rows[self._ends[1] :])

    def slope(self, about: Expansion) -> Array:
        """The objective's gradient (T, n) over q, with tips as their equations say."""
        return about.over_q(about.gradient) + self.link_slope(about)

    def errors(self, point: Point, about: Expansion) -> Errors:
        """How far a point is from a solution."""
        lower = point.at_lower * (point.slack - self.low)
        upper = point.at_upper * (self.high - point.slack)
        missed = abs(about.at.rows - point.slack).max(), abs(about.at.missing).max()
        spread = min(lower.min(), upper.min()), max(lower.max(), upper.max())
        return Errors(self._stationarity(point, about), float(max(missed)), float(spread[0]), float(spread[1]))

    def _stationarity(self, point: Point, about: Expansion) -> float:
        return float(abs((self.slope(about) + self.pulled(about, point.multipliers)) * self.free).max())

    def merit(self, values: Values, slack: Array, barrier: float) -> Merit:
        """What a point misses, and its objective with the barrier."""
        with np.errstate(invalid="ignore", divide="ignore"):
            logs = np.log(slack - self.low).sum() + np.log(self.high - slack).sum()
        missing = abs(values.rows - slack).sum() + abs(values.missing).sum()
        return Merit(float(missing), float(values.objective - barrier * logs))

    def trial_slack(self, rows: Array, slack: Array, before: Array) -> Array:
        """Slacks of a trial: the rows' own values where these keep as far from bounds as a step
        from before must.
        """
        edge = 1e-14 * (1 + np.minimum(abs(self.low), abs(self.high)))
        good = (rows - self.low >= LEFT * (before - self.low)) & (self.high - rows >= LEFT * (self.high - before))
        return np.where(good, rows, np.clip(slack, self.low + edge, self.high - edge))

    def judged(self, point: Point, status: str, iterations: int) -> SharedSolution:
        """The point as a solution: what the program itself says of it, within bounds as they were given."""
        q, (lower, upper) = np.clip(point.q, *self._box), self._bounds
        about = self.condensed.expand(q, point.phi, point.equations, self.split(point.multipliers)[1])
        violation = float(np.maximum(lower - about.at.rows, about.at.rows - upper).max(initial=0.0))
        to_bound = abs(np.where(point.multipliers > 0, upper, lower) - about.at.rows)
        products = abs(point.multipliers) * np.where(np.isfinite(to_bound), to_bound, 1.0)
        missing = float(abs(about.at.missing).max())
        kkt = max(self._stationarity(point, about), float(products.max()), violation, missing)
        found = float(about.at.objective), violation, missing, float(kkt)
        return SharedSolution(q, point.phi, *found, status, iterations)
