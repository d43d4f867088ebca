"""The elastic model in C: the files in c/ around functions that are generated for each structure of a robot.

A structure's functions (motors' angles, energy, shape) are derived once as symbols from torsion.py, energy.py and
shape.py, compiled, and called by hand-written C that follows branches, simulates snaps and evaluates batches.
equilibria.py has the method in Python, for use without a compiler. Angles are in rad, lengths in mm.
"""

from __future__ import annotations

import ctypes
import functools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.background import Library
from ctr_nlp.codegen.c_structures import check_structure
from ctr_nlp.codegen.language import FULL_OPTIMISATION_PRAGMA, definitions
from ctr_nlp.codegen.vector import ADJACENT_LANES_PREFIX, SHARED_INPUT_PREFIX
from ctr_nlp.models.elastic import energy, shape, torsion
from ctr_nlp.models.protocol import RestStates, combination, matrix_of, symbolic_tubes
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure, Tubes
from ctr_nlp.support.threads import map_in_threads, split_rows
from ctr_nlp.typing import Array, Flags, Index

MOST_TUBES = 8
"""Largest number of tubes that branch.c has room for."""
ELASTIC_C_FILES = tuple(
    f"c/{name}.c" for name in ("lanes", "branch", "margin", "energy", "fall", "abreast", "shape", "rest")
)
"""The files of C, in the order in which they are compiled as one."""
FUNCTIONS = "motors", "energy", "second", "shape", "points", "motors_beside"
"""Functions that the struct Elastic of branch.c points to; all but the first evaluate a vector of robots or arc
lengths, in one call.
"""
KERNEL_OPERATIONS = ca.OP_SIN, ca.OP_COS, ca.OP_SQRT
"""Operations of whole vectors that the C files call."""

MAX_ALIGNED_TURN_STEP_RAD = 1.0
"""Angle in rad that tubes are turned by in one step from the aligned robot."""
ELASTIC_NEWTON_TOLERANCE_RAD, INTERMEDIATE_NEWTON_TOLERANCE_RAD, MAX_ELASTIC_NEWTON_STEPS = 1e-7, 1e-2, 8
"""Newton's method: the size of the last step in rad, whose error is about its square; the same at intermediate
points; and most steps.
"""
MAX_PREDICTION_ERROR_RAD = 0.1
"""Distance in rad from its prediction beyond which an equilibrium may belong to another branch."""
MAX_PREDICTED_TURN_RAD = 0.2
"""Angle in rad that tips may be predicted to turn against each other in one step, beyond their motors. A solution
further away may lie near its prediction by chance, and on another branch.
"""
MIN_PATH_STEP_FRACTION = 2.0**-20
"""Fraction of the path below which steps are not halved any more: the branch counts as ended."""
FOLD_PERTURBATION_RAD = 0.1
"""Angle in rad by which tubes are turned against each other at a fold, to leave the old equilibrium: more than the
difference between the two discretisations (Galerkin's and Nystroem's).
"""
MAX_FALL_STEP_RAD, MAX_FALLS_PER_STEP = 0.2, 20
"""Largest angle in rad by which tubes turn against each other in one step of a snap down the energy; and most
snaps in one step of a motion (MAX_FALLS_PER_STEP).
"""


RESTS_PER_CALL = 4096
"""Rows that one call of compiled code finds at rest: some 50 ms, after which Ctrl-C is noticed."""


class StateStruct(ctypes.Structure):
    """An equilibrium: the struct State of branch.c."""

    q: ctypes.Array[ctypes.c_double]
    x: ctypes.Array[ctypes.c_double]
    slopes: ctypes.Array[ctypes.c_double]
    determinant: float
    stable: int
    _fields_ = [
        *((name, ctypes.c_double * (2 * MOST_TUBES + 2)) for name in ("q", "x")),
        ("slopes", ctypes.c_double * MOST_TUBES**2),
        ("determinant", ctypes.c_double),
        ("stable", ctypes.c_long),
    ]


STATE_DTYPE = np.dtype(StateStruct)
"""The struct as numpy's type, made once: numpy takes longer to derive it than C to follow a robot for a frame."""


