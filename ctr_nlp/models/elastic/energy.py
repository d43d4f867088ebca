"""The elastic model's energy by Galerkin's method: tubes' twists are polynomials in every section.

The energy of docs/method.md, E = sum_i int GJ_i/2 psi_i'^2 ds - int |sum_i EI_i k_i e(psi_i)|^2 / (2 sum_i EI_i)
ds, depends on the angles through differences only: up to a constant its second part is the sum over pairs of tubes
of - int EI_i EI_j k_i k_j cos(psi_i - psi_j) / sum EI ds. The motors are fixed, and a twist psi_i' (rad/mm) is a
sum of Legendre polynomials in every section and a constant in the transmission, normalised so that the first part
is |a|^2 / 2.

Its second variation K + V has the stability margin as its smallest eigenvalue, and a robot that snaps moves down
its gradient. One source for symbols and numbers: `xp` is casadi or numpy.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.polynomial import Legendre

from ctr_nlp.models.dominant.shape import columns_of
from ctr_nlp.models.elastic.torsion import (
    RobotSection,
    curvatures_at,
    sections,
    turned_untwisted,
    twist,
)
from ctr_nlp.robot.structure import Tubes
from ctr_nlp.typing import Array, Index

DEGREE = 6
"""Number of polynomials, of degrees 0 to DEGREE - 1, that a tube's twist is a sum of in every section.

With fewer the margin is too large, as in every Galerkin method: of long sections with curvatures that change their
sign by 0.026 with 3, where 6 leave 0.004.
"""
ENERGY_STEPS_PER_SECTION = 6
"""Steps of integration a section: the integrals of these polynomials need more than shapes do."""
SECTION_NODE_FRACTIONS = np.linspace(0.0, 1.0, 2 * ENERGY_STEPS_PER_SECTION + 1)
"""Fractions of a section's length at which angles are compared: the nodes of torsion.twist."""
ANGLES = [
    np.sqrt(2 * n + 1) * Legendre.basis(n, domain=(0, 1)).integ(lbnd=0)(SECTION_NODE_FRACTIONS)
    for n in range(DEGREE)
]
"""Angles at SECTION_NODE_FRACTIONS by which twists by orthonormal polynomials turn a tube: their integrals from
the section's base.
"""


class Energy(NamedTuple):
    """E(a) = |a|^2 / 2 - sum strength cos(angle), where the tubes' twist is a combination of n unit twists by a
    (n,).

    Angles (rows,), rad, are those between two tubes at a node: couples (rows, d) alpha + helix_angles[:rows] +
    turns (rows, n) a. Those of the tips are alpha + helix_angles[rows:] + ends (d, n) a. helix_angles (rows + d,):
    angles by which helices turn by their own torsion. strength (rows,): EI_i EI_j k_i k_j / sum EI times the
    node's weight.
    """

    strength: Array
    couples: Array
    turns: Array
    ends: Array
    helix_angles: Array

    def height(self, a: Array, angles: Array) -> float:
        """Return the energy E(a) at coefficients a (n,); angles (rows,) in rad belong to a."""
        return float(a @ a / 2 - self.strength @ np.cos(angles))

    def gradient(self, a: Array, angles: Array) -> Array:
        """Return the gradient dE/da, (n,), at coefficients a (n,); angles (rows,) in rad belong to a."""
        return a + (self.strength * np.sin(angles)) @ self.turns

    def hessian(self, angles: Array) -> Array:
        """Return the second variation K + V, (n, n), at angles (rows,) in rad.

        In these coordinates K is the identity.
        """
        # -cos(angle) has the second derivative +cos(angle): couples at less than a quarter turn stiffen, opposed
        # ones soften.
        return np.eye(self.turns.shape[1]) + (self.strength * np.cos(angles) * self.turns.T) @ self.turns


