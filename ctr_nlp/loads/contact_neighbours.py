"""Equilibria on a wall as smooth functions of coordinates, near known ones: slopes, predictions and margins.

The coordinates y are q, but for d - 1 angles of tubes at the tip, relative to the innermost one, which take the
place of their motors' angles: where a robot is about to snap, its tip turns like the square root of its motors,
and over y everything is smooth. What is left of the unknowns of contact_rods.py, and the motors,

    u = (two turns of the tip, a turn of all tubes there, the motors of tubes 1 .. d - 1, forces near the wall),

follow from F(u, y) = 0 by the implicit function theorem: du/dy = -(dF/du)^-1 dF/dy. A state predicted along du/dy
is off by the square of the step; one Newton step with the same dF/du leaves the cube.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.loads.contact_equilibria import (
    CONTACT_TIP_TOLERANCE_RAD,
    MAX_CONTACT_NEWTON_STEPS,
    NEAR_WALL_MM,
    ContactEquilibria,
    newton_steps,
    step_size,
)
from ctr_nlp.loads.contact_rods import (
    ContactState,
    ContactStates,
    ContactSystem,
    place_matrix,
    signed_probes,
)
from ctr_nlp.loads.winkler_wall import WallPush
from ctr_nlp.models.loaded.equilibria import MAX_LOADED_NEWTON_TURN_RAD
from ctr_nlp.typing import Array, Index

MAX_KEPT_JACOBIAN_STEP_RATIO = 0.1
"""Ratio of the lengths of two Newton steps up to which the next one is made with the same Jacobian."""
SETTLED_PUSH_N_PER_MM = 1e-9
"""Largest last Newton step of the pushes at given coordinates, N/mm."""
MARGIN_PROBE = 1e-6
"""Change of a coordinate, rad or mm, for the slopes of margins."""


class ContactSlopes(NamedTuple):
    """Shape and forces of an equilibrium, with their derivatives by coordinates y and unknowns u.

    points (n, 3), mm; points_by_y (n, 3, 2d + 2) at fixed u, points_by_u (n, 3, m). force (K,): of the wall on
    each piece, N; force_by_y (K, 2d + 2), force_by_u (K, m). places (K, K): from these to the sums on
    PLACE_LENGTH_MM around the middle of each piece; places_by (d, K, K): by the extensions. u_by_y (m, 2d + 2),
    and system (m, m): dF/du. near: pieces whose forces are unknowns.
    """

    points: Array
    points_by_y: Array
    points_by_u: Array
    force: Array
    force_by_y: Array
    force_by_u: Array
    places: Array
    places_by: Array
    u_by_y: Array
    system: Array
    near: Index

    @property
    def points_by(self) -> Array:
        """Derivatives (n, 3, 2d + 2) of points along equilibria."""
        return np.asarray(self.points_by_y + self.points_by_u @ self.u_by_y)

    @property
    def force_by(self) -> Array:
        """Derivatives (K, 2d + 2) of forces along equilibria."""
        return np.asarray(self.force_by_y + self.force_by_u @ self.u_by_y)

    @property
    def force_at_places(self) -> Array:
        """Forces (K,) at places, N."""
        return np.asarray(self.places @ self.force)

    @property
    def force_at_places_by(self) -> Array:
        """Derivatives (K, 2d + 2) of forces at places along equilibria."""
        found = self.places @ self.force_by
        d = len(self.places_by)
        # Pieces move along the robot with the extensions, and so do the parts of them at a place.
        found[:, d : 2 * d] += (self.places_by @ self.force).T
        return np.asarray(found)

    @property
    def q_by(self) -> Array:
        """Derivatives (2d + 2, 2d + 2) of the configuration along equilibria."""
        d = len(self.places_by)
        found = np.eye(2 * d + 2)
        found[: d - 1] = self.u_by_y[3 : d + 2]
        return found


class NearbyRods(NamedTuple):
    """Rods near T equilibria, P for each, predicted to first order.

    states (T P,). points (T, P, n, 3), mm. force, at_places (T, P, K): of the wall, N. corrections: for each
    equilibrium the Newton steps (P, m) of u that make these equilibria, up to the cube of the prediction.
    """

    states: ContactStates
    points: Array
    force: Array
    at_places: Array
    corrections: list[Array]


@dataclass(frozen=True)
class ContactNeighbours:
    """Equilibria near known ones. Not to be used from several threads at once.

    equilibria: of the robot on the wall.
    """

    equilibria: ContactEquilibria

    def coordinates(self, states: ContactStates) -> Array:
        """Return coordinates y (T, 2d + 2) of equilibria."""
        d = self.equilibria.robot.d
        y = states.q.copy()
        y[:, : d - 1] = states.angles[:, :-1] - states.angles[:, -1:]
        return y

    def slopes(self, states: ContactStates, sigma: Array) -> list[ContactSlopes]:
        """Return shapes at sigma (n,) and forces of T equilibria, with their derivatives."""
        contact = self.equilibria.contacts(self.equilibria.bodies(states))
        # Where the wall does not press, forces stay 0 to first order: they need no rods of their own.
        near = self.equilibria.find_near(states, contact, self.equilibria.wall.toe / 2)
        systems, rods = self.equilibria.systems(states, near, contact)
        points = self.equilibria.points(rods, sigma)
        return [
            self._slopes_of(system, points[system.rods], push)
            for system, push in zip(systems, states.pushes[:, :, 0], strict=True)
        ]

    def predict(self, states: ContactStates, slopes: Sequence[ContactSlopes], steps: Array) -> ContactStates:
        """Return P equilibria near each of T after steps (T, P, 2d + 2) of y, to first order: (T P,).

        slopes: of the T states.
        """
        rows = np.repeat(np.arange(len(steps)), steps.shape[1])
        changes = [step @ slope.u_by_y.T for step, slope in zip(steps, slopes, strict=True)]
        return self._apply_steps(states.rows(rows), [slope.near for slope in slopes], changes, steps)

    def look_around(
        self, states: ContactStates, slopes: Sequence[ContactSlopes], steps: Array, sigma: Array
    ) -> NearbyRods:
        """Return rods after steps (T, P, 2d + 2) of y from T states; sigma (n,): where their points are.

        slopes: of the T states.
        """
        d = self.equilibria.robot.d
        near = self.predict(states, slopes, steps)
        bodies = self.equilibria.bodies(near)
        force = (np.linalg.norm(near.pushes[:, :, 0], axis=2) * bodies.lengths).reshape(*steps.shape[:2], -1)
        # Pieces' parts of places have corners as functions of the extensions: they are taken as linear.
        places = np.stack([slope.places for slope in slopes])[:, None] + np.stack(
            [
                np.tensordot(step[:, d : 2 * d], slope.places_by, 1)
                for step, slope in zip(steps, slopes, strict=True)
            ]
        )
        residuals = self.equilibria.residuals(near, bodies, [slope.near for slope in slopes])
        return NearbyRods(
            near,
            self.equilibria.points(bodies, sigma).reshape(*steps.shape[:2], len(sigma), 3),
            force,
            (places @ force[..., None])[..., 0],
            [newton_steps(slope.system, left) for slope, left in zip(slopes, residuals, strict=True)],
        )

    def settle(self, states: ContactStates, slopes: Sequence[ContactSlopes]) -> list[ContactState | None]:
        """Return the equilibria with the y of T states that are near ones; None where there is none.

        slopes: of equilibria nearby, whose systems are used first. Newton's method; a system, which takes a rod
        for each unknown, is kept while steps become much shorter with it.
        """
        d = self.equilibria.robot.d
        found: list[ContactState | None] = [None] * len(slopes)
        kept: list[_Kept | None] = [_Kept(slope.system, slope.near) for slope in slopes]
        before = np.full(len(slopes), np.inf)
        left = np.arange(len(slopes))
        for _ in range(MAX_CONTACT_NEWTON_STEPS):
            bodies = self.equilibria.bodies(states)
            contact = self.equilibria.contacts(bodies)
            systems = self._renew(states, contact, [kept[k] for k in left])
            residuals = self.equilibria.residuals(states, bodies, [each.near for each in systems], contact)
            steps = [
                newton_steps(each.matrix, left_over) for each, left_over in zip(systems, residuals, strict=True)
            ]
            # Steps that are too long, or not known, end the search: another branch, or none.
            good = np.array([abs(step[0, : d + 2]).max() <= MAX_LOADED_NEWTON_TURN_RAD for step in steps])
            states, left = states.rows(good), left[good]
            systems, steps, lengths = (
                [each for each, usable in zip(values, good, strict=True) if usable]
                for values in (systems, steps, bodies.lengths)
            )
            if not len(left):
                break
            states = self._apply_steps(
                states, [each.near for each in systems], steps, np.zeros((len(left), 1, 2 * d + 2))
            )
            going = np.ones(len(left), dtype=bool)
            for i, (k, step) in enumerate(zip(left, steps, strict=True)):
                settled = abs(step[0, d + 2 :]).max(initial=0.0) < SETTLED_PUSH_N_PER_MM
                if settled and abs(step[0, : d + 2]).max() < CONTACT_TIP_TOLERANCE_RAD:
                    found[k], going[i] = states.row(i), False
                size = step_size(step[0], systems[i].near, lengths[i], d)
                kept[k] = systems[i] if size <= MAX_KEPT_JACOBIAN_STEP_RATIO * before[k] else None
                before[k] = size
            states, left = states.rows(going), left[going]
            if not len(left):
                break
        return found

    def margin_slopes(self, states: ContactStates, slopes: Sequence[ContactSlopes], at: Array) -> Array:
        """Return the derivatives (T, 2d + 2) of smooth stability margins by y; 0 where a margin counts as 1.

        slopes: of the states. at (T,): margins at which they are tested.
        """
        n = states.q.shape[1]
        d = self.equilibria.robot.d
        steps = np.full((len(slopes), n), MARGIN_PROBE)
        steps[:, d : 2 * d] = signed_probes(states.q[:, d : 2 * d], steps[:, d : 2 * d])
        # The state itself comes first: a rod that is predicted differs from the settled one by rounding.
        probes = np.zeros((len(slopes), 1 + n, n))
        probes[:, 1 + np.arange(n), np.arange(n)] = steps
        near = [slope.near for slope in slopes for _ in range(1 + n)]
        around = self.predict(states, slopes, probes)
        found = self.equilibria.smooth_margins(around, np.repeat(at, 1 + n), near).reshape(len(slopes), 1 + n)
        return np.where(found[:, :1] < 1, (found[:, 1:] - found[:, :1]) / steps, 0.0)

    def margins_around(
        self, states: ContactStates, slopes: Sequence[ContactSlopes], corrections: Sequence[Array], at: Array
    ) -> Array:
        """Return smooth stability margins (T, P) of P rods near each of T equilibria.

        states (T P,): predicted to first order. slopes: of the equilibria. corrections: Newton steps (P, m) of u
        for each equilibrium (NearbyRods). at (T,): margins at which they are tested.
        """
        each = len(corrections[0])
        near = [slope.near for slope in slopes]
        none = np.zeros((len(near), each, states.q.shape[1]))
        exact = self._apply_steps(states, near, corrections, none)
        pieces = [own for own in near for _ in range(each)]
        found = self.equilibria.smooth_margins(exact, np.repeat(at, each), pieces)
        return found.reshape(len(near), each)

    def _slopes_of(self, system: ContactSystem, points: Array, push: Array) -> ContactSlopes:
        """Return the slopes of a state; points: of the system's rods; push (K, 3): of the wall, N/mm."""
        d = self.equilibria.robot.d
        n, m = 2 * d + 2, len(system.residual)
        by_z, by_beta = self.equilibria.differences(points, system.probes)
        motors = np.zeros((d - 1, *points.shape[1:]))
        common = by_z[2 : d + 2].sum(axis=0, keepdims=True)
        points_by_u = np.moveaxis(np.concatenate([by_z[:2], common, motors, by_z[d + 2 :]]), 0, -1)
        points_by_y = np.zeros((*points.shape[1:], n))
        points_by_y[..., : d - 1] = np.moveaxis(by_z[2 : d + 1], 0, -1)
        points_by_y[..., d : 2 * d] = np.moveaxis(by_beta, 0, -1)

        lengths = system.lengths
        size = np.linalg.norm(push, axis=1)
        towards = push[system.near] / np.maximum(size[system.near], np.finfo(float).tiny)[:, None]
        force_by_u, force_by_y = np.zeros((len(size), m)), np.zeros((len(size), n))
        columns = d + 2 + 6 * np.arange(len(system.near))[:, None] + np.arange(3)
        force_by_u[system.near[:, None], columns] = lengths[0, system.near, None] * towards
        # Pieces grow with the extensions.
        force_by_y[:, d : 2 * d] = (size * (lengths[-d:] - lengths[0]) / system.probes[:, None]).T
        own = lengths[[0, *range(-d, 0)]]
        places = place_matrix(np.cumsum(own, axis=1) - own / 2, own)

        matrix = self._matrix(system)
        by_y = system.by_q.copy()
        by_y[:, : d - 1] = system.jacobian[:, 2 : d + 1]
        return ContactSlopes(
            points=points[0],
            points_by_y=points_by_y,
            points_by_u=points_by_u,
            force=size * lengths[0],
            force_by_y=force_by_y,
            force_by_u=force_by_u,
            places=places[0],
            places_by=(places[1:] - places[0]) / system.probes[:, None, None],
            u_by_y=np.asarray(-np.linalg.solve(matrix, by_y), dtype=float),
            system=matrix,
            near=system.near,
        )

    def _matrix(self, system: ContactSystem) -> Array:
        """Return dF/du (m, m) of a system."""
        d = self.equilibria.robot.d
        jacobian = system.jacobian
        common = jacobian[:, 2 : d + 2].sum(axis=1, keepdims=True)
        return np.hstack([jacobian[:, :2], common, system.by_q[:, : d - 1], jacobian[:, d + 2 :]])

    def _renew(self, states: ContactStates, contact: WallPush, kept: Sequence[_Kept | None]) -> list[_Kept]:
        """Return the systems that were kept, and new ones of states (T,) where there is none or a piece begins to
        touch.
        """
        pressed = self.equilibria.find_near(states, contact, self.equilibria.wall.toe / 2)
        found = [
            None if each is None or np.setdiff1d(pieces, each.near).size else each
            for each, pieces in zip(kept, pressed, strict=True)
        ]
        new = [k for k, each in enumerate(found) if each is None]
        if new:
            there = WallPush(*(each[new] for each in contact))
            near = self.equilibria.find_near(states.rows(new), there, NEAR_WALL_MM)
            systems, _ = self.equilibria.systems(states.rows(new), near, there)
            for k, system in zip(new, systems, strict=True):
                found[k] = _Kept(self._matrix(system), system.near)
        return [each for each in found if each is not None]

    def _apply_steps(
        self, states: ContactStates, near: Sequence[Index], changes: Sequence[Array], steps: Array
    ) -> ContactStates:
        """Return T groups of P states (T P,) after changes of u and of y.

        changes: (P, m) for each group; steps (T, P, 2d + 2). near: pieces of each group whose forces are among u.
        """
        d = self.equilibria.robot.d
        first = np.concatenate([each[:, : d + 2] for each in changes])
        q = steps.reshape(-1, steps.shape[2]).copy()
        tips = np.column_stack([first[:, :2], np.repeat(first[:, 2:3], d, axis=1)])
        tips[:, 2 : d + 1] += q[:, : d - 1]
        q[:, : d - 1] = first[:, 3:]
        pushes = np.zeros_like(states.pushes).reshape(*steps.shape[:2], *states.pushes.shape[1:])
        for own, pieces, change in zip(pushes, near, changes, strict=True):
            own[:, pieces] = change[:, d + 2 :].reshape(len(change), -1, 2, 3)
        return states.apply_changes(tips, pushes.reshape(states.pushes.shape), q)


class _Kept(NamedTuple):
    """A system that Newton's method goes on with: dF/du (m, m), and the pieces whose forces are unknowns."""

    matrix: Array
    near: Index
