"""Equilibria of a robot that leans on a wall that gives: its tip and the forces of the wall, solved for together.

Along each piece of the robot (rod_pieces.py) the wall exerts a force per length f, N/mm, that is linear along it:
the projection of the Winkler foundation's push w (winkler_wall.py), so that f and w have the same resultant at the
same place. Both are then independent of the division into pieces, also where a tip alone touches. With the rod
integrated from its tip under f (models/loaded), the unknowns z are d + 2 changes of the tip and f on every piece
near the wall:

    F(z, q) = ( misfit of the base against q,  f - w(points(z, q)) ) = 0.

Newton's method solves it; where pieces begin or cease to touch it is a semismooth one (Qi and Sun, A nonsmooth
version of Newton's method, Mathematical Programming 58, 1993). A step is halved until the next one, by the same
Jacobian, is smaller (Deuflhard, Newton Methods for Nonlinear Problems, 2004: a test that does not depend on
units). The Jacobian gives slopes, too: dz/dq = -(dF/dz)^-1 dF/dq. Forces are unknowns beside the tip, so that a
hard wall makes the equations no worse: the rigid wall is the limit of a large stiffness.

The foundation is elastic and has no friction. Across a round lumen its energy is convex, so that it adds
stiffness: a robot that would snap under the same forces as dead loads may be stable on the wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctr_nlp.loads.rod_pieces import kind_with_pieces, piece_positions, unloaded_state
from ctr_nlp.loads.winkler_wall import WallPush, WinklerWall
from ctr_nlp.models.elastic.compiled import (
    MAX_PREDICTED_TURN_RAD,
    MAX_PREDICTION_ERROR_RAD,
    MIN_PATH_STEP_FRACTION,
)
from ctr_nlp.models.loaded.compiled import RodBases
from ctr_nlp.models.loaded.equilibria import MAX_LOADED_NEWTON_TURN_RAD, LoadedEquilibria, States
from ctr_nlp.models.loaded.rod_loads import RodKind
from ctr_nlp.models.loaded.stability import MAX_COMPUTED_MARGIN, margin_determinants, margins
from ctr_nlp.models.loaded.tips import turn_tips
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.paths.lumen import outermost_tube_radii
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Index

QUADRATURE_PANELS = 6
"""Number of equal parts of a piece on which the wall's push is integrated separately. Where a piece begins to
touch, the push has a corner, which a rule over the whole piece misses: by up to 0.06 mm of the tip's place."""
_LOBATTO_PARTS = np.array([0.0, (1 - np.sqrt(3 / 7)) / 2, 0.5, (1 + np.sqrt(3 / 7)) / 2, 1.0])
_LOBATTO_WEIGHTS = np.array([9.0, 49.0, 64.0, 49.0, 9.0]) / 180


def _join_panels() -> tuple[Array, Array]:
    """Return points, as parts of a piece, and weights (M,) of Lobatto's rule on QUADRATURE_PANELS parts of it."""
    inner = len(_LOBATTO_PARTS) - 1
    parts = np.zeros(QUADRATURE_PANELS * inner + 1)
    weights = np.zeros(len(parts))
    for k in range(QUADRATURE_PANELS):
        panel = slice(k * inner, (k + 1) * inner + 1)
        parts[panel] = (k + _LOBATTO_PARTS) / QUADRATURE_PANELS
        # Panels share their ends.
        weights[panel] += _LOBATTO_WEIGHTS / QUADRATURE_PANELS
    return parts, weights


CONTACT_PIECE_SAMPLE_PARTS, CONTACT_PIECE_WEIGHTS = _join_panels()
"""Sample points (M,) of a piece, as parts of its length, which contain both ends, and weights of the rule."""
PIECE_PROJECTION = CONTACT_PIECE_WEIGHTS * np.stack(
    [np.ones_like(CONTACT_PIECE_SAMPLE_PARTS), 3 * (2 * CONTACT_PIECE_SAMPLE_PARTS - 1)]
)
"""Projection (2, M) of samples of a push to its mean and its growth along a piece (rod_loads.PieceForce)."""
CONTACT_FORCE_TOLERANCE_N = 1e-4
"""Largest difference, N, between the forces on all pieces and the wall's pushes at their depths."""
CONTACT_TIP_TOLERANCE_RAD = 1e-7
"""Largest last Newton step of the tip, rad."""
MAX_CONTACT_NEWTON_STEPS, MAX_CONTACT_STEP_HALVINGS = 25, 6
"""Most Newton steps for one equilibrium, and most halvings of each."""
PLACE_LENGTH_MM = 10.0
"""Length of the robot on which forces count as those of one place, mm."""
NEAR_WALL_MM = 2.0
"""Distance from the wall up to which the forces on a piece are unknowns, mm."""
TIP_PROBE_RAD, PUSH_PROBE_N_PER_MM, EXTENSION_PROBE_MM = 1e-6, 1e-5, 1e-5
"""Changes of tip, forces and extensions for forward differences."""
EMPTY_PIECE_MM = 1e-9
"""Length below which a piece counts as empty, mm."""
MAX_KEPT_JACOBIAN_STEP_RATIO = 0.1
"""Ratio of the lengths of two Newton steps up to which the next one is made with the same Jacobian."""
SETTLED_PUSH_N_PER_MM = 1e-9
"""Largest last Newton step of the pushes at given coordinates, N/mm."""
MARGIN_PROBE = 1e-6
"""Change of a coordinate, rad or mm, and of a margin, for the slopes of margins."""
TIP_SCALE_MM_PER_RAD, FORCE_SCALE_MM_PER_N = 50.0, 1.0
"""Scales of tip and forces in the size of a Newton step: about the lengths by which they move a robot."""
MIN_WALL_SHARE_STEP = 2.0**-20
"""Least step in which the wall is hardened around a robot without a history: one that would be 100 mm outside of
the lumen needs a wall that soft to begin with."""