def differences(tubes: Tubes, x: Array) -> Array:
    """Return the angles (T, rows) between tubes, rows as in Energy, at every x (T, 2d + 2)."""
    columns = columns_of(x)
    parts = sections(tubes, columns[len(tubes) : 2 * len(tubes)], np)
    nodes = twist(tubes, columns, parts, np, ENERGY_STEPS_PER_SECTION).nodes
    found = [node.angles[i] - node.angles[j] for k, i, j in _couples(parts) for node in nodes[k]]
    # broadcast_arrays with the first column gives every angle the T rows that a constant one lacks; that
    # column is dropped again, and zeros keep the result two-dimensional where no tubes act on each other.
    return np.hstack([np.zeros((len(x), 0)), *np.broadcast_arrays(*found, columns[0])[:-1]])


def energies(tubes: Tubes, x: Array) -> Iterator[Energy]:
    """Yield the Energy of tubes at the extensions of every x (T, 2d + 2), one after the other."""
    columns = columns_of(x)
    parts = sections(tubes, columns[len(tubes) : 2 * len(tubes)], np)
    twists = _twists(tubes, columns, parts, np)
    couples = _couples(parts)
    turns = _pattern(parts, twists)
    # couples: each row is alpha_i - alpha_j.
    signs = np.array(
        [np.eye(len(tubes))[i] - np.eye(len(tubes))[j] for _, i, j in couples for _ in SECTION_NODE_FRACTIONS]
    )
    ends = _ends(tubes, twists)
    none = np.zeros((len(x), 0))
    scale = np.hstack(np.broadcast_arrays(*(one.scale for one in twists), columns[0])[:-1] or [none])
    strength = [
        np.broadcast_to(_strength(tubes, columns, parts[k], i, j, np), (len(x), len(SECTION_NODE_FRACTIONS)))
        for k, i, j in couples
    ]
    made = np.hstack(_helix_angles(tubes, columns, parts, np))
    for of_rows, of_twists, of_tubes in zip(np.hstack(strength or [none]), scale, made, strict=True):
        # Twists of empty sections have scale 0: they would be eigenvectors with eigenvalue 1 and are left
        # out.
        there = of_twists > 0
        turned, ended = (each[:, there] * of_twists[there] for each in (turns, ends))
        yield Energy(of_rows, signs, turned, ended, of_tubes)


class Symbols(NamedTuple):
    """The Energy in symbols for any beta, of m twists that turn tubes against each other; other twists stay zero.

    strength, angles (rows, 1), turns (rows, m), ends (d, m), helix_angles (rows + d, 1): as in Energy. couples (2,
    rows): the two tubes of each angle. second (m, m): K + V, whose eigenvalues below 1 are those of all twists.
    """

    strength: ca.SX
    angles: ca.SX
    turns: ca.SX
    ends: ca.SX
    helix_angles: ca.SX
    couples: Index
    second: ca.SX


def in_symbols(tubes: Tubes, x: Sequence[Any]) -> Symbols:
    """Build the energy of any robot of a structure in symbols.

    tubes: with symbols for numbers. x: 2d + 2 symbols.
    """
    parts = sections(tubes, x[len(tubes) : 2 * len(tubes)], ca)
    nodes = twist(tubes, x, parts, ca, ENERGY_STEPS_PER_SECTION).nodes
    # An empty row first: a robot on which no tubes act on each other has no couples, but still needs shapes.
    strength = [ca.SX(1, 0)]
    angles = [ca.SX(1, 0)]
    for k, i, j in _couples(parts):
        angles.append(ca.horzcat(*(node.angles[i] - node.angles[j] for node in nodes[k])))
        strength.append(_strength(tubes, x, parts[k], i, j, ca))
    twists = _twists(tubes, x, parts, ca)
    against = _relative_twist_basis(tubes, parts, twists)
    scaled = ca.diag(ca.vertcat(ca.SX(0, 1), *(one.scale for one in twists))) @ against
    couples = (
        np.array([(i, j) for _, i, j in _couples(parts) for _ in SECTION_NODE_FRACTIONS], dtype=int)
        .reshape(-1, 2)
        .T
    )
    weights = [pulls * ca.cos(turned) for pulls, turned in zip(strength[1:], angles[1:], strict=True)]
    second = _second(tubes, parts, twists, against, weights)
    turns, ends = (ca.sparsify(ca.DM(each)) @ scaled for each in (_pattern(parts, twists), _ends(tubes, twists)))
    made = ca.vertcat(*(ca.vec(ca.SX(each)) for each in _helix_angles(tubes, x, parts, ca)))
    return Symbols(ca.horzcat(*strength).T, ca.horzcat(*angles).T, turns, ends, made, couples, second)


