"""Stability of equilibria of the elastic model, and their distance from snapping.

With K the torsional part of the energy's second variation, transmissions included, and V its bending part, the
margin mu is the smallest eigenvalue of (K + V) x = mu K x: 1 where tubes do not act on each other, 0 at the snap.
It has no unit.

There are two ways to compute it. Evaluations solve the eigenproblem by Galerkin's method (energy.py). Programs
need a smooth constraint instead: mu > margin means that (1 - margin) K + V is positive definite, which by Jacobi's
condition is the case as long as solutions of the linearised balance of moments, on tubes of (1 - margin) GJ, do
not become singular anywhere from the tips to the motors (Gilbert et al. 2016 for margin 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ctr_nlp.models.elastic.compiled import get_compiled_elastic, numbers_of
from ctr_nlp.models.elastic.energy import differences, energies
from ctr_nlp.models.elastic.torsion import Node, RobotSection, add_scaled_changes
from ctr_nlp.robot.structure import Tubes, structure_of
from ctr_nlp.typing import Array


def responses(
    tubes: Tubes,
    beta: Sequence[Any],
    parts: Sequence[RobotSection],
    places: Sequence[Sequence[Node]],
    margin: Any,
    xp: Any,
    include_common_turn: bool = False,
) -> list[list[list[Any]]]:
    """Compute derivatives of the tubes' angles over those at the tips, on tubes of (1 - margin) GJ.

    tubes, parts: of the robot. beta: extensions, mm. places: Twist.nodes. margin: least stability margin. xp:
    casadi or numpy. include_common_turn: whether turning all tubes together is a deformation, too, as where a
    moment from outside fixes the direction of bending.

    Returns matrices [tube][tip]: of psi at the base of every section in which tubes twist each other, from tip to
    base, and then after one transmission after the other; with margin 0 the last is d alpha / d phi. They are d x
    d with include_common_turn, else of size d - 1, of angles relative to the innermost tube's. By Jacobi's
    condition the margin exceeds the given one as long as no determinant on the way loses its sign, in steps in
    which at most one eigenvalue passes zero.
    """
    d = len(tubes)
    free = d if include_common_turn else d - 1
    # At the tips the response is the identity, with rate 0: psi'(beta_i) = 0 for every tip angle.
    # Angles and rates at the tips, as initial values of the linearised equations, integrated towards the base (h <
    # 0).
    columns = [[1.0 if i == j else 0.0 for i in range(d)] for j in range(free)]
    rates: list[list[Any]] = [[0.0] * d for _ in columns]
    found = []
    for part, nodes in zip(reversed(parts), reversed(places), strict=True):
        # A plane section: tubes do not act on each other, and responses are linear in s.
        if len(nodes) == 1:
            columns = [add_scaled_changes(y, (-part.length, rate)) for y, rate in zip(columns, rates, strict=True)]
            continue
        # A step spans three nodes: its ends and its middle, where the angles are known from torsion.py.
        h = -2 * part.length / (len(nodes) - 1)
        stiff = [_stiffness(tubes, part, node, 1 / (1 - margin), xp) for node in nodes]
        for k in range(len(nodes) - 1, 0, -2):
            for j, (y, rate) in enumerate(zip(columns, rates, strict=True)):
                a = _times(stiff[k], y)
                b = _times(stiff[k - 1], add_scaled_changes(y, (h / 2, rate), (h**2 / 8, a)))
                c = _times(stiff[k - 2], add_scaled_changes(y, (h, rate), (h**2 / 2, b)))
                columns[j], rates[j] = _nystroem_step(y, rate, h, a, b, c)
        found.append(_reduce_responses(columns, include_common_turn))
    for i, tube in enumerate(tubes):
        for y, rate in zip(columns, rates, strict=True):
            # The transmission of tube i, as in torsion.motors; one after the other, so that eigenvalues
            # pass one by one.
            y[i] = y[i] - rate[i] * (tube.length - beta[i])
        found.append(_reduce_responses(columns, include_common_turn))
    return found


def _nystroem_step(
    values: Sequence[Any], rates: Sequence[Any], h: Any, *ks: Sequence[Any]
) -> tuple[list[Any], list[Any]]:
    """Values and rates after a step h of Nystroem's method of order 4, from its three second derivatives.

    They are at the beginning, in the middle and at the end of the step.
    """
    a, b, c = ks
    return (
        add_scaled_changes(values, (h, rates), (h**2 / 6, a), (h**2 / 3, b)),
        add_scaled_changes(rates, (h / 6, a), (h * 2 / 3, b), (h / 6, c)),
    )


def _stiffness(tubes: Tubes, part: RobotSection, node: Node, factor: float, xp: Any) -> list[list[Any]]:
    """The derivatives [tube][tube] of factor psi'' over the angles, 1/mm^2.

    factor is 1 / (1 - margin): softer tubes twist more.
    """
    found: list[list[Any]] = [[0.0] * len(tubes) for _ in tubes]
    cos, sin = ({i: turn(node.angles[i]) for i in part.active} for turn in (xp.cos, xp.sin))
    for i in part.active:
        own = factor * tubes[i].torsional_ratio * node.curvatures[i]
        for j in part.active:
            if j != i:
                # psi_i'' = k_i EI_i/GJ_i sum_j share_j k_j sin(psi_i - psi_j): its derivative over psi_i is
                # the sum of the cosines, over psi_j minus one of them.
                pull = own * part.shares[j] * node.curvatures[j] * (cos[i] * cos[j] + sin[i] * sin[j])
                found[i][i], found[i][j] = found[i][i] + pull, -pull
        if node.outside is not None:
            # A moment from outside bends towards a fixed direction: the derivative of u x e(psi) over psi
            # is u . e(psi).
            x, y = node.outside
            found[i][i] = found[i][i] + own * (x * cos[i] + y * sin[i])
    return found


def _times(matrix: Sequence[Sequence[Any]], y: Sequence[Any]) -> list[Any]:
    """A matrix [row][column] times a vector."""
    return [sum(a * b for a, b in zip(row, y, strict=True)) for row in matrix]


def _reduce_responses(columns: Sequence[Sequence[Any]], include_common_turn: bool) -> list[list[Any]]:
    """Return responses as [tube][tip], without the innermost tube's row unless include_common_turn."""
    if include_common_turn:
        return [list(row) for row in zip(*columns, strict=True)]
    # Turning all tubes together is no deformation without a moment from outside.
    return [[column[i] - column[-1] for column in columns] for i in range(len(columns))]


