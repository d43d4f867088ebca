"""Motions that lean on a wall, as a chain of frames: the program, and the search for its solution.

    minimise    the sum of the frames' costs (contact_frames.py) + lambda sum_j |W (q_j - q_{j-1})|^2 / dt^2
    subject to  the limits of q and of its rates,  force at each place - s_P <= limit,  margin + s_M >= least

The wall's forces are eliminated; what is left is a chain with second derivatives, which the banded interior-point
method solves as it does without a wall.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.codegen.batch_evaluator import BatchEvaluator, PythonBatchEvaluator
from ctr_nlp.loads.contact_frames import (
    FORCE_EXCESS_COST_MM2_PER_N,
    MARGIN_SHORTFALL_COST_MM2,
    ContactFrames,
    FrameDerivatives,
    FrameMultipliers,
    FrameValues,
)
from ctr_nlp.loads.contact_rods import ContactState
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.horizon import motion_links
from ctr_nlp.ocp.joint import tip_step_limits
from ctr_nlp.ocp.nlp import Constraint, Nlp
from ctr_nlp.solvers.frame.adapter import FEASIBILITY_TOLERANCE
from ctr_nlp.solvers.motion.banded import BandedSolver
from ctr_nlp.solvers.motion.chain_solution import WARM_START_BARRIER_MM2
from ctr_nlp.solvers.motion.watch import Iterate, Watch
from ctr_nlp.typing import Array

MARGIN_SHORTFALL, FORCE_EXCESS = -2, -1
"""Positions of s_M and s_P among the unknowns of a frame."""
CONTACT_KKT_TOLERANCE = 2e-3
"""KKT residual at which a search ends, mm^2 per unit of the unknowns, a fifth of what counts as solved."""
GAIN_ITERATIONS = 5
"""Iterations over which a search's gain is measured."""
SOFT_UNIT = 0.01
"""Size of s_M and s_P, and N, that a unit of their unknowns stands for: with large units the solver's merit
function would weigh all curved rows with the large costs of these two, and steps would be short."""
SOFT_COSTS = SOFT_UNIT * np.array([MARGIN_SHORTFALL_COST_MM2, FORCE_EXCESS_COST_MM2_PER_N])
"""Costs of units of their unknowns, mm^2."""
SOFT_START = 0.2
"""How much larger the unknowns of s_M and s_P are to start with than they need be: an interior point."""


@dataclass(frozen=True)
class ContactChain(Chain):
    """A chain whose frames lean on a wall: numbers come from equilibria instead of symbols.

    on_wall: the frames.
    """

    on_wall: ContactFrames | None = None

    @cached_property
    def _evaluators(self) -> Callable[[int], BatchEvaluator]:  # type: ignore[override]
        assert self.on_wall is not None
        found = _Evaluators(self, self.on_wall)
        return found.__getitem__


