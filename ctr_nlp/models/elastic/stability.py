"""Whether an equilibrium of the elastic model is stable, and how far from the snap.

With K the torsional part of the energy's second variation, transmissions included, and V its bending part, the
margin mu is the smallest eigenvalue of (K + V) x = mu K x: 1 where tubes do not act on each other, 0 at the snap.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Legendre

from ctr_nlp.models.dominant.shape import columns_of
from ctr_nlp.models.elastic.torsion import (
    STEPS,
    Node,
    Section,
    Twist,
    curvatures_at,
    moved,
    sections,
    stepped,
    twist,
)
from ctr_nlp.robot.structure import Tubes
from ctr_nlp.typing import Array

DEGREE = 3
"""Of the polynomials that the tubes' angles are in every section, in Galerkin's method."""
NODES = np.linspace(0.0, 1.0, 2 * STEPS + 1)
"""Fractions of a section's length."""
ANGLES = [np.sqrt(2 * n + 1) * Legendre.basis(n, domain=(0, 1)).integ(lbnd=0)(NODES) for n in range(DEGREE)]
"""What twists by orthonormal polynomials turn tubes by there."""


def responses(
    tubes: Tubes, x: Sequence[Any], parts: Sequence[Section], twisted: Twist, margin: Any, xp: Any
) -> list[list[list[Any]]]:
    """How angles relative to the innermost tube's follow those at the tips, on tubes of (1 - margin) GJ.

    Matrices [tube][tip], d - 1 each way: of psi at the base of every section in which tubes twist each other, from
    tip to base, and then with one transmission after the other; with margin 0 the last is d alpha / d phi. By
    Jacobi's condition, in steps that let one eigenvalue pass at a time, the margin exceeds the one given as long
    as no determinant on the way loses its sign.
    """
    d = len(tubes)
    columns = [[1.0 if i == j else 0.0 for i in range(d)] for j in range(d - 1)]
    rates: list[list[Any]] = [[0.0] * d for _ in columns]
    found = []
    for part, nodes in zip(reversed(parts), reversed(twisted.nodes), strict=True):
        if len(nodes) == 1:
            columns = [moved(y, (-part.length, rate)) for y, rate in zip(columns, rates, strict=True)]
            continue
        h = -2 * part.length / (len(nodes) - 1)
        stiff = [_stiffness(tubes, part, node, 1 / (1 - margin), xp) for node in nodes]
        for k in range(len(nodes) - 1, 0, -2):
            for j, (y, rate) in enumerate(zip(columns, rates, strict=True)):
                a = _times(stiff[k], y)
                b = _times(stiff[k - 1], moved(y, (h / 2, rate), (h**2 / 8, a)))
                c = _times(stiff[k - 2], moved(y, (h, rate), (h**2 / 2, b)))
                columns[j], rates[j] = stepped(y, rate, h, a, b, c)
        found.append(_relative(columns))
    for i, tube in enumerate(tubes):
        for y, rate in zip(columns, rates, strict=True):
            y[i] = y[i] - rate[i] * (tube.length - x[d + i])
        found.append(_relative(columns))
    return found


def _stiffness(tubes: Tubes, part: Section, node: Node, factor: float, xp: Any) -> list[list[Any]]:
    """The derivatives [tube][tube] of factor psi'', 1/mm^2."""
    found: list[list[Any]] = [[0.0] * len(tubes) for _ in tubes]
    for i in part.active:
        own = factor * tubes[i].torsional_ratio * node.curvatures[i]
        for j in part.active:
            if j != i:
                pull = own * part.shares[j] * node.curvatures[j] * xp.cos(node.angles[i] - node.angles[j])
                found[i][i], found[i][j] = found[i][i] + pull, -pull
    return found


def _times(matrix: Sequence[Sequence[Any]], y: Sequence[Any]) -> list[Any]:
    return [sum(a * b for a, b in zip(row, y, strict=True)) for row in matrix]