# Order and types of the fields must be those of the struct in C: nothing checks them, and a mismatch reads other
# memory.
class _Elastic(ctypes.Structure):
    """The struct Elastic of branch.c, field by field."""

    _fields_ = [
        *((name, ctypes.c_long) for name in ("d", "rows", "against", "vectors")),
        *((name, ctypes.c_void_p) for name in ("first", "other", "starts", "columns")),
        *((name, ctypes.c_void_p) for name in FUNCTIONS),
        *(
            (name, ctypes.c_double)
            for name in ("converged", "near", "stray", "leap", "smallest", "stride", "push", "fall")
        ),
        ("iterations", ctypes.c_long),
    ]


class CompiledElastic:
    """Solver in C of equilibria of one structure.

    Any thread may call. numbers (T or 1, 8d): of the tubes, a row a robot. lanes: numbers in a vector.
    """

    def __init__(self, structure: Structure, alone: Path, beside: Path) -> None:
        """Load the functions of a structure from their libraries.

        Raises OptionError where nothing can be compiled. alone: the library of functions for one robot; beside: of
        those for a vector of arc lengths or robots.
        """
        self.lanes = cache.vector_lanes()
        made = symbolic(structure)
        libraries = [
            *([ctypes.CDLL(str(alone))] * len(made.scalar_functions)),
            *([ctypes.CDLL(str(beside))] * len(made.vector_functions)),
        ]
        # The C files know no structure: one library serves all robots of so many tubes, through a struct of sizes
        # and function pointers.
        language = f"{FULL_OPTIMISATION_PRAGMA}#define TUBES(e) {structure.d}\n" + definitions(
            KERNEL_OPERATIONS, self.lanes
        )
        self._run = cache.load_c_files(__package__, *ELASTIC_C_FILES, before=language)
        check_structure(self._run, "State", StateStruct)
        check_structure(self._run, "Elastic", _Elastic)
        couples = np.ascontiguousarray(made.of.couples, dtype=np.int64)
        # By columns of the transpose: row by row, as C reads the entries of turns.
        pattern = made.of.turns.T.sparsity()
        places_of_turns = [np.array(each, dtype=np.int64) for each in (pattern.colind(), pattern.row())]
        addresses = (
            ctypes.cast(library[name], ctypes.c_void_p).value
            for library, name in zip(libraries, FUNCTIONS, strict=True)
        )
        # C has addresses only: without this reference Python would free what they point to.
        self._keep = libraries, couples, places_of_turns
        places = *(each.ctypes.data for each in (*couples, *places_of_turns)), *addresses
        steps = (
            ELASTIC_NEWTON_TOLERANCE_RAD,
            INTERMEDIATE_NEWTON_TOLERANCE_RAD,
            MAX_PREDICTION_ERROR_RAD,
            MAX_PREDICTED_TURN_RAD,
            MIN_PATH_STEP_FRACTION,
            MAX_ALIGNED_TURN_STEP_RAD,
            FOLD_PERTURBATION_RAD,
            MAX_FALL_STEP_RAD,
            MAX_ELASTIC_NEWTON_STEPS,
        )
        sizes = couples.shape[1], made.of.second.shape[0], made.vectors
        self._elastic = _Elastic(structure.d, *sizes, *places, *steps)
        self._reference = ctypes.byref(self._elastic)
        self.motors = ca.external("motors", str(alone))

    @property
    def parameters(self) -> ctypes.Structure:
        """The struct Elastic: sizes, functions and tolerances of Newton's method."""
        return self._elastic

    def walk(self, numbers: Array, state: StateStruct, goals: Array) -> Array:
        """Return equilibria (k, 2d + 2) at the first k of goals (T, 2d + 2), which the branch reaches.

        state: where the branch is followed from; it moves along. numbers (1, 8d): of the tubes.
        """
        goals, x = np.ascontiguousarray(goals, dtype=float), np.empty(goals.shape)
        given = _address(numbers), ctypes.byref(state), _address(goals)
        # C returns how many goals were reached; rows after these are not written.
        return x[: self._run.walk(self._reference, *given, ctypes.c_long(len(goals)), _address(x))]

    def walk_batch(self, numbers: Array, states: ctypes.Array[StateStruct], goals: Array) -> tuple[Array, Index]:
        """Return equilibria (n, T, 2d + 2) of up to `lanes` robots at goals (n, T, 2d + 2).

        A robot in each lane. numbers (n, 8d): of the tubes. The second result (n,) counts the goals that each
        reached in whole steps; states (n,) move that far.
        """
        count, places, size = goals.shape
        # Lanes without a robot of their own repeat the first ones; their results are dropped.
        every = np.ascontiguousarray(numbers[np.arange(self.lanes) % count])
        goals, x, reached = (
            np.ascontiguousarray(goals),
            np.empty(goals.shape),
            np.zeros(self.lanes, dtype=np.int64),
        )
        sizes = (ctypes.c_long(each) for each in (places * size, places))
        given = _address(every), states, ctypes.c_long(count), _address(goals), *sizes
        self._run.walk_abreast(self._reference, *given, _address(x), _address(reached))
        return x, reached[:count]

    def follow(self, numbers: Array, state: StateStruct, goal: Array) -> tuple[bool, Array]:
        """Move `state` to goal (2d + 2,) along its branch.

        Returns whether it gets there, and its tips' jumps on the way (k, d), rad. numbers (1, 8d): of the tubes.
        """
        goal = np.ascontiguousarray(goal)
        jumps = np.zeros((MAX_FALLS_PER_STEP, self._elastic.d))
        falls = ctypes.c_long(0)
        given = _address(numbers), ctypes.byref(state), _address(goal), _address(jumps), ctypes.byref(falls)
        return bool(self._run.follow(self._reference, *given)), jumps[: falls.value]

    def settle(self, numbers: Array, q: Array) -> tuple[ctypes.Array[StateStruct], Flags]:
        """Return the states (T,) of rest at q (T, 2d + 2), and whether each was found.

        They are reached by turning all tubes there from alpha_d. numbers (T or 1, 8d): of the tubes.
        """
        q, rows = np.ascontiguousarray(q, dtype=float), ctypes.c_long(len(q))
        states = (StateStruct * len(q))()
        found = np.zeros(len(q), dtype=np.int64)
        self._run.settle(
            self._reference, *_address_and_stride(numbers), _address(q), rows, states, _address(found)
        )
        return states, found.astype(bool)

    def margins(self, numbers: Array, x: Array) -> Array:
        """Return the stability margins (T,) of x (T, 2d + 2).

        NaN where x is. numbers (T or 1, 8d): of the tubes.
        """
        x, found = np.ascontiguousarray(x, dtype=float), np.empty(len(x))
        self._run.margins(
            self._reference, *_address_and_stride(numbers), _address(x), ctypes.c_long(len(x)), _address(found)
        )
        return found

    def shapes(self, numbers: Array, x: Array, sigma: Array) -> tuple[Array, Array]:
        """Return points (T, n, 3) in mm at x (T, 2d + 2) and sigma (n,) or (T, n), and directions of tips (T, 3).

        numbers (T or 1, 8d): of the tubes.
        """
        x = np.ascontiguousarray(x, dtype=float)
        sigma = np.ascontiguousarray(sigma, dtype=float)
        rows = len(x)
        samples = sigma.shape[-1]
        points = np.empty((rows, samples, 3))
        tips = np.empty((rows, 3))
        at = _address(x), ctypes.c_long(rows), _address(sigma), ctypes.c_long(samples)
        step = ctypes.c_long(samples if sigma.ndim > 1 else 0)
        self._run.shapes(
            self._reference, *_address_and_stride(numbers), *at, step, _address(points), _address(tips)
        )
        return points, tips

    def rest_states(self, numbers: Array, q: Array, sigma: Array, threads: int = 1) -> RestStates:
        """Return the equilibria at rest at each q (T, 2d + 2) without a history.

        numbers (T or 1, 8d): of the tubes. sigma (m,): where points are computed. threads: number of threads that
        share the rows.
        """
        q = np.ascontiguousarray(q, dtype=float)
        sigma = np.ascontiguousarray(sigma, dtype=float)
        rows, m = len(q), len(sigma)
        x, tips, margins, points = (np.empty((rows, *size)) for size in (q.shape[1:], (3,), (), (m, 3)))

        def find(part: slice) -> None:
            """Write the results of some rows in place."""
            own = numbers[part] if len(numbers) > 1 else numbers
            step = ctypes.c_long(numbers.shape[1] if len(numbers) > 1 else 0)
            at = _address(q[part]), ctypes.c_long(part.stop - part.start), _address(sigma), ctypes.c_long(m)
            found = (_address(array[part]) for array in (x, tips, margins, points))
            self._run.rests(self._reference, _address(own), step, *at, *found)

        map_in_threads(find, split_rows(rows, RESTS_PER_CALL), threads)
        return RestStates(x, points, tips, margins)

    def count_calls(self, numbers: Array, q: Array) -> dict[str, int]:
        """Count how often each generated function is called to find robots at rest at q (T, 2d + 2).

        numbers (T or 1, 8d): of the tubes. A call evaluates `lanes` robots, or arc lengths in `points`, and one
        robot in `motors`. Shapes have `lanes` points here.
        """
        kind = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4, ctypes.c_int)
        counts = dict.fromkeys(FUNCTIONS, 0)
        fields = {field[0]: getattr(self._elastic, field[0]) for field in _Elastic._fields_}

        def count(name: str, function: Any) -> Any:
            """Return a function for C that counts its calls and calls another."""

            def call(*given: Any) -> int:
                counts[name] += 1
                return int(function(*given))

            return kind(call)

        # C has addresses only: the dict keeps what they point to.
        kept = {name: count(name, kind(fields[name])) for name in FUNCTIONS}
        addresses = {name: ctypes.cast(function, ctypes.c_void_p).value for name, function in kept.items()}
        counting = _Elastic(**fields | addresses)
        q, sigma = np.ascontiguousarray(q, dtype=float), np.linspace(0.0, 1.0, self.lanes)
        sizes = q.shape[1:], (3,), (), (self.lanes, 3)
        found = [np.empty((len(q), *size)) for size in sizes]
        at = _address(q), ctypes.c_long(len(q)), _address(sigma), ctypes.c_long(self.lanes)
        given = *_address_and_stride(numbers), *at, *map(_address, found)
        self._run.rests(ctypes.byref(counting), *given)
        return counts


