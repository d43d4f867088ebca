"""The elastic model of a robot that continues a motion: its history decides which equilibrium it is in."""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.elastic.following import follow, follow_robot_batch
from ctr_nlp.models.elastic.model import Elastic
from ctr_nlp.models.protocol import (
    STABILITY_SUBSTEPS_PER_FRAME,
    EquilibriumPath,
    Model,
    MotionSubsteps,
    subdivide_motion,
)
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array

# One object for all histories: programs are cached by model, and would be built again for another object.
PLAIN_ELASTIC_MODEL = Elastic()


class ElasticWithHistory(Elastic):
    """Robots that have come through configurations before (n, 2d + 2), n > 1, when a motion begins.

    A robot of the plain elastic model comes to rest in the first frame of a motion instead, from where all its
    tubes are aligned; where tubes are turned far against each other, that is another equilibrium.
    """

    def __init__(self, before: Array) -> None:
        self.before = before

    @property
    def program_model(self) -> Model:
        """The plain elastic model: programs do not depend on the history."""
        return PLAIN_ELASTIC_MODEL

    def rest(self, robot: Robot, q: Array) -> Array:
        """Return the equilibrium x (2d + 2,) of a robot at q (2d + 2,) after the configurations before."""
        return self.follow(robot, np.asarray(q, dtype=float)[None]).x[0]

    def follow(
        self, robot: Robot, q: Array, x0: Array | None = None, substeps: int = STABILITY_SUBSTEPS_PER_FRAME
    ) -> EquilibriumPath:
        """Return the equilibria of a robot along frames q (T, 2d + 2), after the configurations before.

        x0 (2d + 2,): its equilibrium in the first frame, which replaces that history; None otherwise. substeps:
        between frames.
        """
        if x0 is not None:
            return follow(robot, q, x0, substeps)
        return _drop_history(follow(robot, np.vstack([self.before, q]), None, substeps), len(self.before))

    def follow_batch(
        self, structure: Structure, numbers: Array, motion: MotionSubsteps, q: Array, margins: bool = True
    ) -> list[EquilibriumPath]:
        """Return the equilibria of robots that differ in numbers (n, d, 8), each after a history of its own.

        structure: what the robots share. motion: the sub-steps; q (n, M, 2d + 2): each robot's configurations
        there. margins: whether stability margins are computed. A robot's history is parallel to the configurations
        before, at the distance of its first configuration from the motion's.
        """
        # As many sub-steps to each configuration of the history as to the motion's last frame, so that branches
        # are resolved alike.
        count = len(self.before)
        substeps = int((motion.frames == motion.frames[-1]).sum())
        come = subdivide_motion(np.vstack([self.before, motion.q[:1]]), substeps)
        whole = MotionSubsteps(
            np.vstack([come.q, motion.q[1:]]),
            np.concatenate([come.frames, motion.frames[1:] + count]),
            np.concatenate([come.fresh, motion.fresh[1:]]),
            motion.total + count,
        )
        beside = come.q + (q[:, :1] - motion.q[:1])
        places = np.concatenate([beside, q[:, 1:]], axis=1)
        return [
            _drop_history(each, count) for each in follow_robot_batch(structure, numbers, whole, places, margins)
        ]


def _drop_history(found: EquilibriumPath, count: int) -> EquilibriumPath:
    """Return the frames after the first `count`.

    A snap within those is assigned to the first frame that remains.
    """
    snaps = tuple(snap._replace(frame=max(snap.frame - count, 1)) for snap in found.snaps)
    return EquilibriumPath(found.x[count:], found.stability[count:], found.stability_between[count:], snaps)