class ContactState(NamedTuple):
    """An equilibrium of one robot on a wall.

    q (2d + 2,): configuration. load (17 + 3d,): numbers of what else acts. angles (d,), rad, and axes (3, 3): of
    the tip. pushes (K, 2, 3): mean and growth of the wall's push along each piece, N/mm. sign: of the determinant
    of dF/dz, which changes where the branch ends.
    """

    q: Array
    load: Array
    angles: Array
    axes: Array
    pushes: Array
    sign: float


class ContactSlopes(NamedTuple):
    """Shape and forces of an equilibrium, with their derivatives by coordinates y (tip_coordinates).

    points (n, 3), mm, and points_by (n, 3, 2d + 2). force (K,): of the wall on each piece, N, and force_by (K, 2d
    + 2). force_at_places (K,): sum of the forces' sizes on PLACE_LENGTH_MM around the middle of each piece, N, and
    places_by (K, 2d + 2). q_by (2d + 2, 2d + 2): of the configuration. near: pieces whose forces are unknowns.
    unknowns_by (n, 2d + 2): derivatives of the tip's changes and of these forces.
    """

    points: Array
    points_by: Array
    force: Array
    force_by: Array
    force_at_places: Array
    places_by: Array
    q_by: Array
    near: Index
    unknowns_by: Array


class PieceForces(NamedTuple):
    """The wall's forces on K pieces of a robot.

    along (K,): middles of the pieces, mm. force (K,): on each, N. at_places (K,): sums on PLACE_LENGTH_MM around
    these middles, N.
    """

    along: Array
    force: Array
    at_places: Array


class _Rods(NamedTuple):
    """T rods; ends: at their bases. beta (T, d): extensions, mm. lengths (T, K): of their pieces, mm."""

    ends: RodBases
    beta: Array
    lengths: Array


class _Systems(NamedTuple):
    """The equations near N states.

    residual (N, n), jacobian (N, n, n): F and dF/dz. by_beta (N, n, d): dF/dbeta. near: pieces whose forces are
    unknowns. rods: for each state, that of the state itself, of each changed unknown, and of each changed
    extension; probes (N, d): these changes, mm.
    """

    residual: Array
    jacobian: Array
    by_beta: Array
    near: Index
    rods: _Rods
    probes: Array