class _Evaluators:
    """Values, slopes and expansions of a chain on a wall, by the numbers under which a chain asks for them."""

    def __init__(self, chain: ContactChain, frames: ContactFrames) -> None:
        """Prepare the arrays that solvers read and write."""
        self._frames = frames
        self._d = frames.problem.robot.d
        self._sizes = chain.frames, chain.unknowns, chain.frame.g.numel()
        count, n, m = self._sizes
        x, none, weight, of_g = (count, n), (count, 0), (count, 1), (count, m)
        results = (count, 1), (count, n), of_g, (count, n * m), (count, n * n)
        self._batches = (
            PythonBatchEvaluator([x, none], [results[0], results[2]], self._values),
            PythonBatchEvaluator([x, none], [*results[:4]], self._slopes),
            PythonBatchEvaluator([x, none, weight, of_g], [*results], self._expand),
        )

    def __getitem__(self, which: int) -> BatchEvaluator:
        return self._batches[which]

    def _values(self, inputs: list[Array], outputs: list[Array]) -> None:
        x = inputs[0]
        found = self._frames.values(x[:, :-2])
        if found is None:
            # A cost that is not a number shortens the step.
            outputs[0][:] = np.nan
            return
        outputs[0][:, 0] = self._costs(x, found)
        outputs[1][:] = self._constraints(x, found)

    def _multipliers(self, of_g: Array) -> FrameMultipliers:
        """Return the multipliers of_g (T, m) of the constraints by kind."""
        d = self._d
        of_q = np.zeros((len(of_g), 2 * d + 2))
        # Other entries of q are unknowns themselves.
        of_q[:, : d - 1] = of_g[:, : d - 1]
        return FrameMultipliers(of_q, of_g[:, 2 * d - 2], of_g[:, 2 * d - 1 :])

    def _slopes(self, inputs: list[Array], outputs: list[Array]) -> None:
        x = inputs[0]
        self._derive(x, np.zeros((len(x), self._sizes[2])), outputs, curvature=False)

    def _expand(self, inputs: list[Array], outputs: list[Array]) -> None:
        x, _, _, of_g = inputs
        found = self._derive(x, of_g, outputs, curvature=True)
        if found is None:
            return
        count, n, _ = self._sizes
        hessian = np.zeros((count, n, n))
        hessian[:, :-2, :-2] = found.hessian
        outputs[4][:] = hessian.reshape(count, -1)

    def _derive(self, x: Array, of_g: Array, outputs: list[Array], curvature: bool) -> FrameDerivatives | None:
        """Write values and first derivatives at x (T, n); return what was found, None where nothing was.

        of_g (T, m): multipliers of the constraints.
        """
        if not self._frames.move_to(x[:, :-2]):
            for each in outputs:
                each[:] = np.nan
            return None
        d = self._d
        found = self._frames.derivatives(self._multipliers(of_g), curvature)
        count, n, m = self._sizes
        outputs[0][:, 0] = self._costs(x, found.values)
        outputs[1][:] = np.hstack([found.cost_by, np.tile(SOFT_COSTS, (count, 1))])
        outputs[2][:] = self._constraints(x, found.values)
        jacobian = np.zeros((count, m, n))
        jacobian[:, : d - 1, :-2] = found.q_by[:, : d - 1]
        ends = np.arange(d - 1)
        jacobian[:, d - 1 + ends, d + ends] = -1.0
        jacobian[:, d - 1 + ends, d + 1 + ends] = 1.0
        jacobian[:, 2 * d - 2, :-2] = found.margin_by
        jacobian[:, 2 * d - 2, MARGIN_SHORTFALL] = SOFT_UNIT
        jacobian[:, 2 * d - 1 :, :-2] = found.force_by
        jacobian[:, 2 * d - 1 :, FORCE_EXCESS] = -SOFT_UNIT
        # By columns, as CasADi stores matrices.
        outputs[3][:] = np.swapaxes(jacobian, 1, 2).reshape(count, -1)
        return found

    def _costs(self, x: Array, found: FrameValues) -> Array:
        """Return the frames' costs (T,), mm^2, with those of s_M and s_P."""
        soft = x[:, MARGIN_SHORTFALL:] @ SOFT_COSTS
        return np.asarray(found.cost + soft)

    def _constraints(self, x: Array, found: FrameValues) -> Array:
        """Return the frames' constraints (T, m): motors, gaps between tubes' ends, margins, forces at places."""
        d = self._d
        margin = found.margin + SOFT_UNIT * x[:, MARGIN_SHORTFALL]
        force = found.force - SOFT_UNIT * x[:, FORCE_EXCESS, None]
        gaps = np.diff(x[:, d : 2 * d], axis=1)
        return np.column_stack([found.q[:, : d - 1], gaps, margin, force])


