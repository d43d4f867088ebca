"""Contact of a robot with an elastic wall along a motion: where it touches, and with what forces.

The wall is an elastic (Winkler) foundation: on every mm of the robot it pushes with k times the depth, towards the
lumen's path, and from both sides where the lumen is narrower than the robot. Along each piece of the robot the
force per length f is constant. With w(f) the push of the wall on the robot that is in equilibrium under f, the
forces satisfy

    f = w(f),   f >= 0,

and are found by a semismooth Newton method (Qi and Sun, A nonsmooth version of Newton's method, Mathematical
Programming 58, 1993), frame after frame. Its derivatives dw/df are finite differences of equilibria, which are
followed in one batch. There is no friction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.loads.rod_pieces import kind_with_pieces, piece_positions, unloaded_state
from ctr_nlp.loads.tip_force_limits import loaded_shapes
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.rod_loads import RodKind
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.models.protocol import subdivide_motion
from ctr_nlp.paths.lumen import outermost_tube_radii
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.paths.walls import WallGeometry
from ctr_nlp.plan.sample_motions import SAMPLE_SUBSTEPS_PER_FRAME
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags

CONTACT_FORCE_TOLERANCE_N = 1e-4
"""Largest difference, N, between the forces on all pieces and the wall's pushes at their depths."""
MAX_CONTACT_NEWTON_ITERATIONS, MAX_CONTACT_STEP_HALVINGS = 30, 6
"""Largest number of Newton iterations in a sub-step, and of step lengths in a line search."""
CONTACT_PROBE_N_PER_MM = 1e-4
"""N/mm by which the force on a piece is changed for a finite difference."""
NEGLIGIBLE_CONTACT_MM_OR_N_PER_MM = 1e-9
"""mm from the path, and N/mm, below which a push has no direction and counts as 0."""
CONTACT_PIECE_SAMPLE_PARTS = (0.125, 0.375, 0.625, 0.875)
"""Sample points of a piece, as parts of its length, at which its depth is computed."""


