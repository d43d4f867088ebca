"""Shared parts of the reference methods: extensions within limits by construction, and L-BFGS-B on batches.

The paper minimises by L-BFGS-B, which knows bounds and no other constraints. So eqs. (2) and (3), beta_i <=
beta_{i+1} and gamma_l,i <= beta_i <= gamma_r,i, are kept by a change of variables: fractions in [0, 1] of the room
that each tube has (`extensions`). The paper does not say how it keeps them. Gradients are finite differences of
one vectorised evaluation; the paper's are not described.
"""

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
"""(frame, initial guess q (2d + 2,), result of the frame before or None) -> result."""

REFERENCE_SEARCH_STARTS = 32
"""Starts of the search for a frame without a previous one."""
REFERENCE_DIFFERENCE_STEP = 1e-7
"""Forward difference of a gradient, in units of the variables."""

MAX_RELATIVE_PROJECTED_GRADIENT = 1e-2
"""Largest projected gradient at a minimum, relative to the cost (or to 1 mm^2, if that is larger)."""


class ReferenceFrames:
    """A FrameSolver around a reference method."""

    def __init__(self, problem: Problem, name: str, model: str, method: Method, options: dict[str, Any]) -> None:
        """Wrap a method for the frames of a problem.

        name: of the method; model: of the kinematic model; options: of the settings; all three go into the plan's
        metadata.
        """
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
        """Return the best result for a frame, counted from 0, without a previous one; a list of one."""
        sample = self.problem.target_frames[frame]
        guesses = sobol_starts(self.problem.robot, sample, REFERENCE_SEARCH_STARTS)
        results = [self._method(sample, guess, None) for guess in guesses]
        # One result only: published methods go forward from a single start, and try no second branch later.
        return sorted(results, key=lambda r: (not r.success, r.objective))[:1]

    def step(self, frame: int, before: FrameResult) -> FrameResult:
        """Return the result for a frame, counted from 0, from `before`, that of the frame before."""
        return self._method(self.problem.target_frames[frame], before.q, before)

    def run(self, frames: Sequence[int], before: FrameResult) -> Iterator[tuple[FrameResult, float]]:
        """Yield the results of `frames`, counted from 0, and the seconds that each took.

        Each starts from the one before it, the first from `before`.
        """
        return step_through_frames(self.step, frames, before)


def extensions(robot: Robot, fractions: Array, last: Array | None = None) -> Array:
    """Compute extensions beta (.., d) in mm from fractions of the room that limits and the next tube leave.

    robot: of d tubes. fractions: (.., d) in [0, 1]; box bounds on these are all that L-BFGS-B needs to keep eqs.
    (2) and (3). last: beta_d (..,) in mm, where it is given; fractions then are (.., d - 1). A carriage gap is not
    kept (see `clip_extensions`).
    """
    lower, upper = (robot.split(limit)[1] for limit in (robot.lower, robot.upper))
    beta = np.empty((*fractions.shape[:-1], robot.d))
    room = np.full(fractions.shape[:-1], np.inf)
    # From the innermost tube outwards: beta_{i+1} bounds beta_i from above, eq. (2).
    for i in reversed(range(robot.d)):
        highest = np.minimum(upper[i], room)
        if i == robot.d - 1 and last is not None:
            beta[..., i] = last
        else:
            # No room, where the inner tube is less far out than this one's lower limit: the limit counts.
            beta[..., i] = lower[i] + fractions[..., i] * np.maximum(highest - lower[i], 0)
        room = beta[..., i]
    return beta


def fractions(robot: Robot, beta: Array) -> Array:
    """Compute the fractions (d,), clipped to [0, 1], at which `extensions` gives beta (d,) in mm.

    robot: whose limits bound the room of each tube.
    """
    lower, upper = (robot.split(limit)[1] for limit in (robot.lower, robot.upper))
    room = np.minimum(upper, np.append(beta[1:], np.inf)) - lower
    # Without room every fraction gives the same extension; 1.0 only avoids 0 / 0.
    return np.clip((beta - lower) / np.where(room > 0, room, 1.0), 0.0, 1.0)