def contact_chain(frames: ContactFrames, limits: Array, motion_weight: float) -> ContactChain:
    """Build the chain of frames on a wall.

    limits (T,): largest forces at a place, N. motion_weight: lambda, s^2.
    """
    problem = frames.problem
    robot = problem.robot
    count = problem.frames
    pieces = len(frames.states[0].pushes)
    d = robot.d
    inner = d - 1
    names = (*(f"phi_{i + 1}" for i in range(inner)), *robot.axes[inner:], "margin_shortfall", "force_excess")
    x = ca.vertcat(*map(ca.SX.sym, names))
    # Stands for functions of all unknowns that are known as numbers alone: solvers ask which depend on what.
    any_function = ca.sumsqr(x)
    infinite = np.full(pieces, np.inf)
    free = np.full(inner, np.inf)
    frame = Nlp(
        "frame on a wall",
        x,
        np.concatenate([-free, robot.lower[inner:], np.zeros(2)]),
        np.concatenate([free, robot.upper[inner:], np.full(2, np.inf)]),
        {},
        constraints=(
            Constraint("motors", ca.repmat(any_function, inner, 1), robot.lower[:inner], robot.upper[:inner]),
            Constraint(
                "gaps between tubes' ends", ca.diff(x[d : 2 * d]), np.zeros(inner), robot.max_extension_differences
            ),
            Constraint("stability margin", any_function, np.zeros(1), np.full(1, np.inf)),
            Constraint("force at a place", ca.repmat(any_function, pieces, 1), -infinite, np.zeros(pieces)),
        ),
        # Angles at the tip are picked along with q: links limit their steps, so that no frame is on another
        # branch.
        picks=(*range(2 * d + 4, 3 * d + 3), *range(inner, 2 * d + 2), *range(inner)),
        slacks=2,
    )
    low, high = (np.tile(bound, (count, 1)) for bound in frame.g_bounds)
    low[:, 2 * d - 2] = frames.margin
    high[:, 2 * d - 1 :] = limits[:, None]
    return ContactChain(
        frame,
        (*robot.axes, *names[:inner]),
        np.append(robot.mm_per_unit, robot.mm_per_unit[:inner]),
        np.zeros((0, count)),
        np.tile(frame.lower, (count, 1)),
        np.tile(frame.upper, (count, 1)),
        motion_links(robot, count, problem.dt, motion_weight, [], [], tip_step_limits(robot, problem.dt)[:inner]),
        lambda: frame.functions,
        constraint_bounds=(low, high),
        on_wall=frames,
    )


class ContactSolution(NamedTuple):
    """Equilibria of T frames at the end of a search.

    states (T,). costs (T,): of the frames, mm^2. kkt (T,): residuals of each frame, mm^2 per unit, whatever the
    solver reports; status: of the solver.
    """

    states: tuple[ContactState, ...]
    costs: Array
    kkt: Array
    status: str


def solve_contact_chain(
    chain: ContactChain,
    progress: Callable[[int, float], None] | None = None,
    least_gain: float = 0.0,
    stop: Callable[[], bool] = lambda: False,
) -> ContactSolution:
    """Solve a chain from the present equilibria of its frames.

    progress: called with the number of iterations and the objective after each. least_gain: part of the objective
    by which the last GAIN_ITERATIONS must have lowered it for the search to go on. stop: asked whether to end,
    after each iteration.
    """
    frames = chain.on_wall
    assert frames is not None
    assert chain.constraint_bounds is not None
    found = frames.values(frames.y)
    assert found is not None
    shortfall = np.maximum(frames.margin - found.margin, 0.0)
    excess = np.maximum(found.force.max(axis=1) - chain.constraint_bounds[1][:, -1], 0.0)

    reported = list[Iterate]()

    def report(iterate: Iterate) -> None:
        reported.append(iterate)
        if progress is not None:
            progress(iterate.number, iterate.objective)

    def is_done() -> bool:
        last = reported[-1]
        earlier = reported[-min(len(reported), GAIN_ITERATIONS)].objective
        gained = len(reported) < GAIN_ITERATIONS or earlier - last.objective >= least_gain * earlier
        slow = least_gain > 0 and not gained
        return stop() or slow or (last.error <= CONTACT_KKT_TOLERANCE and last.violation <= FEASIBILITY_TOLERANCE)

    soft = np.column_stack([shortfall, excess]) / SOFT_UNIT + SOFT_START
    solution = BandedSolver(chain)(
        np.hstack([frames.y, soft]).ravel(), Watch(report, is_done), WARM_START_BARRIER_MM2
    )
    multipliers = np.concatenate([solution.lam_x, solution.lam_g])
    kkt = np.nan_to_num(chain.kkt(solution.x, multipliers), nan=np.inf)
    return ContactSolution(tuple(frames.states), chain.by_frame(solution.x)[0], kkt, solution.status)
