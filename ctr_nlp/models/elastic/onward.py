"""The elastic model of a robot that continues a motion: its history decides which equilibrium it is in."""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.elastic.following import follow, followed_apart
from ctr_nlp.models.elastic.model import Elastic
from ctr_nlp.models.protocol import SUBSTEPS, Followed, Model, Passage, passage
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array

ELASTIC = Elastic()


class Onward(Elastic):
    """Robots that have come through configurations before (n, 2d + 2), n > 1, when a motion begins.

    A robot of the plain elastic model comes to rest in the first frame of a motion instead, from where all its
    tubes are aligned; where tubes are turned far against each other, that is another equilibrium.
    """

    def __init__(self, before: Array) -> None:
        self.before = before

    @property
    def form(self) -> Model:
        """The plain elastic model: programs do not depend on the history."""
        return ELASTIC

    def rest(self, robot: Robot, q: Array) -> Array:
        """The equilibrium x (2d + 2,) at q (2d + 2,) of a robot that has come through the configurations
        before.
        """
        return self.follow(robot, np.asarray(q, dtype=float)[None]).x[0]

    def follow(self, robot: Robot, q: Array, x0: Array | None = None, substeps: int = SUBSTEPS) -> Followed:
        """The equilibria along frames q (T, 2d + 2), after the configurations before unless x0 says where it
        begins.
        """
        if x0 is not None:
            return follow(robot, q, x0, substeps)
        return _later(follow(robot, np.vstack([self.before, q]), None, substeps), len(self.before))

    def follow_apart(
        self, structure: Structure, numbers: Array, way: Passage, q: Array, margins: bool = True
    ) -> list[Followed]:
        """The equilibria of robots that differ in numbers along a way, each after a history of its own.

        A robot's history is parallel to the configurations before, at the distance of its first configuration from
        the way's.
        """
        # As many sub-steps to each configuration of the history as to the motion's last frame.
        count, substeps = len(self.before), int((way.frames == way.frames[-1]).sum())
        come = passage(np.vstack([self.before, way.q[:1]]), substeps)
        whole = Passage(
            np.vstack([come.q, way.q[1:]]),
            np.concatenate([come.frames, way.frames[1:] + count]),
            np.concatenate([come.fresh, way.fresh[1:]]),
            way.total + count,
        )
        beside = come.q + (q[:, :1] - way.q[:1])
        places = np.concatenate([beside, q[:, 1:]], axis=1)
        return [_later(each, count) for each in followed_apart(structure, numbers, whole, places, margins)]


def _later(found: Followed, count: int) -> Followed:
    """The frames after the first `count`; a snap within those counts as one on the way to the first frame."""
    snaps = tuple(snap._replace(frame=max(snap.frame - count, 1)) for snap in found.snaps)
    return Followed(found.x[count:], found.stability[count:], found.stability_between[count:], snaps)
