"""What a network is trained on: how far the shape that the model makes of its output is from the one given."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.codegen.batch_evaluator import BatchEvaluator
from ctr_nlp.models.protocol import Model, build_sample_function
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array
from reference.descent import clip_extensions
from reference.learned.samples import NETWORK_INPUT_SIGMA, ShapeBatch

NETWORK_EXTENSION_PENALTY = 1.0
"""mm of loss for a mm by which an extension leaves its limits. The root mean square distance changes by less than
that, so that leaving them never pays."""
NETWORK_DISTANCE_SMOOTHING_MM = 1e-3
"""mm whose square is added to the mean square distance, for a gradient where that is 0."""


class ShapeLoss:
    """The mean over shapes of the root mean square distance, mm, plus what leaving limits of extensions costs."""

    def __init__(self, torch: Any, robot: Robot, model: Model, count: int) -> None:
        """Prepare the loss of `count` shapes at a time; `torch` is the module."""
        self._torch = torch
        self._robot = robot
        self._distances = _differentiable(torch, BatchEvaluator(build_shape_distance(robot, model), count))
        self._unknowns = torch.tensor(model.guess(robot, np.eye(2 * robot.d + 2)))  # a guess is linear in q

    def __call__(self, output: Any, shapes: ShapeBatch) -> Any:
        """Return the loss of a network's output (count, 3d - 1) for as many shapes.

        Extensions are brought within limits before the model sees them, and their gradient passes unchanged.
        """
        torch = self._torch
        d = self._robot.d
        cos, sin, parts = output.double().split([d, d, d - 1], dim=1)
        length = torch.from_numpy(shapes.length)[:, None]
        beta = torch.cat([parts * length, length], dim=1)
        kept = torch.from_numpy(clip_extensions(self._robot, beta.detach().numpy()))
        away = beta - kept
        upright = torch.zeros(len(beta), 2, dtype=beta.dtype)
        tips = torch.cat([torch.atan2(sin, cos), beta - away.detach(), upright], dim=1)
        distances = self._distances(tips @ self._unknowns, shapes.points)
        return distances.mean() + NETWORK_EXTENSION_PENALTY * away.abs().sum(dim=1).mean()


def build_shape_distance(robot: Robot, model: Model) -> ca.Function:
    """Build (x (2d + 2,), points (60,)) -> RMS distance of the shape at x in mm, and its gradient over x."""
    x = ca.SX.sym("x", 2 * robot.d + 2)
    points = ca.SX.sym("points", 3 * len(NETWORK_INPUT_SIGMA))
    found = build_sample_function(model, robot.structure, len(NETWORK_INPUT_SIGMA))(
        x, NETWORK_INPUT_SIGMA, robot.numbers, []
    )[0]
    squares = ca.sumsqr(ca.reshape(points, 3, len(NETWORK_INPUT_SIGMA)).T - found) / len(NETWORK_INPUT_SIGMA)
    value = ca.sqrt(squares + NETWORK_DISTANCE_SMOOTHING_MM**2)
    return ca.Function("distance", [x, points], [value, ca.gradient(value, x)], {"cse": True})


def _differentiable(torch: Any, distances: BatchEvaluator) -> Any:
    """Return (x (count, 2d + 2), points (count, 20, 3)) -> distances (count,) that torch differentiates by x."""

    class Distance(torch.autograd.Function):
        @staticmethod
        def forward(context: Any, x: Any, points: Array) -> Any:
            distances.inputs[1][:] = points.reshape(len(points), -1)
            value, gradient = distances(x.detach().numpy().ravel())
            context.save_for_backward(torch.from_numpy(gradient.copy()))
            return torch.from_numpy(value[:, 0].copy())

        @staticmethod
        def backward(context: Any, weights: Any) -> tuple[Any, None]:
            (gradient,) = context.saved_tensors
            return weights[:, None] * gradient, None

    return Distance.apply
