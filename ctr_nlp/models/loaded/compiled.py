"""Rods from tip to base as one function of symbols, evaluated for a batch of rows; compiled where possible.

The function is generated once for each structure and kind of rod. Until it is compiled, in the background, it is
interpreted, so that no caller waits. Angles are in rad, lengths in mm, forces in N and moments in N mm.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.background import Library
from ctr_nlp.codegen.batch_evaluator import BatchEvaluator, load_tape_function
from ctr_nlp.codegen.language import VECTOR_LANES
from ctr_nlp.models.elastic.torsion import sections
from ctr_nlp.models.loaded.equations import Softness
from ctr_nlp.models.loaded.rod import Tip, integrate_rod
from ctr_nlp.models.loaded.rod_loads import PieceForce, RodKind, loading
from ctr_nlp.models.loaded.vectors import vectors
from ctr_nlp.models.loads.load import FIRST_WEIGHT_COLUMN
from ctr_nlp.models.protocol import symbolic_tubes
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure
from ctr_nlp.typing import Array

ROD_ROWS_PER_CALL = 128
"""Most rows in one call: functions are mapped to few sizes, and few rows are computed in vain."""


class RodBases(NamedTuple):
    """T rods at their bases, as integrated from their tips.

    angles (T, d): of the tubes at their motors, relative to the frame at the base, rad. axes (T, 3, 3): that
    frame, row by row d_1, d_2 and t. responses (T, k, d + 2, d + 2): of rod.Rod, from tip to base; on a foundation
    with d + 5 rows and columns. tangents (T, k,
    n, 3): of k sections or their pieces, at n nodes from base to tip.
    """

    angles: Array
    axes: Array
    responses: Array
    tangents: Array

    @property
    def slopes(self) -> Array:
        """Derivatives (T, d + 2, d + 2) of turns and angles at the base over those at the tip."""
        # The chain rule from place to place: the response of the last place multiplies all before it.
        return functools.reduce(lambda found, response: response @ found, self.responses.swapaxes(0, 1))


@functools.lru_cache(maxsize=64)
def symbolic(structure: Structure, kind: RodKind) -> ca.Function:
    """Build the function (row, numbers (8 d,)) -> the arrays of RodBases, in symbols.

    structure, kind: of the rod. A row has the tubes' angles at the tip and its axes, the extensions, the load, and
    the two softnesses.
    """
    d = structure.d
    numbers = ca.SX.sym("numbers", d, len(TUBE_NUMBER_NAMES))
    tip = ca.SX.sym("tip", d + 9)
    beta = ca.SX.sym("beta", d)
    load = ca.SX.sym("load", kind.numbers(structure))
    soft = ca.SX.sym("soft", 2)
    tubes = symbolic_tubes(structure, numbers)
    entries = ca.vertsplit(tip)
    extensions = ca.vertsplit(beta)
    d1, d2, t = vectors(entries[d:])
    # Empty where sections are not divided into pieces.
    each = kind.numbers_per_piece // 3
    forces = vectors(ca.vertsplit(load)[FIRST_WEIGHT_COLUMN + 3 * d :])
    rod = integrate_rod(
        tubes,
        Tip(entries[:d], (d1, d2, t)),
        extensions,
        kind.split_sections(sections(tubes, extensions, ca, planes=False)),
        loading(ca.vertsplit(load)),
        kind,
        ca,
        kind.steps,
        soft=Softness(*ca.vertsplit(soft)),
        section_forces=[
            PieceForce(forces[k], forces[k + 1], forces[k + 2 : k + each]) for k in range(0, len(forces), each)
        ],
    )
    reach = zip(rod.angles, rod.rates, tubes, extensions, strict=True)
    # Behind the opening a transmission is straight and unloaded: its rate of twist is constant over the L_i -
    # beta_i to the motor.
    angles = [angle - rate * (tube.length - out) for angle, rate, tube, out in reach]
    ends = ca.vertcat(*angles, *(entry for axis in rod.axes for entry in axis))
    responses = ca.horzcat(*(row for response in rod.responses for row in response)).T
    tangents = ca.vertcat(*(entry for nodes in rod.tangents for tangent in nodes for entry in tangent))
    given = [ca.vertcat(tip, beta, load, soft), numbers]
    found = [ends, responses, tangents]
    # cse: common subexpressions are computed once. Densified, since the compiled code takes plain arrays.
    return ca.Function("rod", given, [ca.densify(each) for each in found], {"cse": True})


@functools.lru_cache(maxsize=64)
def _library(structure: Structure, kind: RodKind) -> Library:
    """Return the library of the function, which is compiled in the background."""
    functions = functools.partial(_functions, structure, kind)  # it is sent to the process that compiles
    return Library(symbolic(structure, kind).serialize(), functions, None)


def _functions(structure: Structure, kind: RodKind) -> tuple[ca.Function]:
    """Return the function to be compiled, in a tuple, as Library calls it in the process that compiles."""
    return (symbolic(structure, kind),)


def _fastest(structure: Structure, kind: RodKind) -> ca.Function:
    """Return the compiled function, or the interpreted one while it is being compiled."""
    if not cache.unavailable_reason() and (path := _library(structure, kind).path_if_ready()) is not None:
        return load_tape_function("rod", str(path))
    return symbolic(structure, kind)


class Rods:
    """Integrates rods of robots from tip to base, in batches. Not to be used from several threads at once."""

    def __init__(self, structure: Structure, kind: RodKind) -> None:
        """Prepare for rods of a structure and kind; the function is interpreted until it has been compiled."""
        self.d = structure.d
        self.kind = kind
        # A gap between carriages is a limit of motors and does not change shapes: both structures share the code.
        self._which = replace(structure, gap=False), kind
        self.size = kind.numbers(structure)
        self._function = _fastest(*self._which)
        self._mapped: dict[int, BatchEvaluator] = {}

    def __call__(
        self, numbers: Array, angles: Array, axes: Array, beta: Array, load: Array, soft: Array
    ) -> RodBases:
        """Integrate T rods from tip to base.

        numbers (T, d, 8): of the tubes, in the order of structure.TUBE_NUMBER_NAMES. angles (T, d), axes (T, 3,
        3): of the tips. beta (T, d): extensions, mm. load (T, size): numbers of the loads. soft (T, 2): softnesses
        of torsion and bending.
        """
        rows = len(angles)
        d = self.d
        given = np.hstack([angles, axes.reshape(rows, 9), beta, load, soft])
        # Column by column, as casadi stores the matrix (d, 8).
        of_tubes = numbers.swapaxes(1, 2).reshape(rows, len(TUBE_NUMBER_NAMES) * d)
        blocks = [slice(k, k + ROD_ROWS_PER_CALL) for k in range(0, max(rows, 1), ROD_ROWS_PER_CALL)]
        each = (self._block(given[block], of_tubes[block]) for block in blocks)
        ends, responses, tangents = map(np.concatenate, zip(*each, strict=True))
        pieces = tangents.shape[1] // (3 * (self.kind.steps + 1))
        side = d + self.kind.place_changes
        return RodBases(
            ends[:, :d],
            ends[:, d:].reshape(rows, 3, 3),
            responses.reshape(rows, responses.shape[1] // side**2, side, side),
            tangents.reshape(rows, pieces, self.kind.steps + 1, 3),
        )

    def _block(self, given: Array, of_tubes: Array) -> list[Array]:
        """Evaluate the function for at most ROD_ROWS_PER_CALL rows."""
        rows = len(given)
        mapped = self._for(len(given))
        padded = np.zeros_like(mapped.inputs[0])
        padded[:rows], mapped.inputs[1][:rows] = given, of_tubes
        if rows:  # the function's calls are for several robots; those that are too many are the last one's
            padded[rows:], mapped.inputs[1][rows:] = given[-1], of_tubes[-1]
        return [found[:rows].copy() for found in mapped(padded.ravel())]

    def _for(self, rows: int) -> BatchEvaluator:
        """Return the function mapped over at least `rows` rows, in few sizes.

        It is the compiled one as soon as that is ready.
        """
        # Still interpreted: it may have been compiled since the last call.
        if self._function.is_a("SXFunction"):
            self._function = _fastest(*self._which)
            self._mapped = {}
        # Compiled code computes VECTOR_LANES rows side by side: multiples of these, and powers of 2 below.
        size = (
            -(-rows // VECTOR_LANES) * VECTOR_LANES if rows > VECTOR_LANES else 1 << max(rows - 1, 0).bit_length()
        )
        if size not in self._mapped:
            self._mapped[size] = BatchEvaluator(self._function, size)
        return self._mapped[size]