@dataclass(frozen=True)
class ContactEquilibria:
    """Solver of equilibria of one robot on a wall. Not to be used from several threads at once.

    robot: with moduli in MPa. wall: the foundation. load: what else acts, which decides the kind of rods.
    """

    robot: Robot
    wall: WinklerWall
    load: Load | LoadOverTime

    @cached_property
    def kind(self) -> RodKind:
        """Kind of rods: that of the load, with sections divided into pieces that have forces of their own."""
        return kind_with_pieces(self.load, self.robot.d)

    @cached_property
    def equilibria(self) -> LoadedEquilibria:
        """Solver of equilibria of rods with given forces on every piece."""
        return LoadedEquilibria(self.robot.structure, self.kind)

    @cached_property
    def _to_powers(self) -> Array:
        """Matrix from tangents at the nodes of a piece to the coefficients of the polynomial through them."""
        nodes = np.linspace(0.0, 1.0, self.kind.steps + 1)
        return np.asarray(np.linalg.inv(np.vander(nodes, increasing=True)))

    def place(self, q: Array, load: Array) -> ContactState | None:
        """Return the equilibrium of a robot without a history at q (2d + 2,) under a load (17 + 3d,).

        Free of the wall it is turned there from aligned tubes; then the load grows and the wall hardens. None
        where a branch ends on the way.
        """
        d = self.robot.d
        free = unloaded_state(self.equilibria, self.robot, q[None])
        if not np.isfinite(free.determinant).all():
            return None
        pieces = piece_positions(self.robot, self.kind, q[None, d : 2 * d])[0].shape[1]
        # Of d + 2 rows each, dF/dz has the misfit's derivatives, and the determinant those of the base: minus
        # them.
        sign = float(np.sign(free.determinant[0])) * (-1) ** d
        state = ContactState(q.copy(), 0 * load, free.angles[0], free.axes[0], np.zeros((pieces, 2, 3)), sign)
        done = 0.0
        step = 1.0
        while done < 1.0:
            ahead = min(done + step, 1.0)
            found = self._solve(state._replace(load=ahead * load), ahead)
            if found is not None:
                state, done, step = found, ahead, 2 * step
            elif step < MIN_WALL_SHARE_STEP:
                return None
            else:
                step /= 2
        return state._replace(load=load)

    def follow(
        self, state: ContactState, q: Array, load: Array, smallest: float = MIN_PATH_STEP_FRACTION
    ) -> tuple[ContactState, float]:
        """Follow the branch of an equilibrium towards q (2d + 2,) and a load (17 + 3d,), on a line in both.

        Returns the last equilibrium on the branch and the fraction of the line that was covered: 1 for all of it.
        smallest: least fraction in a step.
        """
        start = state
        done = 0.0
        step = 1.0
        while done < 1.0 and step >= smallest:
            ahead = min(done + step, 1.0)
            goal = q if ahead == 1.0 else start.q + ahead * (q - start.q)
            pull = load if ahead == 1.0 else start.load + ahead * (load - start.load)
            found = self._solve(state._replace(q=goal, load=pull), turned=goal - state.q)
            if found is None:
                step /= 2
            else:
                state, done, step = found, ahead, 2 * step
        return state, done

    def follow_motion(self, q: Array, loads: Array) -> list[ContactState]:
        """Return the equilibria along a motion q (M, 2d + 2) under loads (M, 17 + 3d), as far as its branch leads.

        The first is reached without a history; none where that fails.
        """
        states = list[ContactState]()
        for place, load in zip(q, loads, strict=True):
            if not states:
                first = self.place(place, load)
                if first is None:
                    break
                states.append(first)
                continue
            there, done = self.follow(states[-1], place, load)
            if done < 1:
                break
            states.append(there)
        return states

    def shape(self, state: ContactState, sigma: Array) -> Array:
        """Return points (n, 3), mm, of a state at sigma (n,), parts of the robot's length."""
        return self._points(self._rods([state]), sigma)[0]

    def contact(self, state: ContactState) -> WallPush:
        """Return what the wall does to a state at the sample points (K, M) of its pieces."""
        found = self._contacts(self._rods([state]))
        return WallPush(found.beyond[0], found.push[0], found.slope[0], found.narrow[0])

    def forces(self, state: ContactState) -> PieceForces:
        """Return the wall's forces on the pieces of a state."""
        along, lengths = (
            each[0] for each in piece_positions(self.robot, self.kind, self.robot.split(state.q[None])[1])
        )
        force = np.linalg.norm(state.pushes[:, 0], axis=1) * lengths
        return PieceForces(along, force, place_matrix(along, lengths) @ force)

    def force_mismatch(self, state: ContactState) -> float:
        """Return the sum over pieces of the difference between force and push, N."""
        rods = self._rods([state])
        return self._mismatch(state, rods, self._contacts(rods), 1.0)

    def margins(self, states: Sequence[ContactState], bending: bool = False) -> Array:
        """Return the stability margins (T,) of equilibria, where the wall's forces change as the robot moves.

        As of models/loaded/stability.py, with the foundation's part of the second variation beside the bending
        one: 0 at a snap, 1 where no tube acts on another. NaN under a load that has no energy. bending: margins to
        buckling instead.
        """
        if not self.load.conservative:
            return np.full(len(states), np.nan)
        return margins(self._foundation_rods, self._founded_states(states), bending)

    def margin_slopes(
        self, states: Sequence[ContactState], slopes: Sequence[ContactSlopes], margins: Array
    ) -> Array:
        """Return the derivatives (T, 2d + 2) of stability margins (T,) by y; 0 where a margin counts as 1.

        slopes: of the states.
        """
        n = len(states[0].q)
        d = self.robot.d
        steps = np.full((len(states), n), MARGIN_PROBE)
        steps[:, d : 2 * d] *= np.sign(_extension_probes(np.stack([state.q[d : 2 * d] for state in states])))
        near = [
            self.predict(state, slope, step)
            for state, slope, own in zip(states, slopes, steps, strict=True)
            for step in (*np.diag(own), np.zeros(n), np.zeros(n))
        ]
        at = np.repeat(margins[:, None], n + 2, axis=1)
        at[:, n + 1] += MARGIN_PROBE
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            found = margin_determinants(self._foundation_rods, self._founded_states(near), at.ravel())
            found = found.reshape(at.shape)
            by_margin = (found[:, n + 1] - found[:, n]) / MARGIN_PROBE
            by_q = -(found[:, :n] - found[:, n, None]) / steps / by_margin[:, None]
        return np.where((margins < MAX_COMPUTED_MARGIN)[:, None], by_q, 0.0)

    @cached_property
    def _foundation_rods(self) -> LoadedEquilibria:
        """Rods whose responses contain the wall's stiffness."""
        return LoadedEquilibria(self.robot.structure, self.kind._replace(founded=True))

    def _founded_states(self, states: Sequence[ContactState]) -> States:
        """Return states whose load numbers have the wall's stiffness on every piece."""
        rods = self._rods(states)
        slope = np.einsum("m,tkmij->tkij", CONTACT_PIECE_WEIGHTS, self._contacts(rods).slope)
        # An energy has a symmetric second derivative; a lumen that tapers presses towards its path all the same.
        slope = (slope + np.swapaxes(slope, 2, 3)) / 2
        count, pieces = slope.shape[:2]
        pushes = np.stack([state.pushes for state in states])
        forces = np.concatenate([pushes.reshape(count, pieces, 6), slope.reshape(count, pieces, 9)], axis=2)
        load = np.hstack([np.stack([state.load for state in states]), forces.reshape(count, -1)])
        numbers = np.repeat(self.robot.numbers[None], count, axis=0)
        unknown = States.unknown_states(numbers, np.stack([state.q for state in states]), load)
        return unknown._replace(
            angles=np.stack([state.angles for state in states]), axes=np.stack([state.axes for state in states])
        )

    def tip_coordinates(self, state: ContactState) -> Array:
        """Return coordinates y (2d + 2,) of an equilibrium: q, but for d - 1 angles of tubes at the tip.

        They are the angles of tubes 1 .. d - 1 against the innermost one, rad, and take the place of their motors'
        angles. Where a robot is about to snap, its tip turns like the square root of its motors; over y everything
        is smooth.
        """
        d = self.robot.d
        y = state.q.copy()
        y[: d - 1] = state.angles[:-1] - state.angles[-1]
        return y

    def slopes(self, states: Sequence[ContactState], sigma: Array) -> list[ContactSlopes]:
        """Return shapes at sigma (n,) and forces of equilibria near each other, with their derivatives by y."""
        d = self.robot.d
        count = len(states)
        # Where the wall does not press, forces stay 0 to first order: they need no rods of their own.
        systems = self._systems(states, self._contacts(self._rods(states)), 1.0, self.wall.toe / 2)
        rows = len(systems.rods.beta) // count
        by_q = self._residual_by_q(states, systems)
        unknowns_by, q_by = self._solve_for(systems, by_q, _known_columns(systems, by_q, d))
        points = self._points(systems.rods, sigma)
        by_z, by_beta = self._differences(points, systems.probes)
        points_by = np.einsum("tznc,tzy->tncy", by_z, unknowns_by, optimize=True)
        points_by[..., d : 2 * d] += np.moveaxis(by_beta, 1, -1)
        lengths = systems.rods.lengths.reshape(count, rows, -1)
        found = []
        for k, state in enumerate(states):
            force, force_by = self._force_slopes(
                state, lengths[k], unknowns_by[k], systems.near, systems.probes[k]
            )
            along = np.cumsum(lengths[k], axis=1) - lengths[k] / 2
            at_places = place_matrix(along[0], lengths[k, 0])
            places_by = at_places @ force_by
            for i in range(d):
                # Pieces move along the robot with the extensions, and so do the parts of them at a place.
                moved = place_matrix(along[rows - d + i], lengths[k, rows - d + i])
                places_by[:, d + i] += (moved - at_places) @ force / systems.probes[k, i]
            found.append(
                ContactSlopes(
                    points=points[k * rows],
                    points_by=points_by[k],
                    force=force,
                    force_by=force_by,
                    force_at_places=at_places @ force,
                    places_by=places_by,
                    q_by=q_by[k],
                    near=systems.near,
                    unknowns_by=unknowns_by[k],
                )
            )
        return found

    def _residual_by_q(self, states: Sequence[ContactState], systems: _Systems) -> Array:
        """Return dF/dq (N, n, 2d + 2) of systems near states."""
        d = self.robot.d
        count = len(states)
        found = np.zeros((count, systems.residual.shape[1], 2 * d + 2))
        found[..., d : 2 * d] = systems.by_beta
        # Motors and tilt change the misfit alone, and that without another integration of the rod.
        columns = [*range(d), 2 * d, 2 * d + 1]
        changed = np.repeat(np.stack([state.q for state in states])[:, None], 1 + len(columns), axis=1)
        changed[:, 1 + np.arange(len(columns)), columns] += TIP_PROBE_RAD
        own = np.arange(count) * (len(systems.rods.beta) // count)
        which = np.repeat(own, 1 + len(columns))
        bases = RodBases(*(each[which] for each in systems.rods.ends))
        misfits = self.equilibria.misfit(changed.reshape(-1, 2 * d + 2), bases).reshape(*changed.shape[:2], -1)
        found[:, : d + 2, columns] = np.swapaxes((misfits[:, 1:] - misfits[:, :1]) / TIP_PROBE_RAD, 1, 2)
        return found

    def _solve_for(self, systems: _Systems, by_q: Array, right: Array) -> tuple[Array, Array]:
        """Return changes of the unknowns (N, n, k) and of q (N, 2d + 2, k) that make up for changes `right` of F.

        by_q (N, n, 2d + 2): dF/dq. right (N, n, k). At fixed y the tip turns, all tubes' angles change alike, and
        the motors of tubes 1 .. d - 1 follow. As many columns as there are entries of y are those of y itself,
        whose own changes are added.
        """
        d = self.robot.d
        jacobian = systems.jacobian
        matrix = np.concatenate(
            [
                jacobian[..., :2],
                jacobian[..., 2 : d + 2].sum(axis=2, keepdims=True),
                by_q[..., : d - 1],
                jacobian[..., d + 2 :],
            ],
            axis=2,
        )
        solved = -np.linalg.solve(matrix, right)
        unknowns = np.concatenate(
            [solved[:, :2], np.repeat(solved[:, 2:3], d, axis=1), solved[:, d + 2 :]], axis=1
        )
        q = np.zeros((len(solved), 2 * d + 2, solved.shape[2]))
        q[:, : d - 1] = solved[:, 3 : d + 2]
        if right.shape[2] == 2 * d + 2:
            inner = np.arange(d - 1)
            unknowns[:, 2 + inner, inner] += 1.0
            others = np.arange(d - 1, 2 * d + 2)
            q[:, others, others] = 1.0
        return unknowns, q

    def _force_slopes(
        self, state: ContactState, lengths: Array, unknowns_by: Array, near: Index, probes: Array
    ) -> tuple[Array, Array]:
        """Return the wall's force on each piece, (K,) N, and its derivatives (K, 2d + 2) by y.

        lengths (1 + n + d, K): of the pieces of the state's rods, mm. unknowns_by (n, 2d + 2): derivatives of the
        unknowns, of which those of the pieces `near` are forces. probes (d,): changes of the extensions, mm.
        """
        d = self.robot.d
        means = state.pushes[:, 0]
        size = np.linalg.norm(means, axis=1)
        force_by = np.zeros((len(size), 2 * d + 2))
        towards = means[near] / np.maximum(size[near], np.finfo(float).tiny)[:, None]
        by_piece = unknowns_by[d + 2 :].reshape(len(near), 2, 3, 2 * d + 2)[:, 0]
        force_by[near] = lengths[0, near, None] * np.einsum("kc,kcy->ky", towards, by_piece)
        # Pieces grow with the extensions.
        force_by[:, d : 2 * d] += (size * (lengths[-d:] - lengths[0]) / probes[:, None]).T
        return np.asarray(size * lengths[0]), force_by

    def predict(self, state: ContactState, slopes: ContactSlopes, step: Array) -> ContactState:
        """Return the equilibrium after a step (2d + 2,) of y to first order; slopes: of the state."""
        moved = self._apply_step(state, slopes.unknowns_by @ step, slopes.near)
        return moved._replace(q=state.q + slopes.q_by @ step)

    def settle(self, state: ContactState) -> ContactState | None:
        """Return the equilibrium with the y of a state that is near one; None where there is none.

        Newton's method; a Jacobian, which takes a rod for each unknown, is kept while steps become much shorter
        with it.
        """
        d = self.robot.d
        kept: tuple[_Systems, Array] | None = None
        before = np.inf
        for _ in range(MAX_CONTACT_NEWTON_STEPS):
            rods = self._rods([state])
            contact = self._contacts(rods)
            # A piece that begins to touch needs unknowns of its own.
            pressed = (contact.beyond[0] > -self.wall.toe / 2).any(axis=1)
            if kept is not None and np.delete(pressed, kept[0].near).any():
                kept = None
            if kept is None:
                fresh = self._systems([state], contact, 1.0)
                kept = fresh, self._residual_by_q([state], fresh)
                residual = fresh.residual
                if not np.isfinite(fresh.jacobian).all():
                    return None
            else:
                residual = self._residual(state, rods, contact, kept[0].near, 1.0)[None]
            systems, by_q = kept
            if not np.isfinite(residual).all():
                return None
            try:
                unknowns, q = (each[0, :, 0] for each in self._solve_for(systems, by_q, residual[..., None]))
            except np.linalg.LinAlgError:
                return None
            if not max(abs(unknowns[: d + 2]).max(), abs(q).max()) <= MAX_LOADED_NEWTON_TURN_RAD:
                return None
            state = self._apply_step(state, unknowns, systems.near)._replace(q=state.q + q)
            settled = abs(unknowns[d + 2 :]).max(initial=0.0) < SETTLED_PUSH_N_PER_MM
            if settled and abs(unknowns[: d + 2]).max() < CONTACT_TIP_TOLERANCE_RAD:
                return state
            size = self._size(unknowns, systems)
            if size > MAX_KEPT_JACOBIAN_STEP_RATIO * before:
                kept = None
            before = size
        return None

    def _solve(self, start: ContactState, share: float = 1.0, turned: Array | None = None) -> ContactState | None:
        """Return the equilibrium at q and load of `start`, near its tip and pushes; None where none is found.

        share: part of the wall's stiffness. turned (2d + 2,): change of q since the equilibrium that gave tip and
        pushes, which may be on another branch if the tip turns much more than the motors.
        """
        state = start
        first: ContactState | None = None
        d = self.robot.d
        contact = self._contacts(self._rods([state]))
        for _ in range(MAX_CONTACT_NEWTON_STEPS):
            system = self._systems([state], contact, share)
            jacobian = system.jacobian[0]
            step = _newton_step(jacobian, system.residual[0])
            if step is None or abs(step[: d + 2]).max() > MAX_LOADED_NEWTON_TURN_RAD:
                return None
            if first is None:
                first = self._apply_step(state, step, system.near)
                if _turns_too_far(step, turned, d):
                    return None
            size = self._size(step, system)
            part = 1.0
            for _ in range(MAX_CONTACT_STEP_HALVINGS):
                tried = self._apply_step(state, part * step, system.near)
                rods = self._rods([tried])
                contact = self._contacts(rods)
                ahead = _newton_step(jacobian, self._residual(tried, rods, contact, system.near, share))
                if ahead is not None and self._size(ahead, system) <= (1 - part / 4) * size + 1e-9:
                    break
                part /= 2
            else:
                return None
            state = tried
            if abs(step[: d + 2]).max() < CONTACT_TIP_TOLERANCE_RAD and (
                self._mismatch(state, rods, contact, share) < CONTACT_FORCE_TOLERANCE_N
            ):
                sign = float(np.linalg.slogdet(jacobian)[0])
                away = max(abs(state.angles - first.angles).max(), abs(state.axes - first.axes).max())
                # Another sign: another branch, or past the end of this one.
                same_branch = sign == start.sign and away < MAX_PREDICTION_ERROR_RAD
                return state._replace(sign=sign) if same_branch else None
        return None

    def _systems(
        self, states: Sequence[ContactState], contact: WallPush, share: float, near_mm: float = NEAR_WALL_MM
    ) -> _Systems:
        """Return the equations near states, of which the same pieces are near the wall.

        contact: what the wall does to each (N, K, ..); share: part of its stiffness. near_mm: distance from the
        wall up to which the forces on a piece are unknowns.
        """
        d = self.robot.d
        pushes = np.stack([state.pushes for state in states])
        pushed = abs(pushes).max(axis=(2, 3)) > 0
        near = np.flatnonzero((pushed | (contact.beyond > -near_mm).any(axis=2)).any(axis=0))
        count = d + 2 + 6 * len(near)
        which = np.arange(6 * len(near))
        # Rows for each state: the state itself, one for each unknown and one for each extension, changed by its
        # probe.
        rows = 1 + count + d
        angles, axes, beta, pushes = (
            np.repeat(each[:, None], rows, axis=1)
            for each in (
                np.stack([state.angles for state in states]),
                np.stack([state.axes for state in states]),
                np.stack([state.q[d : 2 * d] for state in states]),
                pushes,
            )
        )
        tips = slice(1, d + 3)
        turns = np.tile(TIP_PROBE_RAD * np.eye(d + 2), (len(states), 1))
        turned = turn_tips(_join(angles[:, tips]), _join(axes[:, tips]), turns)
        angles[:, tips], axes[:, tips] = (each.reshape(len(states), d + 2, *each.shape[1:]) for each in turned)
        pushes[:, d + 3 + which, near[which // 6], which // 3 % 2, which % 3] += PUSH_PROBE_N_PER_MM
        probes = _extension_probes(beta[:, 0])
        beta[:, 1 + count + np.arange(d), np.arange(d)] += probes
        loads = np.repeat(np.stack([state.load for state in states]), rows, axis=0)
        rods = self._integrate(_join(angles), _join(axes), _join(beta), _join(pushes), loads)
        q = np.stack([state.q for state in states])
        misfits = self.equilibria.misfit(np.repeat(q, rows, axis=0), rods.ends)
        terms = self._curve_terms(rods)[:, near]
        slope = np.einsum(
            "gm,mn,tkmij->tkginj",
            PIECE_PROJECTION,
            self._term_weights,
            share * contact.slope[:, near],
            optimize=True,
        )
        jacobian, by_beta = (
            np.concatenate([np.swapaxes(misfit_by, 1, 2), -_push_changes(slope, terms_by)], axis=1)
            for misfit_by, terms_by in zip(
                self._differences(misfits, probes), self._differences(terms, probes), strict=True
            )
        )
        jacobian[:, d + 2 + which, d + 2 + which] += 1.0
        apart = pushes[:, 0, near] - share * PIECE_PROJECTION @ contact.push[:, near]
        own = misfits.reshape(len(states), rows, -1)[:, 0]
        residual = np.hstack([own, apart.reshape(len(states), 6 * len(near))])
        return _Systems(residual, jacobian, by_beta, near, rods, probes)

    def _differences(self, values: Array, probes: Array) -> tuple[Array, Array]:
        """Return derivatives (N, n, ..) over the unknowns and (N, d, ..) over the extensions of values.

        values (N (1 + n + d), ..): of the rods of N systems. probes (N, d): changes of the extensions, mm.
        """
        d = self.robot.d
        each = values.reshape(len(probes), len(values) // len(probes), *values.shape[1:])
        changes = np.full((len(probes), each.shape[1] - 1), PUSH_PROBE_N_PER_MM)
        changes[:, : d + 2] = TIP_PROBE_RAD
        changes[:, -d:] = probes
        found = (each[:, 1:] - each[:, :1]) / changes.reshape(changes.shape + (1,) * (values.ndim - 1))
        return found[:, :-d], found[:, -d:]

    def _residual(self, state: ContactState, rods: _Rods, contact: WallPush, near: Index, share: float) -> Array:
        """Return F (n,) of a state with this rod, and what the wall does to it (1, K, ..)."""
        misfit = self.equilibria.misfit(state.q[None], rods.ends)[0]
        apart = state.pushes[near] - share * PIECE_PROJECTION @ contact.push[0, near]
        return np.concatenate([misfit, apart.ravel()])

    def _mismatch(self, state: ContactState, rods: _Rods, contact: WallPush, share: float) -> float:
        """Return the sum over pieces of the difference between force and push, N."""
        apart = state.pushes - share * PIECE_PROJECTION @ contact.push[0]
        return float((np.linalg.norm(apart, axis=2).sum(axis=1) * rods.lengths[0]).sum())

    def _size(self, step: Array, system: _Systems) -> float:
        """Return the size of a Newton step, mm: how far it moves the robot, and the forces that it adds."""
        d = self.robot.d
        pushes = step[d + 2 :].reshape(-1, 2, 3) * system.rods.lengths[0, system.near, None, None]
        return float(
            np.hypot(
                TIP_SCALE_MM_PER_RAD * np.linalg.norm(step[: d + 2]), FORCE_SCALE_MM_PER_N * np.linalg.norm(pushes)
            )
        )

    def _apply_step(self, state: ContactState, step: Array, near: Index) -> ContactState:
        """Return a state after a step (n,) of its tip and of the pushes on pieces near the wall."""
        d = self.robot.d
        angles, axes = turn_tips(state.angles[None], state.axes[None], step[None, : d + 2])
        pushes = state.pushes.copy()
        pushes[near] += step[d + 2 :].reshape(-1, 2, 3)
        return state._replace(angles=angles[0], axes=axes[0], pushes=pushes)

    def _rods(self, states: Sequence[ContactState]) -> _Rods:
        """Return the rods of states."""
        d = self.robot.d
        angles, axes, pushes, load = (
            np.stack([getattr(state, name) for state in states]) for name in ("angles", "axes", "pushes", "load")
        )
        return self._integrate(angles, axes, np.stack([state.q[d : 2 * d] for state in states]), pushes, load)

    def _integrate(self, angles: Array, axes: Array, beta: Array, pushes: Array, load: Array) -> _Rods:
        """Integrate T rods from tips with angles (T, d) and axes (T, 3, 3) at extensions (T, d), mm.

        pushes (T, K, 2, 3): forces per length on the pieces, N/mm. load (T, 17 + 3d): numbers of what else acts.
        """
        rows = len(beta)
        numbers = np.repeat(self.robot.numbers[None], rows, axis=0)
        acting = np.hstack([load, pushes.reshape(rows, -1)])
        ends = self.equilibria.rods(numbers, angles, axes, beta, acting, np.ones((rows, 2)))
        return _Rods(ends, beta, piece_positions(self.robot, self.kind, beta)[1])

    def _contacts(self, rods: _Rods) -> WallPush:
        """Return what the wall does to the sample points (T, K, M) of rods."""
        middles = np.cumsum(rods.lengths, axis=1) - rods.lengths / 2
        # One tube is the outermost along a whole piece. At its ends, where samples are, rounding would decide.
        radius = outermost_tube_radii(self.robot, rods.beta, middles / rods.beta[:, -1:])
        samples = self._samples(rods)
        return self.wall.push(samples, np.repeat(radius[..., None], samples.shape[2], axis=2))

    def _samples(self, rods: _Rods) -> Array:
        """Return the sample points (T, K, M, 3) of the pieces of rods, mm."""
        return np.einsum("mn,tknc->tkmc", self._term_weights, self._curve_terms(rods))

    @cached_property
    def _term_weights(self) -> Array:
        """Matrix (M, 1 + n) from the terms of a piece's curve to its sample points."""
        parts = CONTACT_PIECE_SAMPLE_PARTS
        return np.column_stack([np.ones_like(parts), _integrals(parts, self.kind.steps)])

    def _curve_terms(self, rods: _Rods) -> Array:
        """Return terms (T, K, 1 + n, 3), mm, in which points of a piece are linear: its start, and _curves."""
        starts, coefficients = self._curves(rods)
        return np.concatenate([starts[:, :, None], coefficients], axis=2)

    def _points(self, rods: _Rods, sigma: Array) -> Array:
        """Return points (T, n, 3), mm, of rods at sigma (n,), parts of their lengths."""
        starts, coefficients = self._curves(rods)
        ends = np.cumsum(rods.lengths, axis=1)
        s = sigma * rods.beta[:, -1:]
        # The first piece that ends at s or beyond it; rounding must not lead past the last one.
        piece = np.minimum((ends[:, None] < s[..., None] - 1e-12).sum(axis=-1), ends.shape[1] - 1)
        rows = np.arange(len(s))[:, None]
        lengths = rods.lengths[rows, piece]
        part = (s - ends[rows, piece] + lengths) / np.where(lengths > EMPTY_PIECE_MM, lengths, np.inf)
        weights = _integrals(part, self.kind.steps)
        return starts[rows, piece] + np.einsum("tmn,tmnc->tmc", weights, coefficients[rows, piece])

    def _curves(self, rods: _Rods) -> tuple[Array, Array]:
        """Return where pieces of rods begin (T, K, 3), mm, and their tangents' polynomials (T, K, n, 3) times
        length.
        """
        coefficients = np.einsum("nm,tkmc->tknc", self._to_powers, rods.ends.tangents)
        coefficients *= rods.lengths[..., None, None]
        gains = np.einsum("n,tknc->tkc", _integrals(np.ones(1), self.kind.steps)[0], coefficients)
        return np.cumsum(gains, axis=1) - gains, coefficients


def place_matrix(along: Array, lengths: Array) -> Array:
    """Return the matrix (K, K) from forces on pieces to those on PLACE_LENGTH_MM around the middle of each.

    along, lengths (K,): middles and lengths of the pieces, mm. A piece counts with the part of it that lies there.
    """
    half = PLACE_LENGTH_MM / 2
    low = np.maximum(along[:, None] - half, along - lengths / 2)
    high = np.minimum(along[:, None] + half, along + lengths / 2)
    return np.asarray(np.maximum(high - low, 0.0) / np.maximum(lengths, np.finfo(float).tiny))


def _extension_probes(beta: Array) -> Array:
    """Return changes (N, d) of extensions beta (N, d), mm, that keep the tubes' ends in order where they can."""
    room = np.pad(np.diff(beta, axis=1), ((0, 0), (0, 1)), constant_values=np.inf)
    return np.where(room > EXTENSION_PROBE_MM, EXTENSION_PROBE_MM, -EXTENSION_PROBE_MM)


def _integrals(part: Array, steps: int) -> Array:
    """Return the integrals of 1, f, .., f^steps from 0 to `part` (..): (.., steps + 1)."""
    powers = np.arange(1, steps + 2)
    return np.asarray(part[..., None] ** powers / powers)


def _push_changes(slope: Array, terms_by: Array) -> Array:
    """Return changes (T, 6 N, n) of the mean and growth of pushes on N pieces of T robots.

    slope (T, N, 2, 3, m, 3): of both by the m terms of each piece's curve. terms_by (T, n, N, m, 3): changes of
    these.
    """
    count, changes, pieces, terms, _ = terms_by.shape
    rows = slope.reshape(count, pieces, 6, 3 * terms)
    columns = np.moveaxis(terms_by, 1, 4).reshape(count, pieces, 3 * terms, changes)
    return np.asarray(rows @ columns).reshape(count, 6 * pieces, changes)


def _newton_step(jacobian: Array, residual: Array) -> Array | None:
    """Return the step (n,) that removes a residual to first order; None where that is not known."""
    if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
        return None
    try:
        return np.asarray(-np.linalg.solve(jacobian, residual))
    except np.linalg.LinAlgError:
        return None


def _turns_too_far(step: Array, turned: Array | None, d: int) -> bool:
    """Return whether a step of the tip turns tubes against each other much farther than their motors (turned)."""
    if turned is None or d == 1:
        return False
    motors = turned[:d]
    allowed = MAX_PREDICTED_TURN_RAD + abs(motors[:-1] - motors[-1]).max()
    return bool(abs(step[2 : d + 1] - step[d + 1]).max() > allowed)


def _known_columns(systems: _Systems, by_q: Array, d: int) -> Array:
    """Return dF/dy (N, n, 2d + 2) at fixed unknowns; by_q (N, n, 2d + 2): dF/dq. d: number of tubes."""
    found = by_q.copy()
    found[..., : d - 1] = systems.jacobian[..., 2 : d + 1]
    return found


def _join(values: Array) -> Array:
    """Return values (N, n, ..) as (N n, ..)."""
    return values.reshape(-1, *values.shape[2:])
