"""Contact of a robot with an elastic wall along a motion: where it touches, and with what forces.

Frame after frame the equilibrium on the wall is followed (contact_equilibria.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ctr_nlp.loads.contact_equilibria import ContactEquilibria
from ctr_nlp.loads.contact_rods import ContactState
from ctr_nlp.loads.rod_pieces import piece_positions
from ctr_nlp.loads.winkler_wall import WinklerWall
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.models.protocol import subdivide_motion
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.paths.walls import WallGeometry
from ctr_nlp.plan.sample_motions import SAMPLE_SUBSTEPS_PER_FRAME
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags


@dataclass(frozen=True, eq=False)
class WallContact(ReadOnlyValue):
    """Contact of a robot of K pieces along a motion of T frames; NaN from the frame on in which it snaps.

    along, length (T, K): middle and length of every piece, mm. depth (T, K): of its deepest point in the wall, mm.
    force (T, K): of the wall on it, N; towards (T, K, 3): direction of that. narrow (T, K): where the lumen is
    narrower than the robot. shape (T, 101, 3): in mm at uniform sigma. missed (T,): residual, the sum over pieces
    of the difference between force and push, N.
    """

    along: Array
    length: Array
    depth: Array
    force: Array
    towards: Array
    narrow: Flags
    shape: Array
    missed: Array


@dataclass(frozen=True)
class Foundation:
    """A robot within an elastic wall; stiffness: N/mm for every mm of length; load: a further load."""

    robot: Robot
    wall: WallGeometry
    stiffness: float
    load: Load | LoadOverTime

    @cached_property
    def equilibria(self) -> ContactEquilibria:
        """Solver of equilibria of the robot on the wall."""
        return ContactEquilibria(self.robot, WinklerWall(self.wall, self.stiffness), self.load)

    def follow_motion(self, q: Array) -> WallContact:
        """Simulate the robot within the wall through q (T, 2d + 2); the wall is applied in the first frame."""
        found = self._empty_result(q)
        way = subdivide_motion(np.asarray(q, dtype=float), SAMPLE_SUBSTEPS_PER_FRAME)
        loads = self.load.numbers_at(self.robot.d, way.elapsed_fractions)
        states = self.equilibria.follow_motion(way.q, loads)
        # Only the last sub-step of a frame is recorded; -1 is no frame, so that the very last one counts. Where
        # the robot goes in a snap is unknown: all later frames stay NaN.
        last_of = np.diff(way.frames, append=-1)[: len(states)] != 0
        for k in np.flatnonzero(last_of):
            self._record(found, int(way.frames[k]), states[k])
        return WallContact(**found)

    def _record(self, found: dict[str, Any], j: int, state: ContactState) -> None:
        """Write the state of frame j, from 0, to the arrays of a WallContact."""
        wall = self.equilibria.contact(state)
        means = state.pushes[:, 0]
        size = np.linalg.norm(means, axis=1)
        found["depth"][j] = np.maximum(wall.beyond.max(axis=1), 0.0)
        found["force"][j] = size * found["length"][j]
        found["towards"][j] = means / np.where(size > 0, size, 1.0)[:, None]
        found["narrow"][j] = self.equilibria.find_narrow_pieces(state)
        found["shape"][j] = self.equilibria.shape(state, SIGMA_GRID)
        found["missed"][j] = self.equilibria.force_mismatch(state)

    def _empty_result(self, q: Array) -> dict[str, Any]:
        """Return the arrays of a WallContact for q (T, 2d + 2), NaN but for the pieces' positions and lengths."""
        along, length = piece_positions(self.robot, self.equilibria.kind, self.robot.split(q)[1])
        sizes = {"depth": along.shape, "force": along.shape, "towards": (*along.shape, 3)}
        sizes |= {"shape": (len(q), len(SIGMA_GRID), 3), "missed": (len(q),)}
        known = {"along": along, "length": length, "narrow": np.zeros(along.shape, dtype=bool)}
        return known | {name: np.full(size, np.nan) for name, size in sizes.items()}