def _second(
    tubes: Tubes, parts: Sequence[RobotSection], twists: Sequence[_Twist], against: ca.SX, weights: Sequence[ca.SX]
) -> ca.SX:
    """Build the matrix K + V (m, m) of twists against each other.

    weights (1, nodes): strength cos(angle) of every couple. Each twist turns two tubes against each other by a sum
    of a constant and ANGLES, so that V consists of moments of weights.
    """
    # Within section k, a twist of k itself turns by ANGLES[degree], one of a section nearer to the base by
    # a constant, its angle at that section's end.
    basis = np.array([np.ones(len(SECTION_NODE_FRACTIONS)), *ANGLES])
    found = ca.SX.eye(against.shape[1])
    for (k, i, j), weight in zip(_couples(parts), weights, strict=True):
        turns = ca.SX(len(basis), len(twists))
        for column, one in enumerate(twists):
            sign = (one.tube == i) - (one.tube == j)
            if sign and (one.section == k or (one.section < k and one.end)):
                turns[1 + one.degree if one.section == k else 0, column] = sign * one.scale
        turns = turns @ against
        # V = sum over couples and nodes of weight (turn of i - turn of j)(turn of i - turn of j)'.
        found += turns.T @ (basis @ ca.diag(weight) @ basis.T) @ turns
    return found


def _relative_twist_basis(tubes: Tubes, parts: Sequence[RobotSection], twists: Sequence[_Twist]) -> ca.SX:
    """Return an orthonormal basis (n, m) of twists, without the one in each section and degree that turns all
    tubes alike.
    """
    columns = list[ca.SX]()
    for k, degree in sorted({(one.section, one.degree) for one in twists}):
        rows = [row for row, one in enumerate(twists) if (one.section, one.degree) == (k, degree)]
        own = ca.SX.eye(len(rows))
        if k >= 0:  # Householder's reflection of the common twist onto the last column, which is left out
            # Unit twists turn by angles proportional to 1 / sqrt(GJ), so that all tubes turn alike by
            # coefficients proportional to sqrt(GJ). Such a twist changes no difference: V is 0 there, the
            # eigenvalue 1.
            acting = [tubes[twists[row].tube] for row in rows]
            alike = ca.vertcat(*(ca.sqrt(tube.bending_stiffness / tube.torsional_ratio) for tube in acting))
            normal = alike / ca.norm_2(alike) + own[:, -1]
            own = (own - 2 * normal @ normal.T / ca.sumsqr(normal))[:, :-1]
        whole = ca.SX(len(twists), own.shape[1])
        whole[rows, :] = own
        columns.append(whole)
    return ca.horzcat(ca.SX(len(twists), 0), *columns)


class _Twist(NamedTuple):
    """A tube's unit twist in a section (-1: its transmission), a Legendre polynomial.

    scale (T, 1) normalises its K to 1.
    """

    tube: int
    section: int
    degree: int
    scale: Any

    @property
    def end(self) -> float:
        """Angle by which it turns the tube's tip, without the scale: polynomials of higher degree have the
        mean 0.
        """
        return float(self.degree == 0)

    def angles(self, section: int, tube: int) -> Array:
        """Angles by which it turns a tube at a section's nodes, without the scale."""
        if tube != self.tube or section < self.section:
            return np.zeros(len(SECTION_NODE_FRACTIONS))
        # The motor is fixed: nothing turns between it and the twist's section, and everything beyond turns by its
        # end.
        return ANGLES[self.degree] if section == self.section else np.full(len(SECTION_NODE_FRACTIONS), self.end)


