"""The elastic model in C: branch.c, margin.c, energy.c, fall.c, rest.c and shape.c around generated functions."""

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
from ctr_nlp.codegen.vector import LANES, SAME
from ctr_nlp.models.elastic import energy, shape, torsion
from ctr_nlp.models.protocol import Rest, combination, matrix_of, symbolic_tubes
from ctr_nlp.robot.structure import NUMBERS, Structure, Tubes
from ctr_nlp.typing import Array, Flags, Index

MOST_TUBES = 8
"""That branch.c has room for."""
CODE = tuple(f"c/{name}.c" for name in ("branch", "margin", "energy", "fall", "rest", "abreast", "shape"))
FUNCTIONS = "motors", "energy", "second", "shape", "points", "motors_beside"
"""That the struct Elastic of branch.c holds; the last two for LANES arc lengths or robots at once."""

STRIDE = 1.0
"""rad that tubes are turned by at once on the way from the aligned robot."""
CONVERGED, NEAR, ITERATIONS = 1e-7, 1e-2, 8
"""rad of the last Newton step, whose error is about its square, and of that on the way; steps at most."""
STRAY = 0.1
"""rad: an equilibrium further than this from its prediction may belong to another branch."""
LEAP = 0.2
"""rad that tips may be predicted to turn against each other in one step, beyond what their motors turn: further
away, and as near to the prediction by chance, there is another branch.
"""
SMALLEST = 2.0**-20
"""Part of a step at which a branch that cannot be followed is held to end."""
PUSH = 0.1
"""rad that tubes are turned by against each other where a branch ends, over what lies between discretisations."""
FALL, FALLS = 0.2, 20
"""rad that tubes turn by against each other in one step of a fall; falls at most on one step of a motion."""


class State(ctypes.Structure):
    """The struct State of branch.c."""

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


class _Elastic(ctypes.Structure):
    """The struct Elastic of branch.c."""

    _fields_ = [
        *((name, ctypes.c_long) for name in ("d", "rows", "against", "vectors")),
        *((name, ctypes.c_void_p) for name in ("first", "other")),
        *((name, ctypes.c_void_p) for name in FUNCTIONS),
        *(
            (name, ctypes.c_double)
            for name in ("converged", "near", "stray", "leap", "smallest", "stride", "push", "fall")
        ),
        ("iterations", ctypes.c_long),
    ]


