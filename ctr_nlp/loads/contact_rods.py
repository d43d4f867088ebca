"""Rods whose pieces lean on a wall that gives, and the equations of their equilibrium.

Along each piece of the robot (rod_pieces.py) the wall exerts a force per length f, N/mm, that is linear along it:
the projection of the Winkler foundation's push w (winkler_wall.py), so that f and w have the same resultant at the
same place. Both are then independent of the division into pieces, also where a tip alone touches. With the rod
integrated from its tip under f (models/loaded), the unknowns z are d + 2 changes of the tip and f on every piece
near the wall:

    F(z, q) = ( misfit of the base against q,  f - w(points(z, q)) ) = 0.

Forces are unknowns beside the tip, so that a hard wall makes the equations no worse: the rigid wall is the limit
of a large stiffness. Derivatives of F are forward differences over rods that are integrated side by side, those of
all robots in one batch.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.loads.rod_pieces import kind_with_pieces, piece_positions
from ctr_nlp.loads.winkler_wall import WallPush, WinklerWall
from ctr_nlp.models.loaded.compiled import RodBases
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria
from ctr_nlp.models.loaded.rod_loads import RodKind
from ctr_nlp.models.loaded.tips import turn_tips
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.paths.lumen import outermost_tube_radii
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Index

QUADRATURE_PANELS = 6
"""Number of equal parts of a piece on which the wall's push is integrated separately. Where a piece begins to
touch, the push has a corner, which a rule over the whole piece misses: by up to 0.06 mm of the tip's place."""
SEARCHED_PANELS = 2
"""The same in searches for motions, whose wall has no corners."""
_LOBATTO_PARTS = np.array([0.0, (1 - np.sqrt(3 / 7)) / 2, 0.5, (1 + np.sqrt(3 / 7)) / 2, 1.0])
_LOBATTO_WEIGHTS = np.array([9.0, 49.0, 64.0, 49.0, 9.0]) / 180
PLACE_LENGTH_MM = 10.0
"""Length of the robot on which forces count as those of one place, mm."""
TIP_PROBE_RAD, PUSH_PROBE_N_PER_MM, EXTENSION_PROBE_MM = 1e-6, 1e-5, 1e-5
"""Changes of tip, forces and extensions for forward differences."""
EMPTY_PIECE_MM = 1e-9
"""Length below which a piece counts as empty, mm."""


class QuadratureRule(NamedTuple):
    """Lobatto's rule on equal parts of a piece.

    parts (M,): points, as parts of the piece, which contain both ends. weights (M,). projection (2, M): of samples
    of a push to its mean and its growth along the piece (rod_loads.PieceForce).
    """

    parts: Array
    weights: Array
    projection: Array


@functools.cache
def piece_rule(panels: int) -> QuadratureRule:
    """Return the rule of five points on each of so many equal parts of a piece, which share their ends."""
    inner = len(_LOBATTO_PARTS) - 1
    parts = np.zeros(panels * inner + 1)
    weights = np.zeros(len(parts))
    for k in range(panels):
        panel = slice(k * inner, (k + 1) * inner + 1)
        parts[panel] = (k + _LOBATTO_PARTS) / panels
        weights[panel] += _LOBATTO_WEIGHTS / panels
    return QuadratureRule(parts, weights, weights * np.stack([np.ones_like(parts), 3 * (2 * parts - 1)]))


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


class ContactStates(NamedTuple):
    """Equilibria of T robots: the entries of ContactState, each with T rows."""

    q: Array
    load: Array
    angles: Array
    axes: Array
    pushes: Array
    sign: Array

    @classmethod
    def stack(cls, states: Sequence[ContactState]) -> ContactStates:
        """Return states (T,) as one."""
        return cls(*(np.stack(each) for each in zip(*states, strict=True)))

    def rows(self, which: Any) -> ContactStates:
        """Return the states of some rows; `which` is any index of several."""
        return ContactStates(*(each[which] for each in self))

    def row(self, k: int) -> ContactState:
        """Return one of the states; k: its number, from 0."""
        q, load, angles, axes, pushes, sign = self
        return ContactState(q[k], load[k], angles[k], axes[k], pushes[k], float(sign[k]))

    def apply_changes(self, tips: Array, pushes: Array, q: Array) -> ContactStates:
        """Return states after changes of tips (T, d + 2), of pushes (T, K, 2, 3) and of q (T, 2d + 2)."""
        angles, axes = turn_tips(self.angles, self.axes, tips)
        return self._replace(q=self.q + q, angles=angles, axes=axes, pushes=self.pushes + pushes)


