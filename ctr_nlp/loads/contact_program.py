"""Motions that lean on a wall: the configurations of frames, with the equilibrium on the wall eliminated.

In every frame the robot's shape and the wall's forces are functions of q (contact_equilibria.py), whose slopes
come with the equilibrium. So the unknowns are the configurations alone, as in a plan without contact:

    minimise    sum_j ( d_j + arrival_j + W_F total_j^2 ) + lambda sum_j |W (q_j - q_{j-1})|^2 / dt^2
    subject to  the limits of q and of its rates,  force at each place <= the limit,  stability margin >= the least

with d_j the mean squared distance of frame j from its target, eq. (8), mm^2, and total_j the sum of the wall's
forces, N. A place is PLACE_LENGTH_MM of the robot: forces there do not depend on how it is divided into pieces.

It is solved by sequential quadratic programming with Gauss and Newton's Hessian. The limit of forces is a penalty
of the excess's square, whose Hessian shows how fast a force grows as the robot is pushed on; the margin is an
exact penalty. Steps stay within a trust region of each frame, so that each equilibrium is followed from the one
before and stays on its branch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse as sp

from ctr_nlp.loads.contact_equilibria import PLACE_LENGTH_MM, ContactEquilibria, ContactSlopes, ContactState
from ctr_nlp.ocp.terms.arrival import ArrivalTerm
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.typing import Array

CONTACT_SIGMA = SIGMA_GRID[::4]
"""Points at which the shape's error counts in the program."""
TOTAL_FORCE_COST_MM2_PER_N2 = 1.0
"""Cost of the square of the sum of the wall's forces: among motions within the limit, the one that leans less is
taken."""
FORCE_EXCESS_COST_MM2_PER_N2 = 1e4
"""Cost of the square of a force beyond its limit along PLACE_LENGTH_MM: 0.02 N cost 4 mm^2."""
MARGIN_EXCESS_COST_MM2 = 1000.0
"""Cost of a margin below its least."""
MARGIN_WITHOUT_SLOPE = 0.95
"""Margin from which on its slope does not count: tubes hardly act on each other."""
MARGIN_SHARE_IN_STEP = 0.5
"""Least part of a margin that may be left after a step: margins fall like square roots before a snap."""
FIRST_STEP_MM, MAX_STEP_MM, MIN_STEP_MM = 1.0, 4.0, 1e-3
"""First, largest and least size of the trust region: of a change of an entry of q in mm (10 mm a rad)."""
MAX_CONTACT_ITERATIONS = 100
"""Most iterations of a motion."""
MIN_FOLLOWED_FRACTION = 2.0**-4
"""Least fraction of a step of q in which an equilibrium is followed: a step whose branch ends is not taken."""
DECREASE_TOLERANCE = 2e-3
"""Relative decrease of the objective below which the search ends."""
MARGIN_PROBE = 1e-4
"""Step of q, rad or mm, for differences of margins."""
QP_SOLVER = "highs"
"""Solver of quadratic programs, one of casadi's: of six, the only one that solved all of a trial to 1e-9."""
QP_OPTIONS: Any = {"error_on_fail": False, "print_time": False, "highs": {"output_flag": False}}
"""Its options."""
CONVERGED_STEP_MM = 0.01
"""Least trust region in all frames in which the search may end as converged."""
IMPROVEMENT_SHARE, GOOD_SHARE = 0.05, 0.7
"""Least share of the predicted decrease with which a step is taken, and that with which the next may be longer."""


class FrameCost(NamedTuple):
    """Objective of one frame near its equilibrium, as a quadratic function of steps of q.

    value, slope (n,), curvature (n, n): of distance, arrival and forces. margin, margin_by_q (n,): stability
    margin; its slope is 0 where tubes hardly act on each other.
    """

    value: float
    slope: Array
    curvature: Array
    margin: float
    margin_by_q: Array

    def value_after(self, step: Array) -> float:
        """Return the quadratic function after a step (n,) of q."""
        return float(self.value + self.slope @ step + 0.5 * step @ self.curvature @ step)

    def margin_after(self, step: Array) -> float:
        """Return the margin to first order after a step (n,) of q."""
        return self.margin + float(self.margin_by_q @ step)


class ContactMotion(NamedTuple):
    """Equilibria of T frames, with slopes and margins.

    costs (T,): of the frames, with penalties, mm^2. objective: their sum, and the cost of motion. converged:
    whether no step promises a further decrease.
    """

    states: tuple[ContactState, ...]
    slopes: tuple[ContactSlopes, ...]
    margins: Array
    costs: Array
    objective: float
    converged: bool = False

    @property
    def q(self) -> Array:
        """Configurations (T, 2d + 2)."""
        return np.stack([state.q for state in self.states])


