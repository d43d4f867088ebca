"""A robot within a wall that gives: where it touches the wall along a motion, and with what forces.

The wall is an elastic foundation: it pushes with stiffness times depth on every mm of the robot, towards the
lumen's path; from both sides where the lumen is narrower than the robot. Forces per length are constant along
pieces of the robot. Those at which every piece is pressed as deep into the wall as its force says are found by a
semismooth Newton method (Qi and Sun, A nonsmooth version of Newton's method, Mathematical Programming 58, 1993),
frame after frame, whose derivatives are differences of equilibria that are followed side by side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.loads.tip_force_limits import loaded_shapes
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.elastic.torsion import sections
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.models.loaded.rod_loads import RodKind
from ctr_nlp.models.loaded.tips import tip_angles
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.models.protocol import subdivide_motion
from ctr_nlp.paths.lumen import Lumen, outermost_tube_radii
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.sample_motions import SAMPLE_SUBSTEPS_PER_FRAME
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags

CONTACT_PIECES_PER_SECTION = 9
"""Into which every section between ends of tubes is divided: some mm each."""
CONTACT_FORCE_TOLERANCE_N = 1e-4
"""N that the forces of all pieces differ at most from what their depths say."""
MAX_CONTACT_NEWTON_ITERATIONS, MAX_CONTACT_STEP_HALVINGS = 30, 6
"""Of Newton's method in a frame, and of a step that makes nothing better."""
CONTACT_PROBE_N_PER_MM = 1e-4
"""N/mm by which the force on a piece is changed for a difference."""
NEGLIGIBLE_CONTACT_MM_OR_N_PER_MM = 1e-9
"""mm from the path, and N/mm, below which the wall pushes nowhere."""
CONTACT_PIECE_SAMPLE_PARTS = (0.125, 0.375, 0.625, 0.875)
"""Parts of a piece at which its depth is taken."""


class WallReaction(NamedTuple):
    """Of T robots, pieces (T, K): how deep the deepest place of each is in the wall, mm, 0 where it does not
    touch; with what the wall pushes on it, N/mm, and towards where (T, K, 3), of length 1 or 0; where the lumen is
    narrower than the robot.
    """

    depth: Array
    push: Array
    towards: Array
    narrow: Flags