def _address(array: np.ndarray[Any, Any]) -> ctypes.c_void_p:
    """Return the address of an array's first entry."""
    return ctypes.c_void_p(array.ctypes.data)


def _address_and_stride(numbers: Array) -> tuple[ctypes.c_void_p, ctypes.c_long]:
    """Return the address of the tubes' numbers, and the distance between their rows: 0 where one robot has all
    rows.
    """
    return _address(numbers), ctypes.c_long(numbers.shape[1] if len(numbers) > 1 else 0)


class Symbolic(NamedTuple):
    """Functions of a structure, in the order of FUNCTIONS, and the energy in symbols.

    scalar_functions: the first, for one robot; vector_functions: for a vector of them in one call. motors: (x,
    numbers (d, 8)) -> alpha and its derivatives over phi but the last. energy: -> strength, angles, turns, ends
    and helix_angles of energy.Symbols, the entries of turns row by row, and ends transposed. second: -> second of
    energy.Symbols. shape: ->
    vectors (3, n) and the direction of the tip. points: (arc length, vectors, extensions (d,), numbers) -> the
    point there (3,), mm.
    """

    scalar_functions: tuple[ca.Function, ...]
    vector_functions: tuple[ca.Function, ...]
    of: energy.Symbols

    @property
    def vectors(self) -> int:
        """Number of vectors that a shape is the sum of."""
        return int(self.vector_functions[3].size_in(1)[1])