@dataclass(frozen=True)
class ContactProgram:
    """Frames of a problem on a wall.

    problem: robot and target. equilibria: of its robot. limit: largest force at a place, N. margin: least
    stability margins (T,) of the frames. motion_weight: lambda, s^2. arrival: the term of the tip's arrival, or
    None. force_weight: cost of the square of a force beyond the limit, mm^2/N^2.
    """

    problem: Problem
    equilibria: ContactEquilibria
    limit: float
    margin: Array
    motion_weight: float
    arrival: ArrivalTerm | None
    force_weight: float = FORCE_EXCESS_COST_MM2_PER_N2

    def evaluate(self, states: Sequence[ContactState]) -> ContactMotion:
        """Return the motion of given equilibria of the frames."""
        slopes = tuple(self.equilibria.slopes(state, CONTACT_SIGMA) for state in states)
        margins = self.equilibria.margins(states)
        costs = np.array(
            [
                self._shape_cost(j, found)[0] + self._penalty(margin, least)
                for j, (found, margin, least) in enumerate(zip(slopes, margins, self.margin, strict=True))
            ]
        )
        moving = self._motion_cost(np.stack([state.q for state in states]))
        return ContactMotion(tuple(states), slopes, margins, costs, float(costs.sum()) + moving)

    def solve(self, motion: ContactMotion, progress: Callable[[int, float], None] | None = None) -> ContactMotion:
        """Improve a motion until its objective no longer decreases.

        progress: called with the number of iterations and the objective after each.
        """
        size = np.full(len(motion.states), FIRST_STEP_MM)
        costs = self._costs(motion)
        for iteration in range(MAX_CONTACT_ITERATIONS):
            found = self._step(motion, costs, size)
            if found is None:
                size = size / 2
                if size.max() <= MIN_STEP_MM:
                    break
                continue
            steps, expected = found
            gain = motion.objective - self._predict_objective(motion, expected, steps)
            if gain <= DECREASE_TOLERANCE * abs(motion.objective):
                return motion._replace(converged=bool(size.min() >= CONVERGED_STEP_MM))
            moved, lost = self._take_steps(motion, steps)
            reach = abs(steps * self._scale).max(axis=1)
            # Frames whose branch ended are kept back.
            size[lost] = reach[lost] / 4
            if moved is not None:
                # Also of a step that is not taken: it shows how curved the objective is along it.
                others = self._costs(moved)
                curved = [
                    (step, other.slope - cost.slope)
                    for cost, other, step in zip(costs, others, steps, strict=True)
                ]
                poor = moved.costs > expected + (1 - IMPROVEMENT_SHARE) * (motion.costs - expected) + 1e-9
                good = moved.costs <= expected + (1 - GOOD_SHARE) * (motion.costs - expected) + 1e-9
                size = np.where(poor, reach / 3, np.where(good, np.minimum(2 * size, MAX_STEP_MM), size))
                if moved.objective < motion.objective - IMPROVEMENT_SHARE * gain:
                    motion = moved
                    costs = others
                costs = [
                    cost._replace(curvature=_secant(cost.curvature, *pair))
                    for cost, pair in zip(costs, curved, strict=True)
                ]
            size = np.maximum(size, MIN_STEP_MM / 10)
            if size.max() <= MIN_STEP_MM:
                break
            if progress is not None:
                progress(iteration + 1, motion.objective)
        return motion

    @cached_property
    def _scale(self) -> Array:
        """W: mm per unit of the entries of q, (2d + 2,)."""
        return self.problem.robot.mm_per_unit

    def _take_steps(self, motion: ContactMotion, steps: Array) -> tuple[ContactMotion | None, list[int]]:
        """Return the motion after steps (T, 2d + 2) of q, and the frames whose branch ends before.

        None for the motion where there are any.
        """
        states = []
        lost = []
        for j, (state, step) in enumerate(zip(motion.states, steps, strict=True)):
            there, done = self.equilibria.follow(state, state.q + step, state.load, MIN_FOLLOWED_FRACTION)
            states.append(there)
            if done < 1:
                lost.append(j)
        if lost:
            return None, lost
        moved = self.evaluate(states)
        # Where an equilibrium has no finite slopes, its frame is kept back as well.
        lost = np.flatnonzero(~np.isfinite(moved.costs)).tolist()
        return (None if lost else moved), lost

    def _shape_cost(self, j: int, found: ContactSlopes) -> tuple[float, Array, Array]:
        """Return value, slope and Gauss and Newton's Hessian over q of distance, arrival and total force."""
        frame = self.problem.target_frames[j]
        weights = np.full(len(CONTACT_SIGMA), 1.0)
        weights[[0, -1]] = 0.5
        weights /= weights.sum()
        away = found.points - frame.at(CONTACT_SIGMA)
        by_q = found.points_by_q
        value = float(weights @ (away**2).sum(axis=1))
        slope = 2 * np.einsum("n,nc,ncq->q", weights, away, by_q)
        curvature = 2 * np.einsum("n,ncp,ncq->pq", weights, by_q, by_q, optimize=True)
        total = float(found.force.sum())
        total_by_q = found.force_by_q.sum(axis=0)
        value += TOTAL_FORCE_COST_MM2_PER_N2 * total**2
        slope = slope + 2 * TOTAL_FORCE_COST_MM2_PER_N2 * total * total_by_q
        curvature = curvature + 2 * TOTAL_FORCE_COST_MM2_PER_N2 * np.outer(total_by_q, total_by_q)
        excess = np.maximum(found.force_at_places - self.limit, 0.0)
        weights = self.force_weight * found.lengths / PLACE_LENGTH_MM
        excess_by_q = (excess > 0)[:, None] * (found.place_matrix @ found.force_by_q)
        value += float(weights @ excess**2)
        slope = slope + 2 * (weights * excess) @ excess_by_q
        curvature = curvature + 2 * excess_by_q.T @ (weights[:, None] * excess_by_q)
        if self.arrival is not None:
            cost, first, second = self._arrival_cost(away[-1], frame.motion_fraction)
            value += cost
            slope = slope + first @ by_q[-1]
            curvature = curvature + by_q[-1].T @ second @ by_q[-1]
        return value, slope, curvature

    def _arrival_cost(self, away: Array, part: float) -> tuple[float, Array, Array]:
        """Return the cost of a tip that is `away` (3,), mm, from the target's end, its slope and Hessian.

        Huber's function of the distance, quadratic up to the radius of ocp/terms/arrival.py and linear beyond it.
        A cost that is 0 up to there would have no Hessian, and steps would lead out again.
        """
        assert self.arrival is not None
        given = self.arrival.values(away, part)
        weight, radius = float(given["arrival_weight"]), float(given["arrival_radius"])
        distance = float(np.linalg.norm(away))
        value = distance**2 / (2 * radius) if distance < radius else distance - radius / 2
        # |a| <= (|a|^2 + |a_0|^2) / (2 |a_0|): the quadratic function lies above the distance, and touches it
        # here.
        curvature = weight / max(distance, radius)
        return weight * value, curvature * away, curvature * np.eye(3)

    def _penalty(self, margin: float, least: float) -> float:
        """Return the penalty of a margin below its least."""
        return MARGIN_EXCESS_COST_MM2 * max(least - margin, 0.0)

    def _motion_cost(self, q: Array) -> float:
        """Return the cost of the steps between frames q (T, 2d + 2), mm^2."""
        return float(self.motion_weight * (((np.diff(q, axis=0) * self._scale) / self.problem.dt) ** 2).sum())

    def _costs(self, motion: ContactMotion) -> list[FrameCost]:
        """Return the quadratic costs of all frames of a motion."""
        found = []
        for j, (state, slopes, margin) in enumerate(
            zip(motion.states, motion.slopes, motion.margins, strict=True)
        ):
            by_q = np.zeros(len(state.q))
            if margin < MARGIN_WITHOUT_SLOPE:
                by_q = self._margin_slope(state, slopes, float(margin))
            found.append(FrameCost(*self._shape_cost(j, slopes), float(margin), by_q))
        return found

    def _margin_slope(self, state: ContactState, slopes: ContactSlopes, margin: float) -> Array:
        """Return the derivatives (2d + 2,) of the stability margin by q, by forward differences."""
        near = [self.equilibria.predict(state, slopes, MARGIN_PROBE * unit) for unit in np.eye(len(state.q))]
        return (self.equilibria.margins(near) - margin) / MARGIN_PROBE

    def _step(self, motion: ContactMotion, costs: list[FrameCost], size: Array) -> tuple[Array, Array] | None:
        """Return the steps (T, 2d + 2) that minimise the quadratic model, and the costs (T,) that it expects.

        None where the quadratic program could not be solved.

        size (T,): of the trust region of each frame, mm. Each frame has a slack behind its step, of its margin.
        """
        robot = self.problem.robot
        n = len(self._scale)
        width = n + 1
        count = len(costs)
        hessian = sp.block_diag([sp.block_diag([cost.curvature, [[1e-8]]]) for cost in costs], format="csc")
        gradient = np.concatenate([np.append(cost.slope, MARGIN_EXCESS_COST_MM2) for cost in costs])
        pick = sp.kron(sp.eye(count), sp.eye(n, width), format="csc")
        # Differences of neighbouring frames.
        steps = sp.diags([-1.0, 1.0], [0, 1], shape=(count - 1, count))
        over = sp.kron(steps, sp.eye(n)) @ pick
        differences = np.diff(motion.q, axis=0).ravel()
        weights = np.tile(2 * self.motion_weight * (self._scale / self.problem.dt) ** 2, steps.shape[0])
        hessian = hessian + over.T @ sp.diags(weights) @ over
        gradient = gradient + over.T @ (weights * differences)
        rows, low, high = [over], [], []
        rate = np.tile(robot.speed * self.problem.dt, steps.shape[0])
        low.append(-rate - differences)
        high.append(rate - differences)
        if np.isfinite(robot.acceleration).any() and count > 2:
            second = sp.kron(sp.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count)), sp.eye(n)) @ pick
            most = np.tile(robot.acceleration * self.problem.dt**2, count - 2)
            now = np.diff(motion.q, n=2, axis=0).ravel()
            rows.append(second)
            low.append(-most - now)
            high.append(most - now)
        order = np.zeros((robot.d - 1, width))
        order[np.arange(robot.d - 1), robot.d + np.arange(robot.d - 1)] = -1
        order[np.arange(robot.d - 1), robot.d + 1 + np.arange(robot.d - 1)] = 1
        between = np.diff(robot.split(motion.q)[1], axis=1)
        rows.append(sp.kron(sp.eye(count), order))
        low.append(-between.ravel())
        high.append((robot.max_extension_differences - between).ravel())
        limits, least, most_of = self._margin_rows(costs)
        rows.append(limits)
        low.append(least)
        high.append(most_of)
        lower = np.full((count, width), 0.0)
        upper = np.full((count, width), np.inf)
        lower[:, :n] = np.minimum(np.maximum(robot.lower - motion.q, -size[:, None] / self._scale), 0.0)
        upper[:, :n] = np.maximum(np.minimum(robot.upper - motion.q, size[:, None] / self._scale), 0.0)
        found = _solve_quadratic(
            hessian,
            gradient,
            sp.vstack(rows, format="csc"),
            np.concatenate(low),
            np.concatenate(high),
            lower,
            upper,
        )
        if found is None:
            return None
        taken = np.clip(found.reshape(count, width)[:, :n], lower[:, :n], upper[:, :n])
        expected = [
            cost.value_after(step) + self._penalty(cost.margin_after(step), least)
            for cost, step, least in zip(costs, taken, self.margin, strict=True)
        ]
        return taken, np.array(expected)

    def _margin_rows(self, costs: list[FrameCost]) -> tuple[sp.csc_matrix, Array, Array]:
        """Return rows for margins over steps and slacks, and their bounds."""
        blocks, least = [], []
        for cost, margin in zip(costs, self.margin, strict=True):
            blocks.append(np.append(cost.margin_by_q, 1.0)[None])
            kept = max(margin, MARGIN_SHARE_IN_STEP * cost.margin)
            least.append(kept - cost.margin)
        return sp.block_diag(blocks, format="csc"), np.array(least), np.full(len(least), np.inf)

    def _predict_objective(self, motion: ContactMotion, expected: Array, steps: Array) -> float:
        """Return the objective that the quadratic model predicts after steps (T, 2d + 2)."""
        return float(expected.sum()) + self._motion_cost(motion.q + steps)


