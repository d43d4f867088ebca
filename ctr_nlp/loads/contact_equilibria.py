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
from ctr_nlp.models.loaded.stability import margins
from ctr_nlp.models.loaded.tips import turn_tips
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.paths.lumen import outermost_tube_radii
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Index

_LOBATTO = np.sqrt(3 / 7)
CONTACT_PIECE_SAMPLE_PARTS = np.array([0.0, (1 - _LOBATTO) / 2, 0.5, (1 + _LOBATTO) / 2, 1.0])
"""Sample points of a piece, as parts of its length: those of Lobatto's rule, which contain both ends."""
CONTACT_PIECE_WEIGHTS = np.array([9.0, 49.0, 64.0, 49.0, 9.0]) / 180
"""Weights of the rule."""
PIECE_PROJECTION = CONTACT_PIECE_WEIGHTS * np.stack([np.ones(5), 3 * (2 * CONTACT_PIECE_SAMPLE_PARTS - 1)])
"""Projection (2, 5) of samples of a push to its mean and its growth along a piece (rod_loads.PieceForce)."""
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
TIP_SCALE_MM_PER_RAD, FORCE_SCALE_MM_PER_N = 50.0, 1.0
"""Scales of tip and forces in the size of a Newton step: about the lengths by which they move a robot."""
MIN_WALL_SHARE_STEP = 2.0**-10
"""Least step in which the wall is hardened around a robot without a history."""


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
    """Shape and forces of an equilibrium, with their derivatives by q.

    points (n, 3), mm, and points_by_q (n, 3, 2d + 2). force (K,): of the wall on each piece, N, and force_by_q (K,
    2d + 2). along, lengths (K,): middles and lengths of the pieces, mm. near: pieces whose forces are unknowns.
    unknowns_by_q (n, 2d + 2): derivatives of the tip's changes and of these forces.
    """

    points: Array
    points_by_q: Array
    force: Array
    force_by_q: Array
    along: Array
    lengths: Array
    near: Index
    unknowns_by_q: Array

    @property
    def place_matrix(self) -> Array:
        """Matrix (K, K) from forces on pieces to those at places."""
        return place_matrix(self.along, self.lengths)

    @property
    def force_at_places(self) -> Array:
        """Sum of the forces' sizes on PLACE_LENGTH_MM around the middle of each piece, (K,) N."""
        return np.asarray(self.place_matrix @ self.force)


class _Rods(NamedTuple):
    """T rods; ends: at their bases. beta (T, d): extensions, mm. lengths (T, K): of their pieces, mm."""

    ends: RodBases
    beta: Array
    lengths: Array


