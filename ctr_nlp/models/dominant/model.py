"""The dominant-stiffness model, eqs. (1)-(4), as a Model: its unknowns are q, and nothing can be unstable.

The geometry is in shape.py. Here it is arranged as a matrix product of lengths, which depend on beta and sigma,
and directions, which depend on q alone. q = (alpha, beta, theta) in rad and mm.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import casadi as ca
import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models.dominant import shape
from ctr_nlp.models.inner import Inner
from ctr_nlp.models.protocol import (
    Model,
    SampleArcLengths,
    SymbolicShape,
    combination,
    flatten_batch,
    matrix_of,
    vectors_of,
)
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import Structure, Tubes, tubes_of_batch
from ctr_nlp.typing import Array, Vector

MIN_STIFFNESS_RATIO = 1 + 1e-9
"""Least ratio of the bending stiffnesses of a tube and of one within it: equal but for rounding is not stiffer."""

MIN_PLANNING_STIFFNESS_RATIO = 3.0
"""Least ratio of the bending stiffnesses of a tube and of one within it, for plans. A tube within another takes
1 / (1 + ratio) of the bending, a quarter at a ratio of 3, which the model leaves out.
"""


DOMINANT_SHAPES_PER_CHUNK = 128
"""Number of shapes whose samples are computed in one batch: as many as fit into a processor's innermost cache."""


class Dominant(Model):
    """The paper's model: one shape for each q, curvatures independent of alpha, no torsion and no instability."""

    name = "dominant"
    bends_by_extension = True

    def check(self, robot: Robot) -> None:
        """Raise OptionError unless every tube of the robot is stiffer than each one within it.

        Only then does it set the curvature alone.
        """
        for i, j in _overlapping_pairs(robot):
            outer, inner = (robot.tubes[k].bending_stiffness for k in (i, j))
            if outer <= inner * MIN_STIFFNESS_RATIO:
                raise OptionError(
                    f"model is 'dominant', and tube {i + 1} is not stiffer than tube {j + 1} within it: their EI "
                    f"are {outer:.4g} and {inner:.4g}. Balanced tubes bend each other: use the elastic model, "
                    "--model elastic"
                )

    def check_planning(self, robot: Robot) -> None:
        """Raise OptionError unless every tube of the robot is at least 3 times as stiff as each one within it."""
        self.check(robot)
        for i, j in _overlapping_pairs(robot):
            outer, inner = (robot.tubes[k].bending_stiffness for k in (i, j))
            if outer < inner * MIN_PLANNING_STIFFNESS_RATIO * (1 - 1e-9):
                raise OptionError(
                    f"model is 'dominant', and tube {i + 1} is only {outer / inner:.3g} times as stiff as tube "
                    f"{j + 1} within it (EI {outer:.4g} and {inner:.4g}); plans need a ratio of at least "
                    f"{MIN_PLANNING_STIFFNESS_RATIO:g}. Below it the tubes bend each other, and the tip may be "
                    "centimetres off: use the elastic model, --model elastic"
                )

    def frame(
        self,
        structure: Structure,
        tubes: Tubes,
        sample_lengths: SampleArcLengths,
        margin: ca.SX | None = None,
        tangents: bool = False,
    ) -> SymbolicShape:
        """Build the shape of one frame in symbols, as Model.frame.

        structure, tubes, sample_lengths, tangents: as there. margin: ignored, since nothing can be unstable.
        """
        x = ca.SX.sym("q", 2 * structure.d + 2)
        d = structure.d
        q = ca.vertsplit(x)
        beta = q[d : 2 * d]
        # Three layers of inner quantities: lengths travelled on each tube (a row a sample), directions of
        # each tube's plane, and what the tangent gains on each tube.
        lengths = list[ca.SX]()
        turns = list[ca.SX]()
        for travel in shape.travels(tubes, beta, sample_lengths(beta), ca):
            lengths.append(ca.horzcat(*travel.lengths))
            turns += [ca.horzcat(*travel.gains(ca))] if tangents else []
        # One matrix (3, 2) or, of a helix, (3, 3) for each tube.
        planes = [matrix_of(plane) for plane in shape.directions(tubes, q, ca)]
        inner = Inner.of([*lengths, *planes, *turns])
        # Inner.symbols has d lengths, then d planes, then (with tangents) d turns.
        travelled, directed, turned = (inner.symbols[k * d : (k + 1) * d] for k in range(3))
        bends = [vector for plane in directed for vector in vectors_of(plane)]
        points = combination([column for each in travelled for column in ca.horzsplit(each)], bends)
        found = None
        if tangents:
            # The tangent at the base, which is the second direction of the first tube, plus the gains on
            # all tubes.
            found = combination([1.0, *(c for each in turned for c in ca.horzsplit(each))], [bends[1], *bends])
        return SymbolicShape(x, x[:d], tuple(beta), points, inner, found)

    def points(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """Return points (T, n, 3) in mm of a robot at x (T, 2d + 2), which is q, and sigma (n,) or (T, n)."""
        return _points(robot.tube_numbers, x, sigma)

    def points_batch(self, structure: Structure, numbers: Array, x: Array, sigma: Array) -> Array:
        """Return points (n, T, m, 3) in mm of robots that differ in numbers (n, d, 8), each at x (n, T, 2d + 2).

        structure: what the robots share. sigma: (m,) or (T, m).
        """
        tubes, each, sigma = flatten_batch(numbers, x, sigma)
        points = np.empty((len(each), np.shape(sigma)[-1], 3))
        for at in (
            slice(first, first + DOMINANT_SHAPES_PER_CHUNK)
            for first in range(0, len(each), DOMINANT_SHAPES_PER_CHUNK)
        ):
            own = sigma[at] if np.ndim(sigma) > 1 else sigma
            points[at] = _points(tubes_of_batch(structure, tubes[at]), each[at], own)
        return points.reshape(*x.shape[:2], *points.shape[1:])

    def tangents(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """Return unit tangents (T, n, 3) of a robot at x (T, 2d + 2), which is q, and sigma (n,) or (T, n)."""
        return _stack_components(shape.backbone(robot.tube_numbers, shape.columns_of(x), sigma, np).tangents)


def _overlapping_pairs(robot: Robot) -> Iterator[tuple[int, int]]:
    """Yield the numbers, from 0, of an outer and an inner tube that can be out together, unless both are straight.

    Tubes that are both straight have one shape, whichever of them is stiffer.
    """
    for i, j in itertools.combinations(range(robot.d), 2):
        curved = any(robot.tubes[k].largest_curvature > 0 for k in (i, j))
        if curved and robot.max_extensions[i] > 0:
            yield i, j


def _points(tubes: Tubes, q: Array, sigma: Array) -> Array:
    """Return points (T, n, 3) in mm at q (T, 2d + 2): lengths travelled on tubes times directions.

    tubes: with numbers, or columns (T, 1) of numbers. sigma: (n,) or (T, n).
    """
    columns = shape.columns_of(q)
    d = len(tubes)
    travelled = shape.travels(tubes, columns[d : 2 * d], sigma * columns[2 * d - 1], np)
    planes = shape.directions(tubes, columns, np)
    lengths = np.stack([part for travel in travelled for part in travel.lengths], axis=1)
    vectors = np.stack([_stack_components(vector)[:, 0] for plane in planes for vector in plane], axis=1)
    # (T, n, k) times (T, k, 3): one batched product for all samples of all shapes.
    return np.asarray(lengths.swapaxes(1, 2) @ vectors)


def _stack_components(vector: Vector) -> Array:
    """x, y and z as the last axis of one array."""
    return np.stack(np.broadcast_arrays(*vector), axis=-1)