def _secant(curvature: Array, step: Array, change: Array) -> Array:
    """Return a Hessian with the curvature that a step showed, by the formula BFGS.

    Gauss and Newton's Hessian knows nothing of how forces stiffen where more of the robot begins to touch, and
    steps would go to and fro across a valley. Where the objective is less curved along the step, it stays as it
    is.
    """
    found = float(step @ change)
    known = float(step @ curvature @ step)
    if not known < found < np.inf or known <= 0:
        return curvature
    bent = curvature @ step
    return np.asarray(curvature - np.outer(bent, bent) / known + np.outer(change, change) / found)


def _solve_quadratic(
    hessian: sp.csc_matrix,
    gradient: Array,
    rows: sp.csc_matrix,
    low: Array,
    high: Array,
    lower: Array,
    upper: Array,
) -> Array | None:
    """Return the minimum (n,) of a convex quadratic program; None where the solver finds none."""
    hessian = sp.csc_matrix((hessian + hessian.T) / 2)
    rows = sp.csc_matrix(rows)
    # casadi ends the process where indices are not sorted.
    for matrix in (hessian, rows):
        matrix.sum_duplicates()
    given = {"h": ca.DM(hessian), "g": ca.DM(gradient), "a": ca.DM(rows)}
    solver = ca.conic("qp", QP_SOLVER, {"h": given["h"].sparsity(), "a": given["a"].sparsity()}, QP_OPTIONS)
    found = solver(**given, lba=low, uba=high, lbx=lower.ravel(), ubx=upper.ravel())
    x = np.asarray(found["x"]).ravel()
    return x if solver.stats()["success"] and np.isfinite(x).all() else None
