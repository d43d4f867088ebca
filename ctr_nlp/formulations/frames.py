"""How one frame is asked for and answered, whatever solves it; and where a search without a past begins."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from ctr_nlp.robot import Robot
from ctr_nlp.support.sobol import sobol
from ctr_nlp.target.target import Frame
from ctr_nlp.typing import Array

DISTINCT = 1e-3
"""Two answers are distinct where their objectives differ by more than this part."""


@dataclass(frozen=True)
class FrameResult:
    """The configuration of one frame.

    q (2d + 2,), and where success is False the one to fall back to, never a solution. objective: mm^2.
    kkt: NaN for methods without multipliers. iterations: of the solver, or evaluations of the shape.
    status: the solver's own word. warm: what the next frame may start from, known to the solver only.
    x: the unknowns of a model whose q does not determine them.
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
    """Solves frames of one problem; these count from 0."""

    @property
    def build_seconds(self) -> float:
        """What building it took, s."""

    @property
    def description(self) -> dict[str, Any]:
        """For a plan's meta: formulation, model, solver, options."""

    def search(self, frame: int) -> list[FrameResult]:
        """Distinct answers for a frame without a past, best first; at least one."""

    def step(self, frame: int, before: FrameResult) -> FrameResult:
        """The answer for a frame within the robot's speed limits of the frame before."""

    def run(self, frames: Sequence[int], before: FrameResult) -> Iterator[tuple[FrameResult, float]]:
        """Answers for frames, each from the one before, and the seconds that each took."""


class Restartable(FrameSolver, Protocol):
    """One that can begin a run anew near to another one's answer."""

    def again(self, frame: int, known: FrameResult) -> FrameResult:
        """The answer for a frame without a past, near a known one."""


def distinct(results: Sequence[FrameResult]) -> list[FrameResult]:
    """Those of results whose objectives differ, best first."""
    found = list[FrameResult]()
    for result in sorted(results, key=lambda one: one.objective):
        if not found or result.objective > found[-1].objective * (1 + DISTINCT) + 1e-9:
            found.append(result)
    return found


def one_by_one(
    step: Callable[[int, FrameResult], FrameResult], frames: Sequence[int], before: FrameResult
) -> Iterator[tuple[FrameResult, float]]:
    """What FrameSolver.run gives, step by step."""
    for frame in frames:
        begin = time.perf_counter()
        before = step(frame, before)
        yield before, time.perf_counter() - begin


def starts(robot: Robot, target: Frame, count: int, seed: int = 0) -> Array:
    """Start configurations (count, 2d + 2) for a target without a past: Sobol points within the robot's limits.

    Without limits, angles of tubes span a full turn; tilts stay within 0.5 rad of the target's own.
    """
    d = robot.d
    unit = sobol(count, 2 * d + 2, seed)
    x, y, z = target.tangents[0]
    tilt = np.array([-np.arcsin(np.clip(y, -1, 1)), np.arctan2(x, z)])
    middle = np.concatenate([np.zeros(d), np.full(d, target.length / 2), tilt])
    spread = np.concatenate([np.full(d, np.pi), np.full(d, target.length / 2), np.full(2, 0.5)])
    lower, upper = (np.clip(middle + side * spread, robot.lower, robot.upper) for side in (-1, 1))
    q = lower + unit * (upper - lower)
    beta = np.maximum.accumulate(q[:, d : 2 * d], axis=1)
    beta[:, -1] = target.length
    q[:, d : 2 * d] = np.clip(beta, robot.lower[d : 2 * d], robot.upper[d : 2 * d])
    return q


def reachable(robot: Robot, previous: Array | None, dt: float) -> tuple[Array, Array]:
    """Lower and upper bounds of q: the robot's limits and, from a previous q, what its speed allows in dt s."""
    if previous is None:
        return robot.lower, robot.upper
    step = robot.speed * dt
    return np.maximum(robot.lower, previous - step), np.minimum(robot.upper, previous + step)
