"""What the reference methods share: extensions that cannot break limits, and L-BFGS-B on batches."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from ctr_nlp.ocp.frame_solver import FrameResult, sobol_starts, step_through_frames
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

Method = Callable[[Frame, Array, FrameResult | None], FrameResult]
"""(frame, guess q, what was found for the frame before, or None) -> result."""

REFERENCE_SEARCH_STARTS = 32
REFERENCE_DIFFERENCE_STEP = 1e-7
"""Forward difference of a gradient, in units of the variables."""

MAX_RELATIVE_PROJECTED_GRADIENT = 1e-2
"""Largest projected gradient at a minimum, as a part of the cost (or of 1 mm^2)."""


class ReferenceFrames:
    """A FrameSolver around a reference method."""

    def __init__(self, problem: Problem, name: str, model: str, method: Method, options: dict[str, Any]) -> None:
        """Wrap a method for the frames of a problem; options go into the plan's meta."""
        self.problem = problem
        self._method = method
        self.build_seconds = 0.0
        self.description: dict[str, Any] = {
            "formulation": name,
            "model": model,
            "solver": "scipy",
            "options": options,
        }

    def search(self, frame: int) -> list[FrameResult]:
        """Answers for a frame without a past, best first."""
        sample = self.problem.target_frames[frame]
        guesses = sobol_starts(self.problem.robot, sample, REFERENCE_SEARCH_STARTS)
        results = [self._method(sample, guess, None) for guess in guesses]
        return sorted(results, key=lambda r: (not r.success, r.objective))[:1]

    def step(self, frame: int, before: FrameResult) -> FrameResult:
        """The answer for a frame, from the one before it."""
        return self._method(self.problem.target_frames[frame], before.q, before)

    def run(self, frames: Sequence[int], before: FrameResult) -> Iterator[tuple[FrameResult, float]]:
        """Answers for frames, each from the one before it, and the seconds that each took."""
        return step_through_frames(self.step, frames, before)


def extensions(robot: Robot, fractions: Array, last: Array | None = None) -> Array:
    """Beta (.., d) from fractions (.., d) of the room that limits and the next inner tube leave each tube.

    last: beta_d (..,), where it is given; fractions then are (.., d - 1). Box bounds [0, 1] on fractions
    are all that L-BFGS-B needs to keep eqs. (2) and (3).
    """
    lower, upper = (robot.split(limit)[1] for limit in (robot.lower, robot.upper))
    beta = np.empty((*fractions.shape[:-1], robot.d))
    room = np.full(fractions.shape[:-1], np.inf)
    for i in reversed(range(robot.d)):
        highest = np.minimum(upper[i], room)
        if i == robot.d - 1 and last is not None:
            beta[..., i] = last
        else:
            beta[..., i] = lower[i] + fractions[..., i] * np.maximum(highest - lower[i], 0)
        room = beta[..., i]
    return beta


def fractions(robot: Robot, beta: Array) -> Array:
    """The inverse of extensions for beta (d,), clipped to [0, 1]."""
    lower, upper = (robot.split(limit)[1] for limit in (robot.lower, robot.upper))
    room = np.minimum(upper, np.append(beta[1:], np.inf)) - lower
    return np.clip((beta - lower) / np.where(room > 0, room, 1.0), 0.0, 1.0)


def clip_extensions(robot: Robot, beta: Array) -> Array:
    """The nearest extensions (.., d) entry by entry that keep limits, order and gap; outer tubes give way.

    Keeping them twice changes nothing more.
    """
    low = np.maximum.accumulate(robot.split(robot.lower)[1])
    kept = np.clip(beta, low, robot.max_extensions)
    for i in reversed(range(robot.d - 1)):
        inner = kept[..., i + 1]
        kept[..., i] = np.clip(kept[..., i], np.maximum(low[i], inner - robot.max_extension_differences[i]), inner)
    return kept


def clip_configuration(robot: Robot, q: Array) -> Array:
    """The nearest configurations (.., 2d + 2) entry by entry that keep all limits of position."""
    alpha, beta, theta = robot.split(np.clip(q, robot.lower, robot.upper))
    return np.concatenate([alpha, clip_extensions(robot, beta), theta], axis=-1)


class Descent(NamedTuple):
    """Where a search ended: at variables (n,), of which the objective is the cost.

    success: scipy's word, or a projected gradient within MAX_RELATIVE_PROJECTED_GRADIENT of the cost; evaluations:
    of single points.
    """

    variables: Array
    objective: float
    success: bool
    evaluations: int
    status: str


def descend(cost: Callable[[Array], Array], initial_guess: Array, bounds: Array) -> Descent:
    """L-BFGS-B on cost: (B, n) -> (B,), whose gradient is one batch of forward differences.

    Where its line search gives up on them, once more with central differences. bounds (n, 2).
    """

    def forward(x: Array) -> tuple[float, Array]:
        steps = np.where(
            x + REFERENCE_DIFFERENCE_STEP > bounds[:, 1], -REFERENCE_DIFFERENCE_STEP, REFERENCE_DIFFERENCE_STEP
        )
        values = cost(np.vstack([x, x + np.diag(steps)]))
        return float(values[0]), (values[1:] - values[0]) / steps

    def central(x: Array) -> tuple[float, Array]:
        ahead, behind = (
            np.clip(x + sign * 10 * REFERENCE_DIFFERENCE_STEP * np.eye(len(x)), *bounds.T) for sign in (1, -1)
        )
        values = cost(np.vstack([x, ahead, behind]))
        spans = np.diag(ahead - behind)
        rises = values[1 : len(x) + 1] - values[len(x) + 1 :]
        return float(values[0]), np.where(spans > 0, rises / np.where(spans > 0, spans, 1.0), 0.0)

    x = np.clip(initial_guess, bounds[:, 0], bounds[:, 1])
    evaluations = 0
    for gradient, points in ((forward, len(x) + 1), (central, 2 * len(x) + 1)):
        result = minimize(gradient, x, jac=True, method="L-BFGS-B", bounds=bounds)
        x = result.x
        evaluations = evaluations + result.nfev * points
        if result.success:
            break
    flat = np.abs(x - np.clip(x - result.jac, bounds[:, 0], bounds[:, 1])).max(initial=0.0)
    success = bool(result.success or flat <= MAX_RELATIVE_PROJECTED_GRADIENT * max(1.0, result.fun))
    return Descent(x, float(result.fun), success, evaluations, str(result.message))


def shape_error(shape: tuple[Any, Any, Any], target: Array, weights: Array) -> Array:
    """Weighted mean square distance (B,) in mm^2 between batches of points, x, y, z (B, n), and (n, 3)."""
    return sum(((shape[i] - target[:, i]) ** 2 for i in range(3)), np.zeros(1)) @ weights


def motion_term(robot: Robot, q: Array, before: FrameResult | None, weight: float) -> Array | float:
    """Motion term: weight |W (q - q before)|^2 in mm^2 of a batch q (B, 2d + 2); 0 without a frame before."""
    return 0.0 if before is None else weight * (((q - before.q) * robot.mm_per_unit) ** 2).sum(axis=-1)
