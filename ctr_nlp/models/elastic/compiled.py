"""The elastic model's equilibria and margins in C: branch.c, margin.c and fall.c around generated functions."""

from __future__ import annotations

import ctypes
import functools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.background import Library
from ctr_nlp.models.elastic import energy, torsion
from ctr_nlp.models.protocol import symbolic_tubes
from ctr_nlp.robot.structure import NUMBERS, Structure, Tubes
from ctr_nlp.typing import Array, Flags

MOST_TUBES = 8
"""That branch.c has room for."""


STRIDE = 0.5
"""rad that tubes are turned by at once on the way from the aligned robot."""
CONVERGED, NEAR, ITERATIONS = 1e-7, 1e-4, 8
"""rad of the last Newton step, whose error is about its square, and of that on the way; steps at most."""
STRAY = 0.1
"""rad: an equilibrium further than this from its prediction may belong to another branch."""
LEAP = 1.0
"""rad that tips may be predicted to turn against each other in one step, beyond what their motors turn: further
away, and as near to the prediction by chance, there is another branch.
"""
SMALLEST = 2.0**-20
"""Part of a step at which a branch that cannot be followed is held to end."""
PUSH = 0.1
"""rad that tubes are turned by against each other where a branch ends, over what lies between discretisations."""
FALL, FALLS = 0.1, 20
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
        *((name, ctypes.c_long) for name in ("d", "twists", "rows")),
        *((name, ctypes.c_void_p) for name in ("starts", "columns", "first", "second", "ends", "entries")),
        *((name, ctypes.c_void_p) for name in ("motors", "energy")),
        *(
            (name, ctypes.c_double)
            for name in ("converged", "near", "stray", "leap", "smallest", "stride", "push", "fall")
        ),
        ("iterations", ctypes.c_long),
    ]


class Compiled:
    """A structure's equilibria in C; any thread may call. numbers (T or 1, 6d): of the tubes, a row a robot."""

    def __init__(self, structure: Structure, path: Path) -> None:
        """Take the functions from their library; raises OptionError where nothing can be compiled."""
        functions, of = symbolic(structure)
        library = ctypes.CDLL(str(path))
        self._run = cache.loaded(__package__, "branch.c", "margin.c", "fall.c")
        rows, columns = np.nonzero(of.pattern)
        starts = np.searchsorted(rows, np.arange(len(of.pattern) + 1))
        longs = [np.array(each, dtype=np.int64) for each in (starts, columns, *of.couples, of.ends)]
        entries = of.pattern[rows, columns]
        addresses = (ctypes.cast(library[function.name()], ctypes.c_void_p).value for function in functions)
        self._keep = library, longs, entries
        places = *(array.ctypes.data for array in (*longs, entries)), *addresses
        steps = CONVERGED, NEAR, STRAY, LEAP, SMALLEST, STRIDE, PUSH, FALL, ITERATIONS
        self._elastic = _Elastic(structure.d, len(of.ends), len(of.pattern), *places, *steps)
        self._reference = ctypes.byref(self._elastic)
        self.motors = ca.external(functions[0].name(), str(path))

    def walk(self, numbers: Array, state: State, goals: Array) -> Array:
        """The equilibria (count, 2d + 2) at as many goals (T, 2d + 2) as a branch reaches; the state goes on."""
        goals, x = np.ascontiguousarray(goals, dtype=float), np.empty(goals.shape)
        given = _address(numbers), ctypes.byref(state), _address(goals)
        return x[: self._run.walk(self._reference, *given, ctypes.c_long(len(goals)), _address(x))]

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
        """The margins (T,) of x (T, 2d + 2)."""
        x, found = np.ascontiguousarray(x, dtype=float), np.empty(len(x))
        self._run.margins(self._reference, *_stepped(numbers), _address(x), ctypes.c_long(len(x)), _address(found))
        return found


def _address(array: np.ndarray[Any, Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _stepped(numbers: Array) -> tuple[ctypes.c_void_p, ctypes.c_long]:
    """Numbers of tubes, and how far apart those of two rows are."""
    return _address(numbers), ctypes.c_long(numbers.shape[1] if len(numbers) > 1 else 0)


@functools.lru_cache(maxsize=64)
def symbolic(structure: Structure) -> tuple[tuple[ca.Function, ca.Function], energy.Symbols]:
    """(x, numbers (d, 6)) -> alpha and slopes over phi but the last; -> strength, angles, scales; the energy."""
    d = structure.d
    x, numbers = ca.SX.sym("x", 2 * d + 2), ca.SX.sym("numbers", d, len(NUMBERS))
    tubes, entries = symbolic_tubes(structure, numbers), ca.vertsplit(x)
    twisted = torsion.twist(tubes, entries, torsion.sections(tubes, entries[d : 2 * d], ca), ca)
    alpha = ca.densify(ca.vertcat(*torsion.motors(tubes, entries, twisted)))
    slopes, of = ca.densify(ca.jacobian(alpha, x[: d - 1])), energy.in_symbols(tubes, entries)
    motors = ca.Function("motors", [x, numbers], [alpha, slopes])
    return (motors, ca.Function("energy", [x, numbers], [ca.densify(part) for part in of[:3]])), of


def compiled(structure: Structure) -> Compiled | None:
    """What all robots of a structure share; None until it has been made, and where nothing can be compiled."""
    if os.environ.get(cache.SWITCH) == "0" or structure.d > MOST_TUBES:
        return None
    return _soon(replace(structure, gap=False))()


class _Soon:
    def __init__(self, structure: Structure) -> None:
        functions, _ = symbolic(structure)
        described = "\n".join(function.serialize() for function in functions)
        self._structure, self._library = structure, Library(described, functools.partial(tuple, functions), 1)
        self._found: Compiled | None = None

    def __call__(self) -> Compiled | None:
        if self._found is None and not cache.missing() and (path := self._library.soon()) is not None:
            self._found = Compiled(self._structure, path)
        return self._found


_soon = functools.lru_cache(maxsize=64)(_Soon)


def numbers_of(tubes: Tubes) -> Array:
    """Numbers of tubes as `Compiled` takes them, a row for every robot."""
    numbers = [tube[2 + k] for k in range(len(NUMBERS)) for tube in tubes]
    return np.stack(np.broadcast_arrays(*map(np.ravel, numbers)), axis=1)