@functools.lru_cache(maxsize=64)
def symbolic(structure: Structure) -> Symbolic:
    """Build the functions to be compiled for a structure, in symbols."""
    d = structure.d
    x = ca.SX.sym("x", 2 * d + 2)
    numbers = ca.SX.sym("numbers", d, len(TUBE_NUMBER_NAMES))
    s = ca.SX.sym("s")
    tubes = symbolic_tubes(structure, numbers)
    entries = ca.vertsplit(x)
    beta = entries[d : 2 * d]
    parts = torsion.sections(tubes, beta, ca)
    twisted = torsion.twist(tubes, entries, parts, ca)
    alpha = ca.vertcat(*torsion.motors(tubes, entries, twisted))
    of = energy.in_symbols(tubes, entries)
    vectors = shape.curves(tubes, entries, parts, twisted, ca)
    base = shape.turned_base(tubes, entries, ca)
    placed = [combination(vector, base) for vector in vectors]
    travels, _ = shape.travels(tubes, beta, parts, s, ca)
    _, turns = shape.travels(tubes, beta, parts, beta[-1], ca)
    tip = combination(combination([1.0, *turns], [(0.0, 0.0, 1.0), *vectors]), base)
    # d alpha / d phi_d is a column of ones, as turning all tubes turns all motors: it need not be computed.
    motors = [alpha, ca.densify(ca.jacobian(alpha, x[: d - 1]))]
    placing = [matrix_of(placed), ca.vertcat(*tip)]
    # Transposed, as CasADi writes by columns and C reads turns and ends row by row.
    energies = [of.strength, of.angles, of.turns.T.nz[:], of.ends.T, of.helix_angles]
    outputs: list[tuple[str, list[Any], str]] = [
        # C takes the lanes of energies together, and those of shapes one after the other.
        (FUNCTIONS[1], energies, ADJACENT_LANES_PREFIX),
        (FUNCTIONS[2], [of.second], ADJACENT_LANES_PREFIX),
        (FUNCTIONS[3], placing, ""),
    ]
    given = ["x", "numbers"]
    alone = ca.Function(FUNCTIONS[0], [x, numbers], motors)
    abreast = [
        ca.Function(
            name,
            [x, numbers],
            [ca.densify(value) for value in values],
            given,
            [f"{prefix}{name}_{k}" for k in range(len(values))],
        )
        for name, values, prefix in outputs
    ]
    of_sample = s, ca.SX.sym("vectors", 3, len(placed)), ca.SX.sym("beta", d), numbers
    # As a function of given vectors: they are computed once a shape, points once a sample.
    (point,) = ca.substitute([of_sample[1] @ ca.vertcat(*travels)], [ca.vertcat(*beta)], [of_sample[2]])
    names = "s", f"{SHARED_INPUT_PREFIX}vectors", f"{SHARED_INPUT_PREFIX}beta", f"{SHARED_INPUT_PREFIX}numbers"
    points = ca.Function(FUNCTIONS[4], of_sample, [ca.densify(point)], names, ["point"])
    return Symbolic((alone,), (*abreast, points, ca.Function(FUNCTIONS[5], [x, numbers], motors)), of)


