"""Loss of the network's training: distance between the shape at its output and the shape at its input.

In S2J-IK (Liang et al. 2022, the paper's [7]) the residual of the shape is propagated back through a forward model
that was learned from data. What differs: here the forward model is one of this package, differentiated by CasADi,

    loss = mean over shapes of sqrt(mean_k |p_k(x) - p_k|^2 + eps^2)  +  penalty sum_i |beta_i - clip(beta_i)|

with p_k the 20 given points, x the model's unknowns at the network's output, eps a smoothing length in mm, and
clip the projection of extensions onto their limits. PyTorch differentiates all but the model.
"""

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
"""Loss, mm, for each mm by which an extension leaves its limits. The root mean square distance changes by less,
so that leaving them never pays."""
NETWORK_DISTANCE_SMOOTHING_MM = 1e-3
"""Length eps, mm, whose square is added to the mean square distance, so that its root has a gradient at 0."""


class ShapeLoss:
    """Mean over shapes of the root mean square distance, mm, plus a penalty for extensions beyond their limits."""

    def __init__(self, torch: Any, robot: Robot, model: Model, count: int) -> None:
        """Prepare the loss of `count` shapes at a time of a robot on a model; `torch` is the module."""
        self._torch = torch
        self._robot = robot
        self._distances = _differentiable(torch, BatchEvaluator(build_shape_distance(robot, model), count))
        self._unknowns = torch.tensor(model.guess(robot, np.eye(2 * robot.d + 2)))  # a guess is linear in q

    def __call__(self, output: Any, shapes: ShapeBatch) -> Any:
        """Return the loss, mm, of a network's output (count, 3d - 1) for as many shapes.

        The columns are cos and sin of d angles and d - 1 extensions as parts of the length. Extensions are
        clipped to their limits before the model is evaluated; their gradient passes unchanged.
        """
        torch = self._torch
        d = self._robot.d
        cos, sin, parts = output.double().split([d, d, d - 1], dim=1)
        length = torch.from_numpy(shapes.length)[:, None]
        beta = torch.cat([parts * length, length], dim=1)
        kept = torch.from_numpy(clip_extensions(self._robot, beta.detach().numpy()))
        away = beta - kept
        # Straight-through: `beta - away.detach()` has the value of the clipped extensions and the gradient of
        # beta. A clipped extension would have no gradient, and training could not move it.
        upright = torch.zeros(len(beta), 2, dtype=beta.dtype)
        tips = torch.cat([torch.atan2(sin, cos), beta - away.detach(), upright], dim=1)
        distances = self._distances(tips @ self._unknowns, shapes.points)
        return distances.mean() + NETWORK_EXTENSION_PENALTY * away.abs().sum(dim=1).mean()


def build_shape_distance(robot: Robot, model: Model) -> ca.Function:
    """Build the function of the RMS distance between a robot's shape and given points, with its gradient.

    It maps unknowns x (2d + 2,) and points (60,), x, y, z of one after the other in mm, to the distance in mm and
    its gradient over x (2d + 2,). robot: whose tubes' numbers are constants of it. model: of the shape.
    """
    x = ca.SX.sym("x", 2 * robot.d + 2)
    points = ca.SX.sym("points", 3 * len(NETWORK_INPUT_SIGMA))
    found = build_sample_function(model, robot.structure, len(NETWORK_INPUT_SIGMA))(
        x, NETWORK_INPUT_SIGMA, robot.numbers, []
    )[0]
    squares = ca.sumsqr(ca.reshape(points, 3, len(NETWORK_INPUT_SIGMA)).T - found) / len(NETWORK_INPUT_SIGMA)
    value = ca.sqrt(squares + NETWORK_DISTANCE_SMOOTHING_MM**2)
    return ca.Function("distance", [x, points], [value, ca.gradient(value, x)], {"cse": True})


def _differentiable(torch: Any, distances: BatchEvaluator) -> Any:
    """Wrap distances as a function that torch differentiates by x.

    It maps x (count, 2d + 2) and points (count, 20, 3), mm, to distances (count,), mm.
    """

    class Distance(torch.autograd.Function):
        @staticmethod
        def forward(context: Any, x: Any, points: Array) -> Any:
            distances.inputs[1][:] = points.reshape(len(points), -1)
            value, gradient = distances(x.detach().numpy().ravel())
            # Copies: the evaluator returns views of buffers, which its next call overwrites.
            context.save_for_backward(torch.from_numpy(gradient.copy()))
            return torch.from_numpy(value[:, 0].copy())

        @staticmethod
        def backward(context: Any, weights: Any) -> tuple[Any, None]:
            (gradient,) = context.saved_tensors
            return weights[:, None] * gradient, None

    return Distance.apply