class Compiled:
    """A structure's equilibria in C; any thread may call. numbers (T or 1, 8d): of the tubes, a row a robot."""

    def __init__(self, structure: Structure, alone: Path, beside: Path) -> None:
        """Take the functions from their libraries; raises OptionError where nothing can be compiled."""
        made = symbolic(structure)
        libraries = [
            *([ctypes.CDLL(str(alone))] * len(made.alone)),
            *([ctypes.CDLL(str(beside))] * len(made.beside)),
        ]
        self._run = cache.loaded(__package__, *CODE)
        couples = np.ascontiguousarray(made.of.couples, dtype=np.int64)
        addresses = (
            ctypes.cast(library[name], ctypes.c_void_p).value
            for library, name in zip(libraries, FUNCTIONS, strict=True)
        )
        self._keep = libraries, couples
        places = *(each.ctypes.data for each in couples), *addresses
        steps = CONVERGED, NEAR, STRAY, LEAP, SMALLEST, STRIDE, PUSH, FALL, ITERATIONS
        sizes = couples.shape[1], made.of.second.shape[0], made.vectors
        self._elastic = _Elastic(structure.d, *sizes, *places, *steps)
        self._reference = ctypes.byref(self._elastic)
        self.motors = ca.external("motors", str(alone))

    def walk(self, numbers: Array, state: State, goals: Array) -> Array:
        """The equilibria (count, 2d + 2) at as many goals (T, 2d + 2) as a branch reaches; the state goes on."""
        goals, x = np.ascontiguousarray(goals, dtype=float), np.empty(goals.shape)
        given = _address(numbers), ctypes.byref(state), _address(goals)
        return x[: self._run.walk(self._reference, *given, ctypes.c_long(len(goals)), _address(x))]

    def walk_abreast(self, numbers: Array, states: ctypes.Array[State], goals: Array) -> tuple[Array, Index]:
        """The equilibria (n, T, 2d + 2) of up to LANES robots at goals (n, T, 2d + 2), and how many of each were
        reached in whole steps (n,); the states (n,) go on so far.
        """
        count, places, size = goals.shape
        every = np.ascontiguousarray(numbers[np.arange(LANES) % count])
        goals, x, reached = np.ascontiguousarray(goals), np.empty(goals.shape), np.zeros(LANES, dtype=np.int64)
        sizes = (ctypes.c_long(each) for each in (places * size, places))
        given = _address(every), states, ctypes.c_long(count), _address(goals), *sizes
        self._run.walk_abreast(self._reference, *given, _address(x), _address(reached))
        return x, reached[:count]

    def follow(self, numbers: Array, state: State, goal: Array) -> tuple[bool, Array]:
        """Whether the state could go on to goal (2d + 2,), and its tips' jumps on the way (falls, d), rad."""
        goal, jumps, falls = np.ascontiguousarray(goal), np.zeros((FALLS, self._elastic.d)), ctypes.c_long(0)
        given = _address(numbers), ctypes.byref(state), _address(goal), _address(jumps), ctypes.byref(falls)
        return bool(self._run.follow(self._reference, *given)), jumps[: falls.value]

    def settle(self, numbers: Array, q: Array) -> tuple[ctypes.Array[State], Flags]:
        """The states (T,) that all tubes are turned to from alpha_d at q (T, 2d + 2); whether each was found."""
        q, rows = np.ascontiguousarray(q, dtype=float), ctypes.c_long(len(q))
        states, found = (State * len(q))(), np.zeros(len(q), dtype=np.int64)
        self._run.settle(self._reference, *_stepped(numbers), _address(q), rows, states, _address(found))
        return states, found.astype(bool)

    def margins(self, numbers: Array, x: Array) -> Array:
        """The margins (T,) of x (T, 2d + 2); NaN where x is."""
        x, found = np.ascontiguousarray(x, dtype=float), np.empty(len(x))
        self._run.margins(self._reference, *_stepped(numbers), _address(x), ctypes.c_long(len(x)), _address(found))
        return found

    def shapes(self, numbers: Array, x: Array, sigma: Array) -> tuple[Array, Array]:
        """Points (T, n, 3) in mm at x (T, 2d + 2) and sigma (n,) or (T, n), and directions of tips (T, 3)."""
        x, sigma = np.ascontiguousarray(x, dtype=float), np.ascontiguousarray(sigma, dtype=float)
        rows, samples = len(x), sigma.shape[-1]
        points, tips = np.empty((rows, samples, 3)), np.empty((rows, 3))
        at = _address(x), ctypes.c_long(rows), _address(sigma), ctypes.c_long(samples)
        step = ctypes.c_long(samples if sigma.ndim > 1 else 0)
        self._run.shapes(self._reference, *_stepped(numbers), *at, step, _address(points), _address(tips))
        return points, tips

    def rests(self, numbers: Array, q: Array, sigma: Array) -> Rest:
        """One robot, of numbers (1, 8d), at rest at every q (T, 2d + 2) without history; points at sigma (m,)."""
        q, sigma = np.ascontiguousarray(q, dtype=float), np.ascontiguousarray(sigma, dtype=float)
        rows, n, m = *q.shape, len(sigma)
        found = np.empty((rows, n + 4 + 3 * m))
        at = _address(numbers), _address(q), ctypes.c_long(rows), _address(sigma), ctypes.c_long(m)
        self._run.rests(self._reference, *at, _address(found))
        points = found[:, n + 4 :].reshape(rows, m, 3)
        return Rest(found[:, :n], points, found[:, n : n + 3], found[:, n + 3])


