"""The distance between the robot's shape and its target, eq. (8), at equal sigma = s / beta_d.

The integral over sigma is a sum over samples with trapezoidal weights; residuals carry the weights' square roots
and are in mm.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.nlp import Residual
from ctr_nlp.ocp.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.paths.target import SIGMA_GRID, Frame
from ctr_nlp.robot.structure import Structure
from ctr_nlp.support.value_checks import floats
from ctr_nlp.typing import Array, Vector

TARGET_SAMPLE_STRIDE = 5
"""By default every so many-th of the target's 101 samples enters a program, 21 in all."""


def shape_residual(points: Vector, target: Vector, root: Any) -> Residual:
    """Return the distance from the robot to its target at equal sigma, eq. (8), as residuals.

    points, target: x, y, z, each (n, 1) mm. root: square roots (n, 1) of quadrature weights.
    """
    return Residual("shape", ca.vertcat(*(root * (points[i] - target[i]) for i in range(3))))


@dataclass(frozen=True, eq=False)
class ShapeDistance(Term):
    """The mean over sigma of |C - C_target|^2, mm^2, eq. (8).

    depth_weights (101,): how much each of the uniform sigma counts, >= 0; they are scaled to mean 1. None: all
    alike. stride: every so many-th of the 101 samples counts. Raises OptionError.
    """

    depth_weights: Array | None = None
    stride: int = TARGET_SAMPLE_STRIDE
    name = "shape"
    objective_only = True

    def __post_init__(self) -> None:
        if self.depth_weights is not None:
            weights = floats(OptionError, "depth_weights", self.depth_weights, (len(SIGMA_GRID),))
            if weights.min() < 0 or weights.max() <= 0:
                raise OptionError("depth_weights has numbers below 0, or none above; give weights >= 0")
            # The dataclass is frozen; the checked array replaces what was given.
            object.__setattr__(self, "depth_weights", weights)

    @property
    def key(self) -> Hashable:
        """The type and the stride; weights are parameters."""
        return type(self), self.stride

    def sample_arc_lengths(self, beta: Sequence[ca.SX]) -> ca.SX:
        """Return the arc lengths of every stride-th of the uniform sigma, mm, at extensions beta in mm."""
        return ca.DM(SIGMA_GRID[:: self.stride]) * beta[-1]

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return the shapes of the target's points, mm, and of square roots of quadrature weights.

        structure: not used.
        """
        count = len(SIGMA_GRID[:: self.stride])
        return {"target": (count, 3), "shape_roots": (count, 1)}

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return the residual of eq. (8) on body, in the model's own axes; parameters: symbols by name."""
        # Distances do not depend on axes: turning the target's points into the model's costs fewer
        # operations.
        seen = body.shape.to_shape_axes(parameters["target"])
        return Parts(residuals=(shape_residual(body.own_points, seen, parameters["shape_roots"]),))

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Return the frame's points, mm, and the square roots of the weights."""
        return {"target": frame.points[:: self.stride], "shape_roots": self.roots}

    @cached_property
    def roots(self) -> Array:
        """Square roots (n,) of trapezoidal weights times depth weights; the squares sum to 1."""
        weights = np.full(len(SIGMA_GRID[:: self.stride]), self.stride / (len(SIGMA_GRID) - 1))
        # Trapezoidal rule: half a cell at both ends.
        weights[[0, -1]] /= 2
        if self.depth_weights is not None:
            weights = weights * self.depth_weights[:: self.stride]
            # The squares of the roots sum to 1 again, so that the motion weight keeps its meaning beside
            # weighted distances.
            weights = weights / weights.sum()
        roots: Array = np.sqrt(weights)
        return roots
