"""An interior-point method with a filter line search for motions that several robots share.

Its Newton systems have the unknowns of q alone and are banded (condensed.py). Where a Hessian is not positive
definite, the same number is added to its diagonal over q and over every tip: near a fold tips turn far for little
turns of motors, and steps are shortened where tips would turn far. After Waechter and Biegler, Math. Program. 106
(2006). The barrier mu is in mm^2, unknowns are in rad and mm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctr_nlp.ocp.scenarios import SharedMotion
from ctr_nlp.solvers.barrier import (
    BARRIER_RESIDUAL_FACTOR,
    BARRIER_SHRINK_FACTOR,
    MAX_STEP_HALVINGS,
    STALL_ITERATIONS,
)
from ctr_nlp.solvers.motion.chain_solution import COLD_START_BARRIER_MM2
from ctr_nlp.solvers.scenarios.bordered import solve_bordered_system
from ctr_nlp.solvers.scenarios.common import NO_COMMON_UNKNOWNS
from ctr_nlp.solvers.scenarios.condensed import Expansion
from ctr_nlp.solvers.scenarios.filter import Filter
from ctr_nlp.solvers.scenarios.rows import (
    MIN_BOUND_DISTANCE_FRACTION,
    BarrierErrors,
    SharedPoint,
    SharedRows,
    SharedSolution,
)
from ctr_nlp.typing import Array

FINE_LAST_BARRIER_MM2, COARSE_LAST_BARRIER_MM2 = 1e-6, 1e-4
"""Last barriers, mm^2: less than FINE_LAST_BARRIER_MM2 changes no motion. COARSE_LAST_BARRIER_MM2 takes half as
many steps; robust plans of four airways have objectives that are larger by 0.1 to 0.5 % with it, and mean errors
by half of that.
"""
SHARED_RESIDUAL_PER_BARRIER, SHARED_MIN_RESIDUAL_TOLERANCE = 3.0, 1e-5
"""Largest residual at a solution in last barriers, and in any case, mm^2 per unit of q and mm^2."""
SHARED_INFEASIBILITY_TOLERANCE = 1e-7
"""Largest residual of equations and rows at a solution, rad and mm."""
MAX_SHARED_ITERATIONS, MAX_TIP_CORRECTIONS = 200, 4
"""Limits: Newton steps in a solve, and corrections of tips at a whole step."""
(
    SHARED_FIRST_DAMPING,
    DAMPING_GROWTH_FACTOR,
    FIRST_DAMPING_GROWTH_FACTOR,
    DAMPING_REDUCTION_DIVISOR,
    MAX_SHARED_DAMPING,
) = 1e-3, 4.0, 30.0, 10.0, 1e10
"""First damping, mm^2 per squared unit; factors from trial to trial, where one is known and where none is; the
next starts from the last by this divisor; the largest. A trial costs a tenth of a step."""
MAX_OBJECTIVE_RISE_FACTOR = 3.0
"""Times the objective by which a step may raise it. Contact is steep: steps that bring robots nearer to their
equilibria may throw them far through the wall, from where the way back takes long.
"""
SHARED_STALL_DECREASE = 1e-9
"""A barrier problem is left when STALL_ITERATIONS iterations at feasible points lower it by less than this part.
"""
MAX_STEP_RETRIES, RETRY_DAMPING_FACTOR = 4, 100.0
"""Times that a step of which no part is accepted is computed again, with RETRY_DAMPING_FACTOR times the damping.
"""
ROUGH_BARRIER_MM2, ROUGH_PROGRESS, ROUGH_STEPS, ROUGH_INFEASIBILITY_TOLERANCE = 5e-4, 1e-3, 4, 1e-2
"""A rough solve ends at this barrier, mm^2, once the objective has changed by less than ROUGH_PROGRESS of itself
in ROUGH_STEPS steps, where rows and equations miss no more than ROUGH_INFEASIBILITY_TOLERANCE, rad and mm.
"""
LOCAL_PARAMETER_TOLERANCE, MAX_LOCAL_PARAMETER_UPDATES = 1e-3, 6
"""Largest change of the objective at a solution by new local parameters, as a part of it; and how often local
parameters are updated.
"""


class _Step(NamedTuple):
    """A Newton step, as parts for every kind of unknown.

    du (T n + P,): of q and p; dx (T, S, m): of the scenarios' unknowns; slack, at_lower, at_upper: of the rows'
    slacks and multipliers; equations (T, S, k): of the equations' multipliers; slope: of the barrier objective
    along the step.
    """

    du: Array
    dx: Array
    slack: Array
    at_lower: Array
    at_upper: Array
    equations: Array
    slope: float


class SharedSolver:
    """Solver of shared motions from any start; most reliable where the nominal robot has a good margin.

    Where parameters are local to a motion, it updates them at its solution and continues, until they do not change
    any more.
    """

    def __init__(self, motion: SharedMotion, last_barrier: float = FINE_LAST_BARRIER_MM2) -> None:
        """Prepare for a motion; last_barrier: the barrier at which a solve ends, mm^2."""
        self._rows = SharedRows(motion)
        self._last = last_barrier

    def __call__(
        self,
        q: Array,
        phi: Array,
        barrier: float = COLD_START_BARRIER_MM2,
        stop: Callable[[], bool] = lambda: False,
        max_iterations: int = MAX_SHARED_ITERATIONS,
        p: Array = NO_COMMON_UNKNOWNS,
        rough: bool = False,
    ) -> SharedSolution:
        """Solve from q (T, n) and tips phi (T, S, k), which need not be in equilibrium, in at most
        `max_iterations` steps.

        barrier: the first, mm^2; stop: asked before every step whether to end; p (P,): common unknowns, if there
        are any. rough: whether to end near a solution already, which is enough to start other solves from and
        takes half as long.
        """
        run = _InteriorPointSolve(self._rows, q, phi, p, barrier, self._last, rough)
        status = ""
        while not status:
            status = run.status()
            if not status and run.number == max_iterations:
                status = "Maximum_Iterations_Exceeded"
            status = status or ("Interrupted" if stop() else run.advance())
        return self._rows.evaluate_solution(run.point, status, run.number, rough)


def _progress(objectives: list[float]) -> float:
    """Return the relative change of the objective over the last steps; infinite if there are too few."""
    recent = objectives[-ROUGH_STEPS:]
    if len(recent) < ROUGH_STEPS:
        return np.inf
    return (max(recent) - min(recent)) / (1 + abs(recent[-1]))


class _InteriorPointSolve:
    """One solve: the current point, its expansion, the barrier, the damping and the filter."""

    def __init__(
        self, rows: SharedRows, q: Array, phi: Array, p: Array, barrier: float, last: float, rough: bool = False
    ) -> None:
        self._rows = rows
        self._barrier = barrier
        self._damping = 0.0
        self.number = 0
        self._rough = rough
        self._last = last
        self._looks = 0
        rows.condensed.update_local_parameters(q, phi, p)
        start = rows.start(q, phi, p, barrier)
        # Multipliers at which the start is stationary over tips. From zero, the first Hessian would lack
        # the curvature of the equations.
        equations = rows.equations(rows.expand(start), start.multipliers)
        self.point = replace(start, equations=equations)
        self._about = rows.expand(self.point)
        self._filter = Filter(rows.merit(self._about.at, start.slack, barrier).infeasibility)
        self._objectives = list[float]()
        self._nearest: tuple[float, SharedPoint] | None = None

    def status(self) -> str:
        """Return why the solve has ended, or ""; lower the barrier where its problem is solved."""
        errors = self._rows.errors(self.point, self._about)
        known = self._objectives
        self._note_nearest(errors)
        slow = (
            self._rough
            and errors.infeasibility <= ROUGH_INFEASIBILITY_TOLERANCE
            and _progress(known) <= ROUGH_PROGRESS
        )
        if slow and self._barrier <= ROUGH_BARRIER_MM2:
            return "" if self._update_local_parameters() else "Solved_Roughly"
        if (
            errors.residual(0.0) <= max(SHARED_RESIDUAL_PER_BARRIER * self._last, SHARED_MIN_RESIDUAL_TOLERANCE)
            and errors.infeasibility <= SHARED_INFEASIBILITY_TOLERANCE
        ):
            return "" if self._update_local_parameters() else "Solve_Succeeded"
        # A barrier problem whose objective no longer falls at feasible points counts as solved, though its
        # residual may be larger: Newton steps can go to and fro (motion/banded.py, STALL_ITERATIONS).
        stalled = errors.infeasibility <= SHARED_INFEASIBILITY_TOLERANCE and len(known) > STALL_ITERATIONS
        stalled = stalled and known[-STALL_ITERATIONS] - known[-1] < SHARED_STALL_DECREASE * (1 + abs(known[-1]))
        if stalled and self._barrier == self._last:
            if self._update_local_parameters():
                return ""
            # Of points that steps go to and fro between, objectives are equal and residuals may differ by 1e4.
            if self._nearest is not None:
                self.point = self._nearest[1]
            return "Solved_To_Acceptable_Level"
        stalled = stalled or slow
        # Several barriers may be passed in one go; after each the filter is cleared, since its objectives
        # contain the barrier.
        while self._barrier > self._last and (
            stalled or errors.residual(self._barrier) < BARRIER_RESIDUAL_FACTOR * self._barrier
        ):
            self._barrier = max(self._last, BARRIER_SHRINK_FACTOR * self._barrier)
            stalled = False
            self._filter.clear()
            known.clear()
        return ""

    def _note_nearest(self, errors: BarrierErrors) -> None:
        """Keep the feasible point of least residual at the last barrier; errors: at the present point."""
        if self._barrier > self._last or errors.infeasibility > SHARED_INFEASIBILITY_TOLERANCE:
            return
        # The residual of the problem itself (barrier 0): by it the solution is judged in the end. At earlier
        # barriers it cannot be small, since every product of a slack and its multiplier is near the barrier.
        residual = errors.residual(0.0)
        if self._nearest is None or residual < self._nearest[0]:
            self._nearest = residual, self.point

    def _update_local_parameters(self) -> bool:
        """Update the local parameters at the point; return True if they changed enough that the solve has to
        continue.
        """
        point = self.point
        self._looks = self._looks + 1
        if self._looks > MAX_LOCAL_PARAMETER_UPDATES or not self._rows.condensed.update_local_parameters(
            point.q, point.phi, point.p, LOCAL_PARAMETER_TOLERANCE
        ):
            return False
        self._about = self._rows.expand(point)
        self._filter.clear()
        self._objectives.clear()
        # Points before the update solve another problem.
        self._nearest = None
        return True

    def advance(self) -> str:
        """Make one step; return the reason why there is none, or ""."""
        least = 0.0
        point = None
        for _ in range(MAX_STEP_RETRIES):
            step = self._newton_step(least)
            if step is None:
                return "Infeasible_Problem_Detected"
            point = self._line_search(step)
            if point is not None:
                break
            least = RETRY_DAMPING_FACTOR * max(self._damping, SHARED_FIRST_DAMPING)
            self._filter.clear()
        if point is None:
            return "Search_Direction_Becomes_Too_Small"
        self.point, self._about = point, self._rows.expand(point)
        self.number += 1
        return ""

    def _newton_step(self, least: float) -> _Step | None:
        """Return a descent step, damped as far as necessary and by at least `least`; None where there is none."""
        rows = self._rows
        about = self._about
        point = self.point
        per_lower = 1 / (point.slack - rows.low)
        per_upper = 1 / (rows.high - point.slack)
        # sigma = z_l / (s - l) + z_u / (u - s), from eliminating slacks and bound multipliers
        # (motion/rows.py).
        sigma = point.at_lower * per_lower + point.at_upper * per_upper
        # Row residuals as they will be after the repair of the equations, which is part of every step.
        missed = about.at.rows + rows.change_by_repair(about) - point.slack
        right = rows.slope(about) + rows.multiply_transposed_jacobian(
            about, self._barrier * (per_upper - per_lower) + sigma * missed
        )
        parts = rows.split(sigma)
        # A' diag(sigma) A, frame by frame; links and twists, which span two frames, go into the band.
        squares = about.jacobian.swapaxes(1, 2) @ (about.jacobian * parts.frames[..., None])
        corner = about.common_derivatives.hessian + about.common_derivatives.rows.T @ (
            about.common_derivatives.rows * parts.own[:, None]
        )
        links = rows.links.band(parts.links)
        damping = least
        rows.twists.square(about.twists, parts.twists, squares, links)
        while damping < MAX_SHARED_DAMPING:
            hessian, bent = about.quadratic(damping)
            on_p = corner + damping * np.eye(len(corner))
            diagonal = np.append(parts.q, parts.p)
            du = solve_bordered_system(
                links, hessian + squares, on_p, diagonal, -(right + rows.sum_over_frames(bent)), rows.free
            )
            if du is not None:
                # The last damping that was needed is where the next search for one begins (Waechter and
                # Biegler, section 3.1).
                self._damping = damping or self._damping
                step = self._complete_step(about, du, damping)
                return step if np.isfinite(step.slope) else None
            known = self._damping
            first = known / DAMPING_REDUCTION_DIVISOR if known else SHARED_FIRST_DAMPING
            damping = (
                damping * (DAMPING_GROWTH_FACTOR if known else FIRST_DAMPING_GROWTH_FACTOR) if damping else first
            )
        return None

    def _complete_step(self, about: Expansion, du: Array, damping: float) -> _Step:
        """Return the whole step that belongs to du (T n + P,), with slacks and multipliers."""
        rows = self._rows
        point = self.point
        barrier = self._barrier
        low = point.slack - rows.low
        high = rows.high - point.slack
        dx = about.step(rows.by_frame(du))
        slack = about.at.rows - point.slack + rows.linearised_change(about, du)
        # From z (s - l) = mu, linearised: (z + dz)(s - l) + z ds = mu, and likewise at upper bounds.
        at_lower = (barrier - point.at_lower * slack) / low - point.at_lower
        at_upper = (barrier + point.at_upper * slack) / high - point.at_upper
        after = point.multipliers + at_upper - at_lower
        equations = rows.equations(about, after, dx, damping) - point.equations
        slope = (about.gradient * dx).sum() + rows.own_slope(about) @ du
        slope += (barrier * (1 / high - 1 / low)) @ slack
        return _Step(du, dx, slack, at_lower, at_upper, equations, float(slope))

    def _line_search(self, step: _Step) -> SharedPoint | None:
        """Return the point as far along a step as the filter accepts; None where it accepts nothing.

        Where a whole step raises the infeasibility, its tips are corrected, since equations are curved.
        """
        rows = self._rows
        point = self.point
        about = self._about
        here = rows.merit(about.at, point.slack, self._barrier)
        part, dual = self._fraction_to_boundary(step)
        for halving in range(MAX_STEP_HALVINGS):
            q = point.q + part * step.du[: point.q.size].reshape(point.q.shape)
            phi = point.phi + part * step.dx[..., about.tips]
            p = point.p + part * step.du[point.q.size :]
            # Second-order correction: it costs one evaluation, as a halving does. Only whole steps are
            # corrected.
            for _ in range(1 if halving else MAX_TIP_CORRECTIONS):
                values = rows.condensed.value(q, phi, p)
                slack = rows.trial_slack(values.rows, point.slack + part * step.slack, point.slack)
                trial = rows.merit(values, slack, self._barrier)
                if trial.objective - here.objective > MAX_OBJECTIVE_RISE_FACTOR * (1 + abs(here.objective)):
                    break
                if self._filter.accepts(here, trial, step.slope, part):
                    if not self._filter.requires_decrease(here, step.slope, part):
                        self._filter.add_point(here)
                    self._objectives.append(trial.objective)
                    pulls = point.at_lower + dual * step.at_lower, point.at_upper + dual * step.at_upper
                    return SharedPoint(q, phi, p, slack, *pulls, point.equations + part * step.equations)
                if trial.infeasibility < here.infeasibility or not np.isfinite(trial.infeasibility):
                    break
                # A part of a step may leave the rest of the residual; only what curvature adds is
                # corrected, with the inverse that is known.
                missing = values.equation_residuals - (1 - part) * about.at.equation_residuals
                phi = phi - (about.inverse @ missing[..., None])[..., 0]
            part /= 2
        return None

    def _fraction_to_boundary(self, step: _Step) -> tuple[float, float]:
        """Return the parts of a step that keep slacks within bounds, and multipliers positive (fraction to the
        boundary).
        """
        rows = self._rows
        point = self.point
        keep = 1 - MIN_BOUND_DISTANCE_FRACTION
        low = point.slack - rows.low
        high = rows.high - point.slack
        primal = max(keep, (-step.slack / low).max(), (step.slack / high).max())
        dual = max(keep, (-step.at_lower / point.at_lower).max(), (-step.at_upper / point.at_upper).max())
        return keep / float(primal), keep / float(dual)