def _twists(tubes: Tubes, columns: Sequence[Any], parts: Sequence[RobotSection], xp: Any) -> list[_Twist]:
    """Return unit twists: of the transmissions, and below DEGREE of every tube where others act on it."""
    acting = {k: part.active for k, part in enumerate(parts) if len(part.active) > 1}
    found = []
    for i in sorted({i for active in acting.values() for i in active}):
        tube = tubes[i]
        # 1 / GJ. With psi' = scale P(s) / length and the mean of P^2 equal to 1, int GJ psi'^2 ds = GJ
        # scale^2 / length = 1.
        compliance = tube.torsional_ratio / tube.bending_stiffness
        lengths = {-1: tube.length - columns[len(tubes) + i]}
        lengths |= {k: parts[k].length for k, active in acting.items() if i in active}
        for k, length in lengths.items():
            scale = xp.sqrt(compliance * xp.fmax(length, 0.0))
            # No moment acts along a transmission, so that its twist is constant: degree 0 alone.
            found += [_Twist(i, k, n, scale) for n in range(1 if k == -1 else DEGREE)]
    return found


def _couples(parts: Sequence[RobotSection]) -> list[tuple[int, int, int]]:
    """Return each section and pair of tubes in it that act on each other there."""
    return [(k, i, j) for k, part in enumerate(parts) for i, j in itertools.combinations(part.active, 2)]


def _pattern(parts: Sequence[RobotSection], twists: Sequence[_Twist]) -> Array:
    """Return the angles by which twists (columns) turn two tubes against each other at nodes (rows), without
    scales.
    """
    couples = _couples(parts)
    found = [one.angles(k, i) - one.angles(k, j) for one in twists for k, i, j in couples]
    return np.reshape(found, (len(twists), len(couples) * len(SECTION_NODE_FRACTIONS))).T


def _ends(tubes: Tubes, twists: Sequence[_Twist]) -> Array:
    """Return the angles by which twists (columns) turn the tubes' tips (rows), without the scales."""
    return np.reshape([[one.end * (one.tube == i) for one in twists] for i in range(len(tubes))], (len(tubes), -1))


def _helix_angles(tubes: Tubes, columns: Sequence[Any], parts: Sequence[RobotSection], xp: Any) -> list[Any]:
    """Return angles by which helices turn by themselves: couples at nodes, (T, nodes) each, then tips, (T, 1)
    each.
    """
    nodes = ca.DM(SECTION_NODE_FRACTIONS).T if xp is ca else SECTION_NODE_FRACTIONS
    none = 0 * columns[0]
    found = []
    for k, i, j in _couples(parts):
        s = parts[k].start + parts[k].length * nodes
        found.append(turned_untwisted(tubes, columns, i, s) - turned_untwisted(tubes, columns, j, s) + 0 * s)
    return [*found, *(none + tube.spin * tube.curved_length for tube in tubes)]


def _strength(tubes: Tubes, columns: Sequence[Any], part: RobotSection, i: int, j: int, xp: Any) -> Any:
    """Return the strength with which two tubes act on each other at a section's nodes, (T, nodes), by Simpson's
    rule.
    """
    # Weights 1 4 2 4 ... 1 of 2 ENERGY_STEPS_PER_SECTION intervals, as parts of the section's length.
    simpson = np.array([1.0, *[4.0, 2.0] * (ENERGY_STEPS_PER_SECTION - 1), 4.0, 1.0]) / (
        6 * ENERGY_STEPS_PER_SECTION
    )
    nodes, weights = (ca.DM(row).T if xp is ca else row for row in (SECTION_NODE_FRACTIONS, simpson))
    k = curvatures_at(tubes, columns, part, part.start + part.length * nodes)
    # shares[i] EI_j = EI_i EI_j / sum EI, the factor of k_i k_j cos(psi_i - psi_j) in the energy.
    return part.shares[i] * tubes[j].bending_stiffness * k[i] * k[j] * part.length * weights