class WallReaction(NamedTuple):
    """The wall's pushes on T robots of K pieces.

    depth (T, K): of the deepest point of each piece in the wall, mm, 0 where it does not touch. push (T, K): force
    per length of the wall on it, N/mm. towards (T, K, 3): direction of that, of length 1 or 0. narrow (T, K):
    where the lumen is narrower than the robot.
    """

    depth: Array
    push: Array
    towards: Array
    narrow: Flags


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
    def kind(self) -> RodKind:
        """Kind of rods: that of the load, with sections divided into pieces that have forces of their own."""
        return kind_with_pieces(self.load)

    @cached_property
    def equilibria(self) -> LoadedEquilibria:
        """Solver of equilibria of rods with a force per length on every piece."""
        return LoadedEquilibria(self.robot.structure, self.kind)

    def wall_reaction(self, states: States) -> WallReaction:
        """Return the wall's pushes on T robots in equilibrium; states: these equilibria."""
        beta = self.robot.split(states.q)[1]
        middle, length = piece_positions(self.robot, self.kind, beta)
        places = middle[..., None] + length[..., None] * (np.array(CONTACT_PIECE_SAMPLE_PARTS) - 0.5)
        sigma = places.reshape(len(beta), -1) / beta[:, -1:]
        points = loaded_shapes(self.robot, states, sigma, self.kind)
        near = self.wall.project(points)
        over = outermost_tube_radii(self.robot, beta, sigma)
        over -= near.radius
        # over = r_tube - r_lumen. At a distance a from the path the body is over + a deep in the near wall, and
        # over - a deep in the far one, which only a lumen narrower than the robot makes positive: `behind`.
        depth, behind = (np.maximum(over + side * near.distance, 0.0) for side in (1.0, -1.0))
        away = np.maximum(near.distance, NEGLIGIBLE_CONTACT_MM_OR_N_PER_MM)
        # Towards the path, hence centre - points; divided by their distance for a unit vector.
        pushes = (self.stiffness * (depth - behind) / away)[..., None] * (near.centre - points)
        # Mean over the sample points of a piece: one force per length for all of it.
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
        """Return the load numbers (T, l) of a load (17 + 3d,) and pushes (T, K, 3) on the pieces, N/mm."""
        return np.hstack([np.tile(load, (len(pushes), 1)), pushes.reshape(len(pushes), -1)])

    def follow_motion(self, q: Array) -> WallContact:
        """Simulate the robot within the wall through q (T, 2d + 2); the wall is applied in the first frame."""
        found = self._empty_result(q)
        way = subdivide_motion(np.asarray(q, dtype=float), SAMPLE_SUBSTEPS_PER_FRAME)
        states = unloaded_state(self.equilibria, self.robot, q[:1])
        pushes = np.zeros((1, found["along"].shape[1], 3))
        loads = self.load.numbers_at(self.robot.d, way.elapsed_fractions)
        # Only the last sub-step of a frame is recorded; -1 is no frame, so that the very last one counts.
        last_of = np.diff(way.frames, append=-1) != 0
        # Pushes are kept as dead loads during a sub-step; then they are adjusted to the depths at its end.
        for place, load, j, last in zip(way.q[:, None], loads, way.frames, last_of, strict=True):
            states, done = self.equilibria.follow_branches(states, place, self.combine_loads(load, pushes))
            length = piece_positions(self.robot, self.kind, self.robot.split(place)[1])[1][0]
            settled = self._balance_forces(states, load, pushes, length) if done[0] == 1 else None
            # Where the robot goes in a snap is unknown: all later frames stay NaN.
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
        """Return the arrays of a WallContact for q (T, 2d + 2), NaN but for the pieces' positions and lengths."""
        along, length = piece_positions(self.robot, self.kind, self.robot.split(q)[1])
        sizes = {"depth": along.shape, "force": along.shape, "towards": (*along.shape, 3)}
        sizes |= {"shape": (len(q), len(SIGMA_GRID), 3), "missed": (len(q),)}
        known = {"along": along, "length": length, "narrow": np.zeros(along.shape, dtype=bool)}
        return known | {name: np.full(size, np.nan) for name, size in sizes.items()}

    def _balance_forces(
        self, states: States, load: Array, pushes: Array, length: Array
    ) -> tuple[States, Array, float] | None:
        """Solve for the pushes in one configuration; return the equilibrium, pushes (1, K, 3) and residual.

        states: equilibrium to start from. load: (17 + 3d,), the further load. pushes: (1, K, 3) to start from,
        N/mm. length: (K,) of the pieces, mm. None where no step lowers the residual, as where the robot snaps.
        """
        wall = self.wall_reaction(states)
        missed = self._force_residual(wall, pushes, length)
        for _ in range(MAX_CONTACT_NEWTON_ITERATIONS):
            if missed <= CONTACT_FORCE_TOLERANCE_N:
                return states, pushes, missed
            step = self._newton(states, load, wall, pushes)
            # Line search: the Newton step is halved until it lowers the residual and the branch does not end.
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
        """Return the sum over pieces of |w(f) - f| times their length, N."""
        apart = wall.push[..., None] * wall.towards - pushes
        return float((np.linalg.norm(apart[0], axis=1) * length).sum())

    def _newton(self, states: States, load: Array, wall: WallReaction, pushes: Array) -> Array:
        """Return the Newton step (1, K, 3) of pushes: after it f = w(f) to first order.

        states: the equilibrium. load: (17 + 3d,), the further load. wall: its reaction there. pushes: (1, K, 3).
        """
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
        # dw/df over the forces on all pieces in contact: forward differences, all in one batch. The directions of
        # pushes are kept during a step, so that each piece has one unknown.
        slopes = (self.wall_reaction(there).push[:, busy] - sizes[busy]).T / CONTACT_PROBE_N_PER_MM
        changed = np.zeros_like(kept)
        # Newton for f - w(f) = 0: (I - dw/df) df = w - f. Only pieces that touch, or are still pushed, are
        # unknowns (semismooth); a force below 0 is cut off, as a wall does not pull.
        changed[busy] = np.linalg.solve(np.eye(len(busy)) - slopes, (sizes - kept)[busy])
        return np.asarray((np.maximum(kept + changed, 0.0)[:, None] * towards)[None] - pushes)