def clip_extensions(robot: Robot, beta: Array) -> Array:
    """Clip extensions entry by entry to limits, order and carriage gap; outer tubes give way to inner ones.

    robot: whose limits and gap count. beta: (.., d) in mm; the result has the same shape. The function is
    idempotent.
    """
    # An inner tube is at least as far out as the least that any outer one may be.
    low = np.maximum.accumulate(robot.split(robot.lower)[1])
    kept = np.clip(beta, low, robot.max_extensions)
    for i in reversed(range(robot.d - 1)):
        inner = kept[..., i + 1]
        kept[..., i] = np.clip(kept[..., i], np.maximum(low[i], inner - robot.max_extension_differences[i]), inner)
    return kept


def clip_configuration(robot: Robot, q: Array) -> Array:
    """Clip configurations entry by entry to all limits of position.

    robot: whose limits count. q: (.., 2d + 2) in rad, mm and rad; the result has the same shape.
    """
    alpha, beta, theta = robot.split(np.clip(q, robot.lower, robot.upper))
    return np.concatenate([alpha, clip_extensions(robot, beta), theta], axis=-1)


class Descent(NamedTuple):
    """Result of a search: the variables (n,) at which it ended, and the cost there.

    success: scipy reports convergence, or the projected gradient is within MAX_RELATIVE_PROJECTED_GRADIENT.
    evaluations: number of single points at which the cost was evaluated. status: scipy's message.
    """

    variables: Array
    objective: float
    success: bool
    evaluations: int
    status: str


def descend(cost: Callable[[Array], Array], initial_guess: Array, bounds: Array) -> Descent:
    """Minimise a cost by L-BFGS-B, with one batch of forward differences as its gradient.

    cost: variables (B, n) -> costs (B,). initial_guess: (n,), clipped to the bounds. bounds: (n, 2), lower and
    upper; infinite where there are none. Where the line search fails on forward differences, the search continues
    with central ones.
    """

    def forward(x: Array) -> tuple[float, Array]:
        # Backward at an upper bound: a fraction above 1 would put tubes out of order, where costs mean nothing.
        steps = np.where(
            x + REFERENCE_DIFFERENCE_STEP > bounds[:, 1], -REFERENCE_DIFFERENCE_STEP, REFERENCE_DIFFERENCE_STEP
        )
        values = cost(np.vstack([x, x + np.diag(steps)]))
        return float(values[0]), (values[1:] - values[0]) / steps

    def central(x: Array) -> tuple[float, Array]:
        # Truncation errs by h^2 instead of h, so that h may be ten times larger and rounding ten times less.
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
    # Near a minimum the differences are mostly rounding, and scipy reports a failed line search at a point that is
    # one. |x - clip(x - g)| is the first-order condition with bounds: it does not count descent out of the box.
    flat = np.abs(x - np.clip(x - result.jac, bounds[:, 0], bounds[:, 1])).max(initial=0.0)
    success = bool(result.success or flat <= MAX_RELATIVE_PROJECTED_GRADIENT * max(1.0, result.fun))
    return Descent(x, float(result.fun), success, evaluations, str(result.message))


def shape_error(shape: tuple[Any, Any, Any], target: Array, weights: Array) -> Array:
    """Compute the mean square distances (B,) in mm^2 of shapes from a target, eq. (8).

    shape: x, y and z of B shapes, (B, n) each, mm. target: (n, 3), mm. weights: (n,), of the points; their sum is
    1.
    """
    return sum(((shape[i] - target[:, i]) ** 2 for i in range(3)), np.zeros(1)) @ weights


def motion_term(robot: Robot, q: Array, before: FrameResult | None, weight: float) -> Array | float:
    """Compute the motion term of eq. (9), weight |W (q - q_before)|^2 in mm^2, (B,); 0 without a frame before.

    robot: whose mm_per_unit is W, 10 mm/rad for angles and 1 for beta. q: (B, 2d + 2). before: result of the frame
    before. weight: lambda / dt^2, without unit.
    """
    return 0.0 if before is None else weight * (((q - before.q) * robot.mm_per_unit) ** 2).sum(axis=-1)