def get_compiled_elastic(structure: Structure) -> CompiledElastic | None:
    """Return the compiled code of a structure; None until it has been compiled, and where nothing can be."""
    if os.environ.get(cache.COMPILE_VARIABLE) == "0" or structure.d > MOST_TUBES:
        return None
    return _soon(structure)()


class _PendingCode:
    """Compiled code of a structure, available as soon as the background process is done."""

    def __init__(self, structure: Structure) -> None:
        # The carriages' gap is a constraint of programs; equilibria do not depend on it, so robots with and
        # without share code.
        self._structure = replace(structure, gap=False)
        made = symbolic(self._structure)
        self._alone, self._beside = (
            Library("\n".join(each.serialize() for each in those), functools.partial(tuple, those), lanes)
            for those, lanes in ((made.scalar_functions, 1), (made.vector_functions, cache.vector_lanes()))
        )
        self._found: CompiledElastic | None = None

    def __call__(self) -> CompiledElastic | None:
        if self._found is None and not cache.unavailable_reason():
            alone = self._alone.path_if_ready()
            beside = self._beside.path_if_ready()
            if alone is not None and beside is not None:
                self._found = CompiledElastic(self._structure, alone, beside)
        return self._found


_soon = functools.lru_cache(maxsize=64)(_PendingCode)


def numbers_of(tubes: Tubes) -> Array:
    """Return the numbers of tubes in the layout of `CompiledElastic`: (T or 1, 8d), number by number, then tube by
    tube.
    """
    numbers = [getattr(tube, name) for name in TUBE_NUMBER_NAMES for tube in tubes]
    return np.stack(np.broadcast_arrays(*map(np.ravel, numbers)), axis=1)
