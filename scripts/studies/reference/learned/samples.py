"""Training shapes of S2J-IK: stable shapes of a robot on a model, normalised for the network's input.

Liang et al. 2022 (the paper's [7]) captured data from a robot. What differs: shapes are computed by a model, at
random angles of the tubes' tips and random extensions, and only stable ones are kept. Symmetries are removed: a
shape has no tilt, and is turned about +z so that it bends towards +x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array
from reference.descent import clip_extensions, extensions

NETWORK_INPUT_SIGMA = SIGMA_GRID[5::5]
"""Normalised arc lengths (20,) of the points of a network's input."""
MIN_TRAINING_STABILITY_MARGIN = 0.1
"""Least stability margin of sampled shapes."""


@dataclass(frozen=True)
class ShapeBatch:
    """Shapes without tilt: points (n, 20, 3) at NETWORK_INPUT_SIGMA and lengths (n,), mm."""

    points: Array
    length: Array

    def __getitem__(self, rows: Any) -> ShapeBatch:
        return ShapeBatch(self.points[rows], self.length[rows])

    def align_with_x(self) -> tuple[ShapeBatch, Array]:
        """Turn each shape about +z so that the mean of its points lies towards +x.

        Returns the turned shapes and the angles (n,), rad, at which the means were. Turning all tubes turns the
        shape: with this symmetry removed, the network need not learn it.
        """
        x, y, z = np.moveaxis(self.points, -1, 0)
        angle = np.arctan2(y.mean(axis=1), x.mean(axis=1))
        c = np.cos(angle)[:, None]
        s = np.sin(angle)[:, None]
        return ShapeBatch(np.stack([c * x + s * y, c * y - s * x, z], axis=-1), self.length), angle

    def network_inputs(self) -> Array:
        """Return a network's inputs (n, 61): the points relative to the length, and the length in mm."""
        parts = self.points / self.length[:, None, None]
        return np.column_stack([parts.reshape(len(parts), -1), self.length])


def sample_stable_unknowns(robot: Robot, model: Model, count: int, seed: int) -> Array:
    """Sample unknowns x (count, 2d + 2) at which a robot without tilt is stable.

    robot: whose limits are kept. model: on which it is stable. seed: of numpy's default generator. Angles at the
    tips and the fractions of extensions are uniform before unstable samples are rejected.
    """
    rng = np.random.default_rng(seed)
    d = robot.d
    found = np.empty((0, 2 * d + 2))
    while len(found) < count:
        tips = np.zeros((count, 2 * d + 2))
        tips[:, :d] = rng.uniform(-np.pi, np.pi, (count, d))
        tips[:, d : 2 * d] = clip_extensions(robot, extensions(robot, rng.random((count, d))))
        x = model.guess(robot, unwrap_tip_angles(tips, d))
        # Not less than, instead of at least: on models without instability margins are NaN, and all samples count.
        found = np.vstack([found, x[~(model.margins(robot, x) < MIN_TRAINING_STABILITY_MARGIN)]])
    return found[:count]


def shapes_of(robot: Robot, model: Model, x: Array) -> ShapeBatch:
    """Compute the shapes of a robot on a model at unknowns x (n, 2d + 2)."""
    return ShapeBatch(model.points(robot, x, NETWORK_INPUT_SIGMA), model.extensions(robot, x)[:, -1])


def unwrap_tip_angles(tips: Array, d: int) -> Array:
    """Shift the tubes' angles by whole turns to within half a turn of the innermost tube's.

    tips: (n, m), of which the first d columns are angles at the tips, rad; the result has the same shape.
    """
    near = tips.copy()
    apart = tips[:, :d] - tips[:, d - 1 : d]
    near[:, :d] = tips[:, d - 1 : d] + apart - 2 * np.pi * np.round(apart / (2 * np.pi))
    return near
