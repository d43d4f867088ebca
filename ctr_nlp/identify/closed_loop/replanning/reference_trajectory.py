"""Reference trajectory of a tracker, and the start of a re-planned rest of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

TRACKED_SHAPE_POINTS = 11
"""Number of points of the shape, evenly spaced, that a tracker controls."""
TRACKED_SHAPE_STRIDE = (len(SIGMA_GRID) - 1) // (TRACKED_SHAPE_POINTS - 1)


class ReferenceTrajectory(NamedTuple):
    """Reference trajectory of T frames.

    q (T, 2d + 2): configurations of the tubes. shape (T, TRACKED_SHAPE_POINTS, 3): points of their shape, mm.
    stability (T,): margins. x (T, n_x): unknowns of the planned equilibria. zeros (T, d): motors' zeros that were
    assumed, rad: motors are planned at the tubes' angles less these.
    """

    q: Array
    shape: Array
    stability: Array
    x: Array
    zeros: Array

    @classmethod
    def from_plan(cls, plan: Plan, model: Model, zeros: Array) -> ReferenceTrajectory:
        """Take the trajectory of a plan, made for motors with `zeros` (d,), rad; model: of its robot."""
        x = model.follow(plan.robot, plan.q).x
        return cls(
            plan.q, plan.shape[:, ::TRACKED_SHAPE_STRIDE], plan.stability, x, np.tile(zeros, (len(plan.q), 1))
        )

    @property
    def motors(self) -> Array:
        """Planned configurations (T, 2d + 2) of the motors."""
        found = self.q.copy()
        d = self.zeros.shape[1]
        found[:, :d] -= self.zeros
        return found

    def splice_at(self, first: int, start: Array, rest: ReferenceTrajectory) -> ReferenceTrajectory:
        """Return this trajectory up to frame `first`, counted from 0, followed by another one from there on.

        start: (2d + 2,), configuration of the tubes before frame `first`. rest: the other trajectory. Up to there
        tubes are led in parallel to this trajectory, so that they pass through start.
        """
        beside = self._replace(q=self.q + (start - self.q[first - 1]))
        return ReferenceTrajectory(
            *(np.concatenate([own[:first], other]) for own, other in zip(beside, rest, strict=True))
        )


class ReplanningStart(NamedTuple):
    """Start of a re-planned rest of a motion.

    first: its first frame, from 0. robot: as estimated, with the remaining uncertainty as its tolerances. zeros
    (d,): of its motors, rad. passed_configurations (n, 2d + 2): of its tubes up to then, the last one where the
    rest starts; none before the motion has begun, which may then start anywhere. reference: the present rest.
    """

    first: int
    robot: Robot
    zeros: Array
    passed_configurations: Array
    reference: ReferenceTrajectory