class _System(NamedTuple):
    """The equations near a state.

    residual (n,), jacobian (n, n): F and dF/dz. by_beta (n, d): dF/dbeta. near: pieces whose forces are unknowns.
    rods: of the state itself, of each changed unknown, and of each changed extension; probes (d,): these changes,
    mm.
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
        return kind_with_pieces(self.load)

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

    def shape(self, state: ContactState, sigma: Array) -> Array:
        """Return points (n, 3), mm, of a state at sigma (n,), parts of the robot's length."""
        return self._points(self._rods(state), sigma)[0]

    def contact(self, state: ContactState) -> WallPush:
        """Return what the wall does to a state at the sample points (K, 5) of its pieces."""
        return self._contact(self._rods(state))

    def force_mismatch(self, state: ContactState) -> float:
        """Return the sum over pieces of the difference between force and push, N."""
        rods = self._rods(state)
        return self._mismatch(state, rods, self._contact(rods), 1.0)

    def margins(self, states: Sequence[ContactState], bending: bool = False) -> Array:
        """Return the stability margins (T,) of equilibria, where the wall's forces change as the robot moves.

        As of models/loaded/stability.py, with the foundation's part of the second variation beside the bending
        one: 0 at a snap, 1 where no tube acts on another. NaN under a load that has no energy. bending: margins to
        buckling instead.
        """
        if not self.load.conservative:
            return np.full(len(states), np.nan)
        rows = [self._founded_row(state) for state in states]
        numbers = np.repeat(self.robot.numbers[None], len(states), axis=0)
        unknown = States.unknown_states(numbers, np.stack([state.q for state in states]), np.stack(rows))
        placed = unknown._replace(
            angles=np.stack([state.angles for state in states]), axes=np.stack([state.axes for state in states])
        )
        return margins(self._foundation_rods, placed, bending)

    @cached_property
    def _foundation_rods(self) -> LoadedEquilibria:
        """Rods whose responses contain the wall's stiffness."""
        return LoadedEquilibria(self.robot.structure, self.kind._replace(founded=True))

    def _founded_row(self, state: ContactState) -> Array:
        """Return the load numbers of a state with the wall's stiffness on every piece."""
        slope = np.einsum("m,kmij->kij", CONTACT_PIECE_WEIGHTS, self.contact(state).slope)
        # An energy has a symmetric second derivative; a lumen that tapers presses towards its path all the same.
        slope = (slope + np.swapaxes(slope, 1, 2)) / 2
        pieces = len(slope)
        forces = np.hstack([state.pushes.reshape(pieces, 6), slope.reshape(pieces, 9)])
        return np.concatenate([state.load, forces.ravel()])

    def slopes(self, state: ContactState, sigma: Array) -> ContactSlopes:
        """Return shape at sigma (n,) and forces of an equilibrium, with their derivatives by q."""
        d = self.robot.d
        system = self._system(state, self.contact(state), 1.0)
        count = len(system.residual)
        residual_by_q = np.zeros((count, 2 * d + 2))
        residual_by_q[:, d : 2 * d] = system.by_beta
        # Motors and tilt change the misfit alone, and that without another integration of the rod.
        base = _pick(system.rods.ends, slice(0, 1))
        here = self.equilibria.misfit(state.q[None], base)[0]
        for column in (*range(d), 2 * d, 2 * d + 1):
            q = state.q.copy()
            q[column] += TIP_PROBE_RAD
            residual_by_q[: d + 2, column] = (self.equilibria.misfit(q[None], base)[0] - here) / TIP_PROBE_RAD
        z_by_q = -np.linalg.solve(system.jacobian, residual_by_q)
        points = self._points(system.rods, sigma)
        by_z, by_beta = self._differences(points, system.probes)
        points_by_q = np.tensordot(by_z, z_by_q, axes=(0, 0))
        points_by_q[..., d : 2 * d] += np.moveaxis(by_beta, 0, -1)
        lengths = system.rods.lengths
        means = state.pushes[:, 0]
        size = np.linalg.norm(means, axis=1)
        force_by_q = np.zeros((len(size), 2 * d + 2))
        towards = means[system.near] / np.maximum(size[system.near], np.finfo(float).tiny)[:, None]
        by_piece = z_by_q[d + 2 :].reshape(-1, 2, 3, 2 * d + 2)[:, 0]
        force_by_q[system.near] = lengths[0, system.near, None] * np.einsum("kc,kcq->kq", towards, by_piece)
        # Pieces grow with the extensions.
        force_by_q[:, d : 2 * d] += size[:, None] * self._differences(lengths, system.probes)[1].T
        along = np.cumsum(lengths[0]) - lengths[0] / 2
        force = np.asarray(size * lengths[0])
        return ContactSlopes(
            points[0], points_by_q, force, force_by_q, along, lengths[0], system.near, np.asarray(z_by_q)
        )

    def predict(self, state: ContactState, slopes: ContactSlopes, step: Array) -> ContactState:
        """Return the equilibrium after a step (2d + 2,) of q to first order; slopes: of the state."""
        moved = self._apply_step(state, slopes.unknowns_by_q @ step, slopes.near)
        return moved._replace(q=state.q + step)

    def _solve(self, start: ContactState, share: float = 1.0, turned: Array | None = None) -> ContactState | None:
        """Return the equilibrium at q and load of `start`, near its tip and pushes; None where none is found.

        share: part of the wall's stiffness. turned (2d + 2,): change of q since the equilibrium that gave tip and
        pushes, which may be on another branch if the tip turns much more than the motors.
        """
        state = start
        first: ContactState | None = None
        d = self.robot.d
        contact = self.contact(state)
        for _ in range(MAX_CONTACT_NEWTON_STEPS):
            system = self._system(state, contact, share)
            step = _newton_step(system.jacobian, system.residual)
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
                rods = self._rods(tried)
                contact = self._contact(rods)
                ahead = _newton_step(system.jacobian, self._residual(tried, rods, contact, system.near, share))
                if ahead is not None and self._size(ahead, system) <= (1 - part / 4) * size + 1e-9:
                    break
                part /= 2
            else:
                return None
            state = tried
            if abs(step[: d + 2]).max() < CONTACT_TIP_TOLERANCE_RAD and (
                self._mismatch(state, rods, contact, share) < CONTACT_FORCE_TOLERANCE_N
            ):
                sign = float(np.linalg.slogdet(system.jacobian)[0])
                away = max(abs(state.angles - first.angles).max(), abs(state.axes - first.axes).max())
                # Another sign: another branch, or past the end of this one.
                same_branch = sign == start.sign and away < MAX_PREDICTION_ERROR_RAD
                return state._replace(sign=sign) if same_branch else None
        return None

    def _system(self, state: ContactState, contact: WallPush, share: float) -> _System:
        """Return the equations near a state; contact: what the wall does to it; share: part of its stiffness."""
        d = self.robot.d
        pushed = abs(state.pushes).max(axis=(1, 2)) > 0
        near = np.flatnonzero(pushed | (contact.beyond > -NEAR_WALL_MM).any(axis=1))
        count = d + 2 + 6 * len(near)
        which = np.arange(6 * len(near))
        # A row for the state, one for each unknown and one for each extension, changed by its probe.
        angles, axes, beta, pushes = (
            np.repeat(each[None], 1 + count + d, axis=0)
            for each in (state.angles, state.axes, state.q[d : 2 * d], state.pushes)
        )
        tips = slice(1, d + 3)
        angles[tips], axes[tips] = turn_tips(angles[tips], axes[tips], TIP_PROBE_RAD * np.eye(d + 2))
        pushes[d + 3 + which, near[which // 6], which // 3 % 2, which % 3] += PUSH_PROBE_N_PER_MM
        probes = _extension_probes(state.q[d : 2 * d])
        beta[1 + count :] += np.diag(probes)
        rods = self._integrate(angles, axes, beta, pushes, state.load)
        misfits = self.equilibria.misfit(np.repeat(state.q[None], len(beta), axis=0), rods.ends)
        points = self._samples(rods)[:, near]
        jacobian, by_beta = (
            np.vstack([misfit_by.T, -_push_changes(share * contact.slope[near], points_by)])
            for misfit_by, points_by in zip(
                self._differences(misfits, probes), self._differences(points, probes), strict=True
            )
        )
        jacobian[d + 2 + which, d + 2 + which] += 1.0
        return _System(self._residual(state, rods, contact, near, share), jacobian, by_beta, near, rods, probes)

    def _differences(self, values: Array, probes: Array) -> tuple[Array, Array]:
        """Return derivatives (n, ..) over the unknowns and (d, ..) over the extensions of values (1 + n + d, ..).

        values: of the rods of a system. probes (d,): changes of the extensions, mm.
        """
        changes = np.full(len(values) - 1, PUSH_PROBE_N_PER_MM)
        changes[: self.robot.d + 2] = TIP_PROBE_RAD
        changes[-self.robot.d :] = probes
        found = (values[1:] - values[0]) / changes.reshape((-1,) + (1,) * (values.ndim - 1))
        return found[: -self.robot.d], found[-self.robot.d :]

    def _residual(self, state: ContactState, rods: _Rods, contact: WallPush, near: Index, share: float) -> Array:
        """Return F (n,) of a state with these rods, of which the first is its own, and what the wall does to
        it.
        """
        misfit = self.equilibria.misfit(state.q[None], _pick(rods.ends, slice(0, 1)))[0]
        apart = state.pushes[near] - share * PIECE_PROJECTION @ contact.push[near]
        return np.concatenate([misfit, apart.ravel()])

    def _mismatch(self, state: ContactState, rods: _Rods, contact: WallPush, share: float) -> float:
        """Return the sum over pieces of the difference between force and push, N."""
        apart = state.pushes - share * PIECE_PROJECTION @ contact.push
        return float((np.linalg.norm(apart, axis=2).sum(axis=1) * rods.lengths[0]).sum())

    def _size(self, step: Array, system: _System) -> float:
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

    def _rods(self, state: ContactState) -> _Rods:
        """Return the rod of a state, as a batch of one."""
        d = self.robot.d
        beta = state.q[None, d : 2 * d]
        return self._integrate(state.angles[None], state.axes[None], beta, state.pushes[None], state.load)

    def _integrate(self, angles: Array, axes: Array, beta: Array, pushes: Array, load: Array) -> _Rods:
        """Integrate T rods from tips with angles (T, d) and axes (T, 3, 3) at extensions (T, d), mm.

        pushes (T, K, 2, 3): forces per length on the pieces, N/mm. load (17 + 3d,): numbers of what else acts.
        """
        rows = len(beta)
        numbers = np.repeat(self.robot.numbers[None], rows, axis=0)
        acting = np.hstack([np.repeat(load[None], rows, axis=0), pushes.reshape(rows, -1)])
        ends = self.equilibria.rods(numbers, angles, axes, beta, acting, np.ones((rows, 2)))
        return _Rods(ends, beta, piece_positions(self.robot, self.kind, beta)[1])

    def _contact(self, rods: _Rods) -> WallPush:
        """Return what the wall does to the sample points (K, 5) of the first of some rods."""
        places = np.cumsum(rods.lengths[0]) - rods.lengths[0]
        s = places[:, None] + rods.lengths[0, :, None] * CONTACT_PIECE_SAMPLE_PARTS
        # The outermost tube at a place follows from the ends of tubes.
        beta = rods.beta[:1]
        radius = outermost_tube_radii(self.robot, beta, (s / beta[0, -1]).ravel()[None])
        return self.wall.push(self._samples(rods)[0], radius.reshape(s.shape))

    def _samples(self, rods: _Rods) -> Array:
        """Return the sample points (T, K, 5, 3) of the pieces of rods, mm."""
        starts, coefficients = self._curves(rods)
        weights = _integrals(CONTACT_PIECE_SAMPLE_PARTS, self.kind.steps)
        return starts[:, :, None] + np.einsum("mn,tknc->tkmc", weights, coefficients)

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
    """Return changes (d,) of extensions beta (d,), mm, that keep the tubes' ends in order where they can."""
    room = np.append(np.diff(beta), np.inf)
    return np.where(room > EXTENSION_PROBE_MM, EXTENSION_PROBE_MM, -EXTENSION_PROBE_MM)


def _integrals(part: Array, steps: int) -> Array:
    """Return the integrals of 1, f, .., f^steps from 0 to `part` (..): (.., steps + 1)."""
    powers = np.arange(1, steps + 2)
    return np.asarray(part[..., None] ** powers / powers)


def _push_changes(slope: Array, points_by: Array) -> Array:
    """Return changes (6 N, n) of the mean and growth of pushes on N pieces.

    slope (N, m, 3, 3): of the push at each sample point. points_by (n, N, m, 3): changes of the points.
    """
    changes = np.einsum("kmij,zkmj->kmiz", slope, points_by, optimize=True)
    return np.einsum("gm,kmiz->kgiz", PIECE_PROJECTION, changes).reshape(-1, len(points_by))


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


def _pick(ends: RodBases, which: slice) -> RodBases:
    """Return some of several rods."""
    return RodBases(*(each[which] for each in ends))
