"""Rows of sample points that are one expression in different numbers, found among the rows of a program.

A program compares the robot with its target at many sample points along it (eq. (8) at equal sigma), and each has
the same rows: residuals in x, y and z, or a clearance. Code for one point, evaluated for VECTOR_LANES points in
one vector, is shorter and faster than code for all. This module finds such groups in the finished expressions, so
that no term needs to declare them.

A sample point's rows are those that depend on inner quantities of their own, such as the length travelled to it.
Sample points are alike if their rows are made by the same operations on the same unknowns and shared quantities,
and differ only in constants and in parameters that follow each other from point to point.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.codegen.language import VECTOR_LANES
from ctr_nlp.ocp.expressions import ProgramExpressions
from ctr_nlp.typing import Array, Flags, Index


class SampleGroup(NamedTuple):
    """Sample points whose rows are one expression, at least VECTOR_LANES of them.

    rows (points, k): the numbers of each point's rows, among residuals and then constraints. value (k, 1): the
    rows' expression, in the symbols z of the point's inner quantities, x, shared symbols, parameters and the
    symbols of numbers. z_value: the expressions of z, in all others. parameters: symbols, and where in p they
    stand for the first point; constants: symbols, and their values at all points.
    """

    rows: Index
    value: ca.SX
    z: ca.SX
    z_value: ca.SX
    parameters: tuple[tuple[ca.SX, int], ...]
    constants: tuple[tuple[ca.SX, Array], ...]


class _SampleRows(NamedTuple):
    """Rows of a sample point, the operations that make them, and the numbers in these: constants, and positions in
    p.
    """

    rows: list[int]
    operations: tuple[Any, ...]
    numbers: list[float | int]


def group_samples(written: ProgramExpressions) -> tuple[tuple[SampleGroup, ...], Index]:
    """Return groups of sample points whose rows are one expression, and which quantities they share.

    written: the program. The second result are positions among the first layer's symbols.
    """
    symbols, values = written.first_layer
    later = ca.vertcat(ca.SX(0, 1), *(layer[0] for layer in written.inner[1:]))
    rows = written.rows
    uses = depends(written.without(written.inner[1:], [rows])[0], symbols)
    # A quantity that fewer than VECTOR_LANES rows use belongs to a sample point; one that more use, to all of
    # them. A point has a few rows only, of which each may use the same quantity.
    own = uses.any(axis=0) & (uses.sum(axis=0) < VECTOR_LANES)
    shared = np.flatnonzero(~own)
    mine = np.flatnonzero(own).tolist()
    own_layer = [(symbols[mine], values[mine])]
    # Quantities of later layers in x, p and shared symbols, without the sample point's own symbols, which its
    # function has to compute itself.
    (quantities,) = written.without([*own_layer, *written.inner[1:]], [later])
    (rows,) = written.without(own_layer, [rows])
    given = [written.x, written.p, symbols[shared.tolist()]]
    direct = depends(rows, later)
    groups: dict[Any, list[_SampleRows]] = defaultdict(list)
    for of_place in _rows_by_sample(uses & own, written.residual.numel()):
        used = np.flatnonzero(direct[of_place].any(axis=0)).tolist()
        made = ca.Function("place", [*given, later[used]], [rows[of_place], quantities[used]], {"cse": True})
        place = _SampleRows(of_place, *_operations(made))
        # The key holds all that must agree: the operations, the number of inner quantities, and whether
        # rows are residuals, whose squares count, or constraints.
        groups[place.operations, len(used), of_place[0] < written.residual.numel()].append(place)
    found = (
        _merge_samples(given, count, places)
        for (_, count, _), places in groups.items()
        if len(places) >= VECTOR_LANES
    )
    return tuple(each for each in found if each is not None), shared


def depends(expression: ca.SX, symbols: ca.SX) -> Flags:
    """Return whether each entry of an expression depends on each symbol, (entries, symbols), by structure."""
    if not symbols.numel():
        return np.zeros((expression.numel(), 0), dtype=bool)
    return np.asarray(ca.DM(ca.jacobian_sparsity(expression, symbols), 1).full() > 0)


def _rows_by_sample(uses: Flags, residuals: int) -> list[list[int]]:
    """Return the rows of each sample point: rows that use the same own quantities, residuals and constraints
    separately.
    """
    found: dict[Any, list[int]] = defaultdict(list)
    for row in np.flatnonzero(uses.any(axis=1)).tolist():
        found[row < residuals, uses[row].tobytes()].append(row)
    return list(found.values())


def _operations(function: ca.Function) -> tuple[tuple[Any, ...], list[float | int]]:
    """Return the operations of a function of (x, p, shared, z), with gaps for numbers; and these numbers.

    Numbers are the constants (float) and the positions in p (int), in the order of the gaps.
    """
    # CasADi reuses slots of its work vector. Two functions are compared by which earlier instruction made
    # each argument instead, as slots may be assigned differently.
    made = dict[int, int]()
    numbers = list[float | int]()
    operations = list[Any]()
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        to = function.instruction_output(k)
        of: Sequence[int] = function.instruction_input(k)
        if operation == ca.OP_CONST:
            numbers.append(function.instruction_constant(k))
        # Input 1 is p: its entry differs from point to point, so it is a number and not part of the
        # operation.
        elif operation == ca.OP_INPUT and of[0] == 1:
            numbers.append(of[1])
            of = of[:1]
        elif operation != ca.OP_INPUT:
            of = [made[slot] for slot in of]
        if operation == ca.OP_OUTPUT:
            operations.append((operation, *of, *to))
        else:
            operations.append((operation, *of))
            made[to[0]] = k
    return tuple(operations), numbers


def _merge_samples(given: list[ca.SX], count: int, places: list[_SampleRows]) -> SampleGroup | None:
    """Merge sample points with the same operations; None if their parameters or rows do not follow each other.

    given: symbols x, p and shared. count: of inner quantities.
    """
    rows = np.array([place.rows for place in places])
    follow = np.arange(len(places))
    # The generated code reads and writes neighbouring entries for neighbouring sample points, lane by lane.
    if (rows != rows[0] + follow[:, None]).any():
        return None
    columns = zip(*(place.numbers for place in places), strict=True)
    taken: dict[Any, ca.SX] = {}
    parameters = list[tuple[ca.SX, int]]()
    constants = list[tuple[ca.SX, Array]]()
    leaves = list[ca.SX]()
    for column in columns:
        # The types tell the constant 1.0 from entry 1 of p, which are equal as numbers.
        key = tuple(map(type, column)), column
        if len(set(column)) == 1:
            leaves.append(given[1][column[0]] if isinstance(column[0], int) else ca.SX(column[0]))
            continue
        if key not in taken:
            taken[key] = symbol = ca.SX.sym("number")
            if isinstance(column[0], float):
                constants.append((symbol, np.array(column)))
            elif (np.array(column) == column[0] + follow).all():
                parameters.append((symbol, column[0]))
            else:
                return None
        leaves.append(taken[key])
    z = ca.SX.sym("z", count)
    value, z_value = _replay_operations(places[0].operations, [*given, z], leaves)
    # Derivatives are taken in two steps, over z and then over the rest (sample_derivatives.py). A sample point
    # without inner quantities has its rows as z, so that both cases are one.
    if not count:
        z, value, z_value = (own := ca.SX.sym("z", value.numel())), own, value
    return SampleGroup(rows, value, z, z_value, tuple(parameters), tuple(constants))


def _replay_operations(
    operations: Sequence[Any], inputs: list[ca.SX], numbers: list[ca.SX]
) -> tuple[ca.SX, ca.SX]:
    """Return the two results of a list of operations on inputs, with numbers (expressions) put into its gaps."""
    left = iter(numbers)
    done = list[ca.SX]()
    results = (list[ca.SX](), list[ca.SX]())
    for operation, *of in operations:
        if operation == ca.OP_OUTPUT:
            results[of[1]].append(done[of[0]])
            # Keeps `done` as long as the list of instructions, whose numbers the arguments are.
            done.append(done[of[0]])
        elif operation == ca.OP_CONST or (operation == ca.OP_INPUT and of[0] == 1):
            done.append(next(left))
        elif operation == ca.OP_INPUT:
            done.append(inputs[of[0]][of[1]])
        else:
            done.append((ca.SX.unary if len(of) == 1 else ca.SX.binary)(operation, *(done[k] for k in of)))
    value, z_value = (ca.vertcat(ca.SX(0, 1), *each) for each in results)
    return value, z_value