@dataclass(frozen=True, eq=False)
class WallContact(ReadOnlyValue):
    """A motion through T frames, and K pieces of the robot; NaN from a frame on in which it snaps.

    along, length (T, K): the middle of every piece and its length, mm. depth (T, K): of its deepest place in the
    wall, mm; force (T, K): of the wall on it, N; towards (T, K, 3): that force's direction. narrow (T, K): where
    the lumen is narrower than the robot. shape (T, 101, 3) mm at uniform sigma. missed (T,): N by which the forces
    of all pieces differ from what depths say.
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
    """A robot in a lumen whose wall has a stiffness, N/mm for every mm of length; load: what it bears beside."""

    robot: Robot
    lumen: Lumen
    stiffness: float
    load: Load | LoadOverTime

    @cached_property
    def kind(self) -> RodKind:
        """Kind of rods: that of the load, with sections divided into pieces that bear forces of their own."""
        return RodKind.of(self.load)._replace(pieces=CONTACT_PIECES_PER_SECTION)

    @cached_property
    def equilibria(self) -> LoadedEquilibria:
        """Solver of equilibria of rods that bear a force per length of their own on every piece."""
        return LoadedEquilibria(self.robot.structure, self.kind)

    def piece_positions(self, beta: Array) -> tuple[Array, Array]:
        """The middles and lengths (T, K) of pieces of robots with extensions beta (T, d), mm."""
        parts = self.kind.split_sections(sections(self.robot.tube_numbers, list(beta.T), np, planes=False))
        start, length = (
            np.stack([getattr(part, name) + 0 * beta[:, 0] for part in parts], axis=1)
            for name in ("start", "length")
        )
        return start + length / 2, length

    def wall_reaction(self, states: States) -> WallReaction:
        """How the wall pushes on robots where they are."""
        beta = self.robot.split(states.q)[1]
        middle, length = self.piece_positions(beta)
        places = middle[..., None] + length[..., None] * (np.array(CONTACT_PIECE_SAMPLE_PARTS) - 0.5)
        sigma = places.reshape(len(beta), -1) / beta[:, -1:]
        points = loaded_shapes(self.robot, states, sigma, self.kind)
        near = self.lumen.project(points)
        over = outermost_tube_radii(self.robot, beta, sigma)
        over -= near.radius
        # On the far side, where a lumen is narrower than the robot, the wall pushes back: behind is the depth
        # there.
        depth, behind = (np.maximum(over + side * near.distance, 0.0) for side in (1.0, -1.0))
        away = np.maximum(near.distance, NEGLIGIBLE_CONTACT_MM_OR_N_PER_MM)
        pushes = (self.stiffness * (depth - behind) / away)[..., None] * (near.centre - points)
        # Mean over the places of a piece: one force per length for all of it.
        push = pushes.reshape(*places.shape, 3).mean(axis=2)
        size = np.linalg.norm(push, axis=-1)
        towards = np.where(
            size[..., None] > NEGLIGIBLE_CONTACT_MM_OR_N_PER_MM,
            push / np.maximum(size, NEGLIGIBLE_CONTACT_MM_OR_N_PER_MM)[..., None],
            0.0,
        )
        deepest, narrow = (each.reshape(places.shape).max(axis=2) for each in (depth, over > 0))
        return WallReaction(deepest, size, towards, narrow)

    def combine_loads(self, load: Array, pushes: Array) -> Array:
        """Numbers (T, l) of a load (17 + 3d,) and of pushes (T, K, 3) on the pieces, N/mm."""
        return np.hstack([np.tile(load, (len(pushes), 1)), pushes.reshape(len(pushes), -1)])

    def follow_motion(self, q: Array) -> WallContact:
        """The robot moved through frames q (T, 2d + 2), in the first of which the wall closes around it."""
        found = self._empty_result(q)
        way = subdivide_motion(np.asarray(q, dtype=float), SAMPLE_SUBSTEPS_PER_FRAME)
        states = self._unloaded_state(q[:1])
        pushes = np.zeros((1, found["along"].shape[1], 3))
        loads = self.load.numbers_at(self.robot.d, way.elapsed_fractions)
        last_of = np.diff(way.frames, append=-1) != 0
        # Pushes are dead loads while the robot moves on; then they are adjusted to the depths at the new place.
        for place, load, j, last in zip(way.q[:, None], loads, way.frames, last_of, strict=True):
            states, done = self.equilibria.follow_branches(states, place, self.combine_loads(load, pushes))
            length = self.piece_positions(self.robot.split(place)[1])[1][0]
            settled = self._balance_forces(states, load, pushes, length) if done[0] == 1 else None
            if settled is None:
                break
            states, pushes, missed = settled
            if last:
                wall = self.wall_reaction(states)
                here = {
                    "depth": wall.depth[0],
                    "force": np.linalg.norm(pushes[0], axis=1) * length,
                    "towards": wall.towards[0],
                    "narrow": wall.narrow[0],
                    "shape": loaded_shapes(self.robot, states, SIGMA_GRID, self.kind)[0],
                    "missed": missed,
                }
                for name, value in here.items():
                    found[name][j] = value
        return WallContact(**found)

    def _empty_result(self, q: Array) -> dict[str, Any]:
        """The arrays of Touching of a motion of which nothing is known but where its pieces are."""
        along, length = self.piece_positions(self.robot.split(q)[1])
        sizes = {"depth": along.shape, "force": along.shape, "towards": (*along.shape, 3)}
        sizes |= {"shape": (len(q), len(SIGMA_GRID), 3), "missed": (len(q),)}
        known = {"along": along, "length": length, "narrow": np.zeros(along.shape, dtype=bool)}
        return known | {name: np.full(size, np.nan) for name, size in sizes.items()}

    def _unloaded_state(self, q: Array) -> States:
        """The robot at q (1, 2d + 2) without load and wall."""
        x = KINEMATIC_MODELS[Loaded.name].follow(self.robot, q).x
        return self.equilibria.solve_unloaded(self.robot.numbers[None], q, tip_angles(x, self.robot.d))

    def _balance_forces(
        self, states: States, load: Array, pushes: Array, length: Array
    ) -> tuple[States, Array, float] | None:
        """A robot that stands, pushes (1, K, 3) at which it does, and what they miss; None where it is lost."""
        wall = self.wall_reaction(states)
        missed = self._force_residual(wall, pushes, length)
        for _ in range(MAX_CONTACT_NEWTON_ITERATIONS):
            if missed <= CONTACT_FORCE_TOLERANCE_N:
                return states, pushes, missed
            step = self._newton(states, load, wall, pushes)
            # Newton's step is halved until it lowers what forces and depths differ by.
            for part in 2.0 ** -np.arange(MAX_CONTACT_STEP_HALVINGS):
                tried = pushes + part * step
                there, done = self.equilibria.follow_branches(states, states.q, self.combine_loads(load, tried))
                at = self.wall_reaction(there)
                less = self._force_residual(at, tried, length)
                if done[0] == 1 and less < missed:
                    break
            else:
                return None
            states = there
            wall = at
            pushes = tried
            missed = less
        return None

    def _force_residual(self, wall: WallReaction, pushes: Array, length: Array) -> float:
        apart = wall.push[..., None] * wall.towards - pushes
        return float((np.linalg.norm(apart[0], axis=1) * length).sum())

    def _newton(self, states: States, load: Array, wall: WallReaction, pushes: Array) -> Array:
        """The change (1, K, 3) of pushes after which, to first order, they are what depths say."""
        sizes = wall.push[0]
        towards = wall.towards[0]
        kept = (pushes[0] * towards).sum(axis=1)
        busy = np.flatnonzero((sizes > 0) | (kept > 0))
        if not len(busy):
            return -pushes  # the robot has left the wall, which pushes no longer
        probes = np.repeat(pushes, len(busy), axis=0)
        probes[np.arange(len(busy)), busy] += CONTACT_PROBE_N_PER_MM * towards[busy]
        many = states.rows(np.zeros(len(busy), dtype=int))
        there, _ = self.equilibria.follow_branches(many, many.q, self.combine_loads(load, probes))
        # How pushes of the wall change with the force on each busy piece: forward differences, all in one batch.
        slopes = (self.wall_reaction(there).push[:, busy] - sizes[busy]).T / CONTACT_PROBE_N_PER_MM
        changed = np.zeros_like(kept)
        # Wanted are forces f = w(f), with the wall's pushes w: (I - dw/df) df = w - f. Only pieces that touch, or
        # are still pushed, are unknowns (semismooth); a force below 0 is cut off, as a wall does not pull.
        changed[busy] = np.linalg.solve(np.eye(len(busy)) - slopes, (sizes - kept)[busy])
        return np.asarray((np.maximum(kept + changed, 0.0)[:, None] * towards)[None] - pushes)