class PieceForces(NamedTuple):
    """The wall's forces on K pieces of T robots.

    along (T, K): middles of the pieces, mm. force (T, K): on each, N. at_places (T, K): sums on PLACE_LENGTH_MM
    around these middles, N.
    """

    along: Array
    force: Array
    at_places: Array


class ContactBodies(NamedTuple):
    """T rods; ends: at their bases. beta (T, d): extensions, mm. lengths (T, K): of their pieces, mm."""

    ends: RodBases
    beta: Array
    lengths: Array


class ContactSystem(NamedTuple):
    """The equations near one state.

    residual (n,), jacobian (n, n), by_q (n, 2d + 2): F, dF/dz and dF/dq. near: pieces whose forces are unknowns.
    rods: rows of the state itself, of each changed unknown, and of each changed extension; probes (d,): the
    changes of extensions, mm. lengths (1 + n + d, K): of these rods' pieces, mm.
    """

    residual: Array
    jacobian: Array
    by_q: Array
    near: Index
    rods: slice
    probes: Array
    lengths: Array


@dataclass(frozen=True)
class ContactRods:
    """Rods of one robot that lean on a wall. Not to be used from several threads at once.

    robot: with moduli in MPa. wall: the foundation. load: what else acts, which decides the kind of rods.
    searched: whether motions are searched among these rods, by a smooth law of the wall, instead of judged. Fewer
    points will do then, and stability margins leave the wall's curvature out: the third derivatives of a distance
    field jump from cell to cell, and slopes of margins would jump with them.
    """

    robot: Robot
    wall: WinklerWall
    load: Load | LoadOverTime
    searched: bool = False

    @cached_property
    def kind(self) -> RodKind:
        """Kind of rods: that of the load, with sections divided into pieces that have forces of their own."""
        return kind_with_pieces(self.load, self.robot.d)

    @cached_property
    def equilibria(self) -> LoadedEquilibria:
        """Solver of equilibria of rods with given forces on every piece."""
        return LoadedEquilibria(self.robot.structure, self.kind)

    @property
    def rule(self) -> QuadratureRule:
        """Points of a piece at which the wall's push is taken."""
        return piece_rule(SEARCHED_PANELS if self.searched else QUADRATURE_PANELS)

    def bodies(self, states: ContactStates) -> ContactBodies:
        """Integrate the rods of T states from their tips."""
        rows, beta = len(states.q), self.robot.split(states.q)[1]
        numbers = np.repeat(self.robot.numbers[None], rows, axis=0)
        acting = np.hstack([states.load, states.pushes.reshape(rows, -1)])
        ends = self.equilibria.rods(numbers, states.angles, states.axes, beta, acting, np.ones((rows, 2)))
        return ContactBodies(ends, beta, piece_positions(self.robot, self.kind, beta)[1])

    def shapes(self, states: ContactStates, sigma: Array) -> Array:
        """Return points (T, n, 3), mm, of states at sigma (n,), parts of the robot's length."""
        return self.points(self.bodies(states), sigma)

    def forces(self, states: ContactStates) -> PieceForces:
        """Return the wall's forces on the pieces of T states."""
        along, lengths = piece_positions(self.robot, self.kind, self.robot.split(states.q)[1])
        force = np.linalg.norm(states.pushes[:, :, 0], axis=2) * lengths
        return PieceForces(along, force, (place_matrix(along, lengths) @ force[..., None])[..., 0])

    def samples(self, bodies: ContactBodies) -> tuple[Array, Array]:
        """Return the points (T, K, M, 3) of all pieces of T rods, and the robot's radii there (T, K, M), mm."""
        count, pieces = bodies.lengths.shape
        found = self._samples_of(bodies, np.repeat(np.arange(count), pieces), np.tile(np.arange(pieces), count))
        points, radius = (each.reshape(count, pieces, *each.shape[1:]) for each in found)
        return points, radius

    def contacts(self, bodies: ContactBodies) -> WallPush:
        """Return what the wall does to the points (T, K, M) of all pieces of T rods."""
        return self.wall.push(*self.samples(bodies))

    def contacts_of(self, bodies: ContactBodies, rows: Index, pieces: Index) -> WallPush:
        """Return what the wall does to the points (N, M) of some pieces (N,) of some rods (N,)."""
        return self.wall.push(*self._samples_of(bodies, rows, pieces))

    def find_near(self, states: ContactStates, contact: WallPush, within: float) -> list[Index]:
        """Return the pieces of each state that bear forces, or are so many mm from the wall."""
        pushed = abs(states.pushes).max(axis=(2, 3)) > 0
        return [np.flatnonzero(each) for each in pushed | (contact.beyond > -within).any(axis=2)]

    def systems(
        self, states: ContactStates, near: Sequence[Index], contact: WallPush, share: float = 1.0
    ) -> tuple[list[ContactSystem], ContactBodies]:
        """Return the equations near T states, and all rods that they come from.

        near: pieces of each state whose forces are unknowns. contact: what the wall does to each state (T, K, ..).
        share: part of the wall's stiffness.
        """
        d = self.robot.d
        counts = [d + 2 + 6 * len(each) for each in near]
        # Rows for each state: the state itself, one for each unknown and one for each extension, changed by its
        # probe.
        begins = np.cumsum([0, *(1 + count + d for count in counts)])
        own = begins[:-1]
        changed = states.rows(np.repeat(np.arange(len(counts)), np.diff(begins)))
        turned = (own[:, None] + 1 + np.arange(d + 2)).ravel()
        turns = np.tile(TIP_PROBE_RAD * np.eye(d + 2), (len(counts), 1))
        changed.angles[turned], changed.axes[turned] = turn_tips(
            changed.angles[turned], changed.axes[turned], turns
        )
        probes = _extension_probes(states.q[:, d : 2 * d])
        for begin, count, pieces, probe in zip(own, counts, near, probes, strict=True):
            which = np.arange(6 * len(pieces))
            pushed = begin + d + 3 + which, pieces[which // 6], which // 3 % 2, which % 3
            changed.pushes[pushed] += PUSH_PROBE_N_PER_MM
            changed.q[begin + 1 + count + np.arange(d), d + np.arange(d)] += probe
        rods = self.bodies(changed)
        # The base is compared with the same configuration in all rows: extensions change the rod alone.
        misfits = self.equilibria.misfit(states.q[np.repeat(np.arange(len(counts)), np.diff(begins))], rods.ends)
        motors_by = self._misfit_by_motors(states, rods, own)
        terms = self.curve_terms(rods)
        found = []
        for k, (pieces, count) in enumerate(zip(near, counts, strict=True)):
            rows = slice(begins[k], begins[k + 1])
            slope = self._push_slopes(share * contact.slope[k, pieces])
            misfit_by, misfit_by_beta = self.differences(misfits[rows], probes[k])
            terms_by, terms_by_beta = self.differences(terms[rows][:, pieces], probes[k])
            jacobian = np.vstack([misfit_by.T, -_push_changes(slope, terms_by)])
            jacobian[d + 2 :, d + 2 :] += np.eye(6 * len(pieces))
            by_q = np.zeros((count, 2 * d + 2))
            by_q[: d + 2] = motors_by[k]
            by_q[:, d : 2 * d] = np.vstack([misfit_by_beta.T, -_push_changes(slope, terms_by_beta)])
            apart = states.pushes[k, pieces] - share * self.rule.projection @ contact.push[k, pieces]
            residual = np.concatenate([misfits[begins[k]], apart.ravel()])
            found.append(ContactSystem(residual, jacobian, by_q, pieces, rows, probes[k], rods.lengths[rows]))
        return found, rods

    def residuals(
        self,
        states: ContactStates,
        bodies: ContactBodies,
        near: Sequence[Index],
        contact: WallPush | None = None,
        share: float = 1.0,
    ) -> list[Array]:
        """Return F (P, n) of T groups of P states with these rods (T P,).

        near: pieces of the states of each group whose forces are unknowns. contact: what the wall does to each
        state (T P, K, ..), where that is known. share: part of the wall's stiffness.
        """
        each = len(states.q) // len(near)
        misfits = self.equilibria.misfit(states.q, bodies.ends).reshape(len(near), each, -1)
        sizes = [len(pieces) for pieces in near for _ in range(each)]
        rows, pieces = np.repeat(np.arange(len(sizes)), sizes), np.concatenate([np.tile(k, each) for k in near])
        push = self.contacts_of(bodies, rows, pieces).push if contact is None else contact.push[rows, pieces]
        apart = states.pushes[rows, pieces] - share * self.rule.projection @ push
        groups = np.split(apart, np.cumsum([each * len(pieces) for pieces in near])[:-1])
        return [
            np.hstack([misfit, group.reshape(each, -1)]) for misfit, group in zip(misfits, groups, strict=True)
        ]

    def differences(self, values: Array, probes: Array) -> tuple[Array, Array]:
        """Return derivatives (n, ..) over the unknowns and (d, ..) over the extensions of one system's values.

        values (1 + n + d, ..): of its rods. probes (d,): changes of the extensions, mm.
        """
        d = self.robot.d
        changes = np.full(len(values) - 1, PUSH_PROBE_N_PER_MM)
        changes[: d + 2] = TIP_PROBE_RAD
        changes[-d:] = probes
        found = (values[1:] - values[:1]) / changes.reshape(-1, *(1,) * (values.ndim - 1))
        return found[:-d], found[-d:]

    def curve_terms(self, bodies: ContactBodies) -> Array:
        """Return terms (T, K, 1 + n, 3), mm, in which points of a piece are linear: its start, and its curve's."""
        starts, coefficients = self._curves(bodies)
        return np.concatenate([starts[:, :, None], coefficients], axis=2)

    def points(self, bodies: ContactBodies, sigma: Array) -> Array:
        """Return points (T, n, 3), mm, of rods at sigma (n,), parts of their lengths."""
        starts, coefficients = self._curves(bodies)
        ends = np.cumsum(bodies.lengths, axis=1)
        s = sigma * bodies.beta[:, -1:]
        # The first piece that ends at s or beyond it; rounding must not lead past the last one.
        piece = np.minimum((ends[:, None] < s[..., None] - 1e-12).sum(axis=-1), ends.shape[1] - 1)
        rows = np.arange(len(s))[:, None]
        lengths = bodies.lengths[rows, piece]
        part = (s - ends[rows, piece] + lengths) / np.where(lengths > EMPTY_PIECE_MM, lengths, np.inf)
        weights = _integrals(part, self.kind.steps)
        with np.errstate(invalid="ignore"):
            return np.asarray(starts[rows, piece] + (weights[:, :, None] @ coefficients[rows, piece])[:, :, 0])

    def _samples_of(self, bodies: ContactBodies, rows: Index, pieces: Index) -> tuple[Array, Array]:
        """Return the points (N, M, 3) of some pieces of some rods, and the robot's radii there (N, M), mm."""
        middles = np.cumsum(bodies.lengths, axis=1) - bodies.lengths / 2
        # One tube is the outermost along a whole piece. At its ends, where samples are, rounding would decide.
        radius = outermost_tube_radii(self.robot, bodies.beta, middles / bodies.beta[:, -1:])[rows, pieces]
        samples = self._term_weights @ self.curve_terms(bodies)[rows, pieces]
        return samples, np.repeat(radius[:, None], samples.shape[1], axis=1)

    def _misfit_by_motors(self, states: ContactStates, rods: ContactBodies, own: Index) -> Array:
        """Return the derivatives (T, d + 2, 2d + 2) of misfits by motors and tilt; own: rows of the states' rods.

        They change the misfit alone, and that without another integration of the rod.
        """
        d = self.robot.d
        columns = [*range(d), 2 * d, 2 * d + 1]
        changed = np.repeat(states.q[:, None], 1 + len(columns), axis=1)
        changed[:, 1 + np.arange(len(columns)), columns] += TIP_PROBE_RAD
        bases = RodBases(*(each[np.repeat(own, 1 + len(columns))] for each in rods.ends))
        misfits = self.equilibria.misfit(changed.reshape(-1, 2 * d + 2), bases).reshape(*changed.shape[:2], -1)
        found = np.zeros((len(own), d + 2, 2 * d + 2))
        found[..., columns] = np.swapaxes((misfits[:, 1:] - misfits[:, :1]) / TIP_PROBE_RAD, 1, 2)
        return found

    def _push_slopes(self, slope: Array) -> Array:
        """Return derivatives (N, 6, 3m) of the mean and growth of pushes on N pieces by their curves' m terms.

        slope (N, M, 3, 3): of the push at the points of each piece.
        """
        terms = self._term_weights.shape[1]
        weights = self.rule.projection[:, None] * self._term_weights.T
        found = (weights.reshape(2 * terms, -1) @ slope.reshape(*slope.shape[:2], 9)).reshape(-1, 2, terms, 3, 3)
        return np.asarray(found.transpose(0, 1, 3, 2, 4).reshape(-1, 6, 3 * terms))

    @cached_property
    def _term_weights(self) -> Array:
        """Matrix (M, 1 + n) from the terms of a piece's curve to its points."""
        parts = self.rule.parts
        return np.column_stack([np.ones_like(parts), _integrals(parts, self.kind.steps)])

    @cached_property
    def _to_powers(self) -> Array:
        """Matrix from tangents at the nodes of a piece to the coefficients of the polynomial through them."""
        nodes = np.linspace(0.0, 1.0, self.kind.steps + 1)
        return np.asarray(np.linalg.inv(np.vander(nodes, increasing=True)))

    def _curves(self, bodies: ContactBodies) -> tuple[Array, Array]:
        """Return where pieces of rods begin (T, K, 3), mm, and their tangents' polynomials (T, K, n, 3) times
        length.
        """
        # Rods that are bent far beyond any equilibrium are not finite: trials that are given up.
        with np.errstate(invalid="ignore"):
            coefficients = self._to_powers @ bodies.ends.tangents
            coefficients *= bodies.lengths[..., None, None]
            gains = (_integrals(np.ones(1), self.kind.steps) @ coefficients)[..., 0, :]
        return np.cumsum(gains, axis=1) - gains, coefficients


def place_matrix(along: Array, lengths: Array) -> Array:
    """Return the matrix (.., K, K) from forces on pieces to those on PLACE_LENGTH_MM around the middle of each.

    along, lengths (.., K): middles and lengths of the pieces, mm. A piece counts with the part of it that lies
    there.
    """
    half = PLACE_LENGTH_MM / 2
    middles, begins, ends = along[..., :, None], along - lengths / 2, along + lengths / 2
    low = np.maximum(middles - half, begins[..., None, :])
    high = np.minimum(middles + half, ends[..., None, :])
    return np.asarray(np.maximum(high - low, 0.0) / np.maximum(lengths, np.finfo(float).tiny)[..., None, :])


def _extension_probes(beta: Array) -> Array:
    """Return changes (T, d) of extensions beta (T, d), mm, that keep the tubes' ends in order where they can."""
    return signed_probes(beta, np.full(beta.shape, EXTENSION_PROBE_MM))


def signed_probes(beta: Array, sizes: Array) -> Array:
    """Return changes of these sizes (T, d), mm, of extensions beta (T, d), mm, downwards where a tube's end would
    come to the next one's.
    """
    room = np.pad(np.diff(beta, axis=1), ((0, 0), (0, 1)), constant_values=np.inf)
    return np.where(room > sizes, sizes, -sizes)


def _integrals(part: Array, steps: int) -> Array:
    """Return the integrals of 1, f, .., f^steps from 0 to `part` (..): (.., steps + 1)."""
    powers = np.arange(1, steps + 2)
    return np.asarray(part[..., None] ** powers / powers)


def _push_changes(slope: Array, terms_by: Array) -> Array:
    """Return changes (6 N, n) of the mean and growth of pushes on N pieces.

    slope (N, 6, 3m): of both by the m terms of each piece's curve. terms_by (n, N, m, 3): changes of these.
    """
    changes, pieces, terms, _ = terms_by.shape
    columns = terms_by.reshape(changes, pieces, 3 * terms).transpose(1, 2, 0)
    return np.asarray(slope @ columns).reshape(6 * pieces, changes)