def _relative(columns: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """[tube][tip], less the innermost tube's row."""
    return [[column[i] - column[-1] for column in columns] for i in range(len(columns))]


def determinant(matrix: Sequence[Sequence[Any]]) -> Any:
    """By expansion along the first row; for the few tubes that there are."""
    if not matrix:
        return 1.0
    first, *others = matrix
    minors = (determinant([[*row[:j], *row[j + 1 :]] for row in others]) for j in range(len(first)))
    return sum((-1) ** j * a * minor for j, (a, minor) in enumerate(zip(first, minors, strict=True)))


class Energy(NamedTuple):
    """E(a) = |a|^2 / 2 - sum strength cos(angle), with the tubes' twist a combination of n unit twists by a (n,).

    Angles (rows,), rad, are those between two tubes at a node: couples (rows, d) alpha + turns (rows, n) a. Those
    of the tips are alpha + ends (d, n) a. strength (rows,): EI_i EI_j k_i k_j / sum EI times the node's weight.
    """

    strength: Array
    couples: Array
    turns: Array
    ends: Array

    def gradient(self, a: Array, angles: Array) -> Array:
        """dE/da, (n,)."""
        return a + (self.strength * np.sin(angles)) @ self.turns

    def hessian(self, angles: Array) -> Array:
        """K + V, (n, n), in which K is the identity."""
        return np.eye(self.turns.shape[1]) + (self.strength * np.cos(angles) * self.turns.T) @ self.turns


def margins(tubes: Tubes, x: Array) -> Array:
    """The margin (T,) of every x (T, 2d + 2), by Galerkin's method; NaN where x is."""
    found, known = np.full(len(x), np.nan), np.isfinite(x).all(axis=1)
    pairs = zip(energies(tubes, x[known]), differences(tubes, x[known]), strict=True)
    found[known] = [np.linalg.eigvalsh(energy.hessian(angles)).min(initial=1.0) for energy, angles in pairs]
    return found


def differences(tubes: Tubes, x: Array) -> Array:
    """The angles (T, rows) of Energy at every x (T, 2d + 2)."""
    columns = columns_of(x)
    parts = sections(tubes, columns[len(tubes) : 2 * len(tubes)], np)
    nodes = twist(tubes, columns, parts, np).nodes
    found = [node.angles[i] - node.angles[j] for k, i, j in _couples(parts) for node in nodes[k]]
    return np.hstack([np.zeros((len(x), 0)), *np.broadcast_arrays(*found, columns[0])[:-1]])


def energies(tubes: Tubes, x: Array) -> Iterator[Energy]:
    """The Energy at the beta of every x (T, 2d + 2)."""
    columns = columns_of(x)
    parts = sections(tubes, columns[len(tubes) : 2 * len(tubes)], np)
    twists = _twists(tubes, columns, parts)
    couples = _couples(parts)
    pattern = [one.angles(k, i) - one.angles(k, j) for one in twists for k, i, j in couples]
    turns = np.reshape(pattern, (len(twists), len(couples) * len(NODES))).T
    signs = np.array([np.eye(len(tubes))[i] - np.eye(len(tubes))[j] for _, i, j in couples for _ in NODES])
    ends = np.array([[one.end * (one.tube == i) for one in twists] for i in range(len(tubes))])
    scale = np.hstack([one.scale for one in twists] or [np.zeros((len(x), 0))])
    strength = [_strength(tubes, columns, parts[k], i, j) for k, i, j in couples]
    for of_rows, of_twists in zip(np.hstack(strength or [np.zeros((len(x), 0))]), scale, strict=True):
        there = of_twists > 0
        yield Energy(of_rows, signs, *(each[:, there] * of_twists[there] for each in (turns, ends)))


class _Twist(NamedTuple):
    """A tube's twist in a section (-1: its transmission): a Legendre polynomial; scale (T, 1) makes its K one."""

    tube: int
    section: int
    degree: int
    scale: Array

    @property
    def end(self) -> float:
        """By what it turns the tube's tip, but for the scale."""
        return float(self.degree == 0)

    def angles(self, section: int, tube: int) -> Array:
        """By what it turns a tube at a section's nodes, but for the scale."""
        if tube != self.tube or section < self.section:
            return np.zeros(len(NODES))
        return ANGLES[self.degree] if section == self.section else np.full(len(NODES), self.end)


def _twists(tubes: Tubes, columns: Sequence[Array], parts: Sequence[Section]) -> list[_Twist]:
    """Of the transmissions, and up to DEGREE of every tube where others act on it."""
    acting = {k: part.active for k, part in enumerate(parts) if not part.plane}
    found = []
    for i in sorted({i for active in acting.values() for i in active}):
        tube = tubes[i]
        compliance = tube.torsional_ratio / tube.bending_stiffness
        lengths = {-1: tube.length - columns[len(tubes) + i]}
        lengths |= {k: parts[k].length for k, active in acting.items() if i in active}
        for k, length in lengths.items():
            scale = np.sqrt(compliance * np.maximum(length, 0.0))
            found += [_Twist(i, k, n, scale) for n in range(1 if k == -1 else DEGREE)]
    return found


def _couples(parts: Sequence[Section]) -> list[tuple[int, int, int]]:
    """Sections, and two tubes in each that act on each other there."""
    return [
        (k, i, j)
        for k, part in enumerate(parts)
        if not part.plane
        for i, j in itertools.combinations(part.active, 2)
    ]


def _strength(tubes: Tubes, columns: Sequence[Array], part: Section, i: int, j: int) -> Array:
    """How strongly two tubes act on each other at a section's nodes, (T, nodes), by Simpson's rule."""
    weights = np.array([1.0, *[4.0, 2.0] * (STEPS - 1), 4.0, 1.0]) / (6 * STEPS)
    k = curvatures_at(tubes, columns, part, part.start + part.length * NODES)
    found: Array = part.shares[i] * tubes[j].bending_stiffness * k[i] * k[j] * part.length * weights
    return found
