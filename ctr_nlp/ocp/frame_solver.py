"""The interface of solvers of single frames, and initial guesses for a search without a previous frame.

Steering frame by frame is the paper's eq. (6): q(t) for the target of time t, from the configuration before it.
Configurations q (2d + 2,) are in rad and mm, objectives in mm^2, times in s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from ctr_nlp.paths.target import Frame
from ctr_nlp.robot import Robot
from ctr_nlp.support.sobol import sobol
from ctr_nlp.typing import Array

MIN_RELATIVE_OBJECTIVE_DIFFERENCE = 1e-3
"""Relative difference from which on the objectives of two solutions count as distinct."""


@dataclass(frozen=True)
class FrameResult:
    """The configuration found for one frame.

    q (2d + 2,): the solution, or, where success is False, a fallback that is no solution. objective: mm^2. kkt:
    NaN for methods without multipliers. iterations: of the solver, or evaluations of the shape. status: the
    solver's own message. warm: warm start for the next frame, in a form known to the solver only. x: the unknowns
    of a model whose q does not determine them.
    """

    q: Array
    success: bool = True
    objective: float = np.nan
    kkt: float = np.nan
    iterations: int = 0
    status: str = ""
    warm: Any = field(default=None, repr=False)
    x: Array | None = None


class FrameSolver(Protocol):
    """Solver of the frames of one problem, which count from 0."""

    @property
    def build_seconds(self) -> float:
        """Seconds that building the solver took."""

    @property
    def description(self) -> dict[str, Any]:
        """Metadata of plans: formulation, model, solver, options."""

    def search(self, frame: int) -> list[FrameResult]:
        """Return distinct solutions of a frame without a frame before it, best first; at least one."""

    def step(self, frame: int, before: FrameResult) -> FrameResult:
        """Return the solution of a frame within the robot's speed limits of the frame before."""

    def run(self, frames: Sequence[int], before: FrameResult) -> Iterator[tuple[FrameResult, float]]:
        """Yield solutions of frames, each within reach of the one before, and the seconds that each took."""


class Restartable(FrameSolver, Protocol):
    """A frame solver that can restart a run near a known solution."""

    def search_near(self, frame: int, known: FrameResult) -> FrameResult:
        """Return the solution of a frame without a frame before it, near a known one."""


def distinct_results(results: Sequence[FrameResult]) -> list[FrameResult]:
    """Return the results whose objectives differ by more than MIN_RELATIVE_OBJECTIVE_DIFFERENCE, best first."""
    found = list[FrameResult]()
    for result in sorted(results, key=lambda one: one.objective):
        # 1e-9 mm^2: objectives that are 0 but for rounding are the same.
        if not found or result.objective > found[-1].objective * (1 + MIN_RELATIVE_OBJECTIVE_DIFFERENCE) + 1e-9:
            found.append(result)
    return found


def step_through_frames(
    step: Callable[[int, FrameResult], FrameResult], frames: Sequence[int], before: FrameResult
) -> Iterator[tuple[FrameResult, float]]:
    """Yield the solutions of frames by a solver's `step`, one after another, and their seconds.

    before: the result before the first of them.
    """
    for frame in frames:
        begin = time.perf_counter()
        before = step(frame, before)
        yield before, time.perf_counter() - begin


def sobol_starts(robot: Robot, target: Frame, count: int, seed: int = 0) -> Array:
    """Return initial guesses (count, 2d + 2) for a target: Sobol points of a seed within the robot's limits.

    Without limits, angles of tubes span a full turn; tilts stay within 0.5 rad of the target's own.
    """
    d = robot.d
    unit = sobol(count, 2 * d + 2, seed)
    # The tilt that points the base along the target's first tangent: R_y R_x e_z = (sin(ty) cos(tx),
    # -sin(tx), cos(ty) cos(tx)), eq. (4).
    x, y, z = target.tangents[0]
    tilt = np.array([-np.arcsin(np.clip(y, -1, 1)), np.arctan2(x, z)])
    middle = np.concatenate([np.zeros(d), np.full(d, target.length / 2), tilt])
    # Half widths of the box around `middle`: pi for alpha, half of the target's length for beta, 0.5 rad
    # for the tilt.
    spread = np.concatenate([np.full(d, np.pi), np.full(d, target.length / 2), np.full(2, 0.5)])
    lower, upper = (np.clip(middle + side * spread, robot.lower, robot.upper) for side in (-1, 1))
    q = lower + unit * (upper - lower)
    # Eq. (2): extensions must not decrease from tube to tube, and the innermost is as long as the target.
    beta = np.maximum.accumulate(q[:, d : 2 * d], axis=1)
    beta[:, -1] = target.length
    q[:, d : 2 * d] = np.clip(beta, robot.lower[d : 2 * d], robot.upper[d : 2 * d])
    return q


def reachable_bounds(robot: Robot, previous: Array | None, dt: float) -> tuple[Array, Array]:
    """Return lower and upper bounds of q: a robot's limits and, from a previous q, its speed limits over dt s."""
    if previous is None:
        return robot.lower, robot.upper
    step = robot.speed * dt
    # Eq. (3) and the speed limits as one box around the frame before.
    return np.maximum(robot.lower, previous - step), np.minimum(robot.upper, previous + step)
