"""What a tracker leads a robot's tubes along, and where the rest of that begins."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

TRACKED_SHAPE_POINTS = 11
"""Of the shape, evenly spaced, that are brought to where they were planned to be."""
TRACKED_SHAPE_STRIDE = (len(SIGMA_GRID) - 1) // (TRACKED_SHAPE_POINTS - 1)


class ReferenceTrajectory(NamedTuple):
    """T frames. q (T, 2d + 2): of the tubes; shape (T, TRACKED_SHAPE_POINTS, 3): where they are then, mm;
    stability (T,): their margins; x (T, n_x): the unknowns of the equilibria meant. zeros (T, d): what motors'
    zeros were taken to be off by, rad: the motors are planned to be where the tubes are, less these.
    """

    q: Array
    shape: Array
    stability: Array
    x: Array
    zeros: Array

    @classmethod
    def from_plan(cls, plan: Plan, model: Model, zeros: Array) -> ReferenceTrajectory:
        """A plan's, made for motors whose zeros are off by (d,) rad; model: on which its robot moves."""
        x = model.follow(plan.robot, plan.q).x
        return cls(
            plan.q, plan.shape[:, ::TRACKED_SHAPE_STRIDE], plan.stability, x, np.tile(zeros, (len(plan.q), 1))
        )

    @property
    def motors(self) -> Array:
        """Where motors are planned to be (T, 2d + 2)."""
        found = self.q.copy()
        d = self.zeros.shape[1]
        found[:, :d] -= self.zeros
        return found

    def splice_at(self, first: int, start: Array, rest: ReferenceTrajectory) -> ReferenceTrajectory:
        """Return this way up to frame `first`, counted from 0, followed by another way from there on.

        start (2d + 2,): configuration of the tubes from which the other way leads. Up to there tubes are beside
        this way by what start differs from it.
        """
        beside = self._replace(q=self.q + (start - self.q[first - 1]))
        return ReferenceTrajectory(
            *(np.concatenate([own[:first], other]) for own, other in zip(beside, rest, strict=True))
        )


class ReplanningStart(NamedTuple):
    """Where the rest of a motion begins. first: its first frame, from 0. robot: as it is known, with what is left
    to doubt as its tolerances; zeros (d,): what its motors' are off by, rad. before (n, 2d + 2): where its tubes
    will have come through by then, the last of it where they begin; before the motion has begun n is 0, and it may
    begin elsewhere. reference: the rest that is in force.
    """

    first: int
    robot: Robot
    zeros: Array
    passed_configurations: Array
    reference: ReferenceTrajectory