def _address(array: np.ndarray[Any, Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _stepped(numbers: Array) -> tuple[ctypes.c_void_p, ctypes.c_long]:
    """Numbers of tubes, and how far apart those of two rows are."""
    return _address(numbers), ctypes.c_long(numbers.shape[1] if len(numbers) > 1 else 0)


class Symbolic(NamedTuple):
    """Functions of a structure, in the order of FUNCTIONS: alone; the last two, for LANES at once; the energy.

    motors: (x, numbers (d, 8)) -> alpha and slopes over phi but the last. energy: -> strength, angles, turns, ends
    and made of Symbols, turns and ends transposed. second: -> the same in Symbols. shape: -> vectors (3, n) and
    the direction of the tip. points: (arc length, vectors, extensions (d,), numbers) -> the point there (3,), mm.
    """

    alone: tuple[ca.Function, ...]
    beside: tuple[ca.Function, ...]
    of: energy.Symbols

    @property
    def vectors(self) -> int:
        """How many a shape is made of."""
        return int(self.beside[0].size_in(1)[1])


@functools.lru_cache(maxsize=64)
def symbolic(structure: Structure) -> Symbolic:
    """What is compiled for a structure."""
    d = structure.d
    x, numbers, s = ca.SX.sym("x", 2 * d + 2), ca.SX.sym("numbers", d, len(NUMBERS)), ca.SX.sym("s")
    tubes, entries = symbolic_tubes(structure, numbers), ca.vertsplit(x)
    beta = entries[d : 2 * d]
    parts = torsion.sections(tubes, beta, ca)
    twisted = torsion.twist(tubes, entries, parts, ca)
    alpha = ca.vertcat(*torsion.motors(tubes, entries, twisted))
    of, vectors = energy.in_symbols(tubes, entries), shape.curves(tubes, entries, parts, twisted, ca)
    base = shape.turned_base(tubes, entries, ca)
    placed = [combination(vector, base) for vector in vectors]
    travels, _ = shape.travels(tubes, beta, parts, s, ca)
    _, turns = shape.travels(tubes, beta, parts, beta[-1], ca)
    tip = combination(combination([1.0, *turns], [(0.0, 0.0, 1.0), *vectors]), base)
    motors = [alpha, ca.densify(ca.jacobian(alpha, x[: d - 1]))]
    placing = [matrix_of(placed), ca.vertcat(*tip)]
    energies = [of.strength, of.angles, of.turns.T, of.ends.T, of.made]
    made: list[list[Any]] = [motors, energies, [of.second], placing]
    alone = [
        ca.Function(name, [x, numbers], [ca.densify(value) for value in values])
        for name, values in zip(FUNCTIONS, made, strict=False)
    ]
    given = s, ca.SX.sym("vectors", 3, len(placed)), ca.SX.sym("beta", d), numbers
    (point,) = ca.substitute([given[1] @ ca.vertcat(*travels)], [ca.vertcat(*beta)], [given[2]])
    names = "s", f"{SAME}vectors", f"{SAME}beta", f"{SAME}numbers"
    points = ca.Function("points", given, [ca.densify(point)], names, ["point"])
    return Symbolic(tuple(alone), (points, ca.Function(FUNCTIONS[-1], [x, numbers], motors)), of)


def compiled(structure: Structure) -> Compiled | None:
    """What all robots of a structure share; None until it has been made, and where nothing can be compiled."""
    if os.environ.get(cache.SWITCH) == "0" or structure.d > MOST_TUBES:
        return None
    return _soon(structure)()


class _Soon:
    def __init__(self, structure: Structure) -> None:
        self._structure = replace(structure, gap=False)
        made = symbolic(self._structure)
        self._alone, self._beside = (
            Library("\n".join(each.serialize() for each in those), functools.partial(tuple, those), lanes)
            for those, lanes in ((made.alone, 1), (made.beside, LANES))
        )
        self._found: Compiled | None = None

    def __call__(self) -> Compiled | None:
        if self._found is None and not cache.missing():
            alone, beside = self._alone.soon(), self._beside.soon()
            if alone is not None and beside is not None:
                self._found = Compiled(self._structure, alone, beside)
        return self._found


_soon = functools.lru_cache(maxsize=64)(_Soon)


def numbers_of(tubes: Tubes) -> Array:
    """Numbers of tubes as `Compiled` takes them, a row for every robot."""
    numbers = [tube[2 + k] for k in range(len(NUMBERS)) for tube in tubes]
    return np.stack(np.broadcast_arrays(*map(np.ravel, numbers)), axis=1)