def determinant(matrix: Sequence[Sequence[Any]]) -> Any:
    """Return the determinant of a matrix [row][column] by expansion along the first row.

    No pivots are chosen, so that it is a smooth expression; the cost does not matter for the few tubes that there
    are.
    """
    if not matrix:
        return 1.0
    first, *others = matrix
    minors = (determinant([[*row[:j], *row[j + 1 :]] for row in others]) for j in range(len(first)))
    return sum((-1) ** j * a * minor for j, (a, minor) in enumerate(zip(first, minors, strict=True)))


def margins(tubes: Tubes, x: Array) -> Array:
    """Return the stability margin (T,) of tubes at every x (T, 2d + 2), by Galerkin's method; NaN where x is."""
    code = get_compiled_elastic(structure_of(tubes))
    if code is not None:
        return code.margins(numbers_of(tubes), x)
    found = np.full(len(x), np.nan)
    known = np.asarray(np.isfinite(x).all(axis=1))
    pairs = zip(energies(tubes, x), differences(tubes, x), strict=True)
    for row, (energy, angles) in enumerate(pairs):
        if known[row]:
            # K is the identity in these coordinates: an ordinary eigenproblem. No twists at all have the
            # margin 1.
            found[row] = np.linalg.eigvalsh(energy.hessian(angles)).min(initial=1.0)
    return found
