"""The lumen's wall near a robot, found in C: wall.c, with the robot's points from compiled functions.

wall.py says what is looked for, and has it in numpy for use without a compiler. Lengths in mm, unknowns x in rad
and mm. Samples along the robot are evaluated side by side, one in each lane of a vector.
"""

from __future__ import annotations

import ctypes
import functools

import casadi as ca
import numpy as np

from ctr_nlp.codegen import cache, vector
from ctr_nlp.codegen.background import Library
from ctr_nlp.formulations.terms import Bears
from ctr_nlp.formulations.terms.arrival import ROUNDED
from ctr_nlp.formulations.terms.lumen import CENTRED, COLUMNS, FIRM, HARD, PLACES
from ctr_nlp.models import Model
from ctr_nlp.models.protocol import frame_bearing, symbolic_tubes
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import NUMBERS, Structure
from ctr_nlp.solvers.frame.adapter import Surroundings
from ctr_nlp.target.lumen import SPACING, Lumen, outer_radii, outer_radius
from ctr_nlp.typing import Array

LANES = vector.LANES
"""Samples that are evaluated side by side."""
_LONGS = "unknowns", "loaded", "tubes", "places", "finer", "samples", "lanes", "nodes"
"""Names of the integer fields of the struct Wall, in its order; then those of given arrays, of numbers, and of
room.
"""
_GIVEN = "shares", "numbers", "table", "along", "path", "radius", "outer"
_NUMBERS = "clearance", "centred", "tiny", "spacing", "widest"
_OWN = "x", "load", "at", "kept_x", "kept_load", "kept"


class _InC(ctypes.Structure):
    """The struct Wall of wall.c, field by field."""

    known: int
    _fields_ = [
        ("points", ctypes.c_void_p),
        *((name, ctypes.c_long) for name in _LONGS),
        *((name, ctypes.c_void_p) for name in _GIVEN),
        *((name, ctypes.c_double) for name in _NUMBERS),
        *((name, ctypes.c_void_p) for name in _OWN),
        ("known", ctypes.c_long),
    ]

    def forget(self) -> None:
        """Let nothing count as found before: the next call looks at every point."""
        self.known = 0


class Around:
    """A lumen's wall around a robot on a model, in C; not from two threads at once.

    finer: samples a place. clearance, mm: to be kept. tiny: replaces 0 in a denominator.
    """

    def __init__(
        self, robot: Robot, lumen: Lumen, model: Model, clearance: float, finer: int, tiny: float
    ) -> None:
        """Prepare; raises OptionError where nothing can be compiled."""
        count, d = robot.d * PLACES * finer, robot.d
        # Rounded up to whole vectors; samples more than there are stand at the tip (_shares).
        samples = -(-count // LANES)
        self._points, self._made = _points_in_c(model.form, robot.structure, samples)
        unknowns, self._loaded = self._points.numel_in(0), 0 if model.bears is None else self._points.numel_in(3)
        rows = d * PLACES
        given = (
            _shares(d, PLACES * finer, samples),
            # Every lane needs the numbers of the tubes, as its own column.
            np.tile(robot.numbers.ravel(order="F"), LANES),
            *(np.ascontiguousarray(each) for each in (lumen.table[:, :3], lumen.along, *lumen.pieces)),
            outer_radius(robot),
        )
        sizes = [LANES * unknowns, LANES * self._loaded, LANES * samples * 3]
        sizes += [unknowns, self._loaded, rows * COLUMNS + 1]
        self._arrays = [*given, *map(np.zeros, sizes)]
        # C keeps addresses: the arrays must live as long as the struct, in self._arrays.
        addresses = [array.ctypes.data for array in self._arrays]
        self._fixed = (
            *(unknowns, self._loaded, d, PLACES, finer, samples, LANES, len(lumen.along)),
            *addresses[: len(given)],
            *(clearance, CENTRED, tiny, SPACING, float(np.diff(lumen.along).max())),
            *addresses[len(given) :],
        )
        self._rows, self._numbers = rows, self._arrays[_GIVEN.index("numbers")]
        # The robot's numbers, to go back to after other robots' were used.
        self._own = self._numbers.copy()
        self._wall = _InC(None, *self._fixed)
        self._library = cache.loaded(__package__, "wall.c")
        self._compiled: ctypes.CDLL | None = None

    def ready(self, wait: bool = False) -> bool:
        """Whether the functions have been compiled; wait: until they have."""
        if self._compiled is None and (path := self._made.now() if wait else self._made.soon()) is not None:
            self._compiled = ctypes.CDLL(str(path))
            # Until the points' function is compiled the struct has a null pointer there, and is not called.
            points = ctypes.cast(self._compiled[self._points.name()], ctypes.c_void_p).value
            self._wall = _InC(points, *self._fixed)
        return self._compiled is not None

    def __call__(self, x: Array, numbers: Array | None = None, loads: Array | None = None) -> tuple[Array, Array]:
        """Numbers that describe the wall, (T, d PLACES, COLUMNS), near unknowns x (T, n), and slacks (T,) needed,
        mm.

        numbers (d, 8): of the tubes, where they are not the robot's. loads (T, 17 + 3d): on models with loads.
        Raises ValueError for other unknowns or loads than the model's.
        """
        loads = np.zeros((len(x), 0)) if loads is None else np.ascontiguousarray(loads, dtype=float)
        if loads.shape != (len(x), self._loaded):
            raise ValueError(f"loads have shape {loads.shape}; it must be {(len(x), self._loaded)}")
        if x.shape[1:] != (self._fixed[0],):
            raise ValueError(f"x has shape {x.shape}; the model has {self._fixed[0]} unknowns")
        x, found = np.ascontiguousarray(x, dtype=float), np.empty((len(x), self._rows * COLUMNS + 1))
        of_tubes = self._own if numbers is None else np.tile(numbers.ravel(order="F"), LANES)
        if not np.array_equal(of_tubes, self._numbers):
            self._numbers[:] = of_tubes
            # C skips points that it has found at the same x; with other tubes these are elsewhere.
            self._wall.forget()
        given = ctypes.c_long(len(x)), x.ctypes, loads.ctypes, found.ctypes
        self._library.around_all(ctypes.byref(self._wall), *given)
        # C writes column after column of (d PLACES, COLUMNS), as programs pack parameters.
        return found[:, :-1].reshape(len(x), COLUMNS, self._rows).transpose(0, 2, 1), found[:, -1].copy()

    def surroundings(self, settled: float, rounds: int) -> Surroundings:
        """Addresses and costs for run.c, which calls around at every frame; valid as long as this object lives.

        settled: mm by which slacks may differ in the last round; rounds: most of them.
        """
        call = ctypes.cast(self._library.around, ctypes.c_void_p).value or 0
        named = Bears.name, "wall", "contact_weight", "contact_allowed"
        costs = FIRM, HARD, ROUNDED
        return Surroundings(call, ctypes.addressof(self._wall), *named, *costs, settled, rounds)


class Beside:
    """Room in a lumen beside points: its radius less the distance to its path; in C where possible."""

    def __init__(self, lumen: Lumen) -> None:
        """Prepare."""
        self._lumen = lumen
        pieces = (np.ascontiguousarray(each) for each in (lumen.table[:, :3], lumen.along, *lumen.pieces))
        self._kept = dict(zip(("table", "along", "path", "radius"), pieces, strict=True))
        addresses = {name: array.ctypes.data for name, array in self._kept.items()}
        widest = float(np.diff(lumen.along).max())
        self._wall = _InC(nodes=len(lumen.along), spacing=SPACING, widest=widest, **addresses)

    def __call__(self, points: Array) -> Array:
        """Room at points (.., 3) in mm, (..,) mm; NaN at points that are NaN."""
        if cache.missing():
            near = self._lumen.near(points)
            return np.asarray(near.radius - near.distance)
        # C reads and writes plain rows of doubles.
        points, found = np.ascontiguousarray(points, dtype=float), np.empty(points.shape[:-1])
        call = cache.loaded(__package__, "wall.c").left_beside
        call(ctypes.byref(self._wall), ctypes.c_long(found.size), points.ctypes, found.ctypes)
        return found

    def clearances(self, robot: Robot, beta: Array, shape: Array, sigma: Array) -> Array:
        """Clearance between the wall and a robot's outermost tube, (.., T, n) mm; negative beyond the wall.

        beta (T, d): extensions; shape (.., T, n, 3) mm: points at sigma (n,), NaN where there are none.
        """
        return np.asarray(self(shape) - outer_radii(robot, beta, sigma))


def _shares(d: int, count: int, samples: int) -> Array:
    """Coefficients of the extensions in arc lengths of count samples a tube: (samples, d) by columns, by lanes.

    Arc lengths are those of terms.lumen.arc_lengths; samples more than there are stand at the innermost tip.
    """
    # Sample number j of tube i is at beta_{i-1} + (j + 1) / count (beta_i - beta_{i-1}): shares 1 - f and f
    # of two neighbouring extensions, the first of which is beta_0 = 0 and has no column.
    tube, part = np.divmod(np.arange(LANES * samples).clip(max=d * count - 1), count)
    fraction, found = (part + 1.0) / count, np.zeros((LANES * samples, d + 1))
    np.put_along_axis(found, tube[:, None], 1 - fraction[:, None], axis=1)
    np.put_along_axis(found, tube[:, None] + 1, fraction[:, None], axis=1)
    return np.ascontiguousarray(found[:, 1:].reshape(LANES, samples, d).transpose(0, 2, 1))


@functools.lru_cache(maxsize=64)
def _points_in_c(model: Model, structure: Structure, samples: int) -> tuple[ca.Function, Library]:
    """The function points_at, and its library for LANES samples side by side."""
    points = points_at(model, structure, samples)
    return points, Library(points.serialize(), functools.partial(tuple, (points,)), LANES)


@functools.lru_cache(maxsize=64)
def points_at(model: Model, structure: Structure, samples: int) -> ca.Function:
    """A function (x, shares (samples, d) of extensions, numbers) -> points (samples, 3), mm.

    They are the points that programs have. On models with loads the function takes the numbers of one, too.
    """
    shares, numbers = ca.SX.sym("shares", samples, structure.d), ca.SX.sym("numbers", structure.d, len(NUMBERS))
    tubes = symbolic_tubes(structure, numbers)
    shape, load = frame_bearing(model, structure, tubes, lambda beta: shares @ ca.vertcat(*beta))
    given = [shape.x, shares, numbers] + [load] * (model.bears is not None)
    symbols, values = shape.inner.columns
    (found,) = ca.substitute([ca.SX(ca.horzcat(*shape.placed(shape.points)))], [symbols], [values])
    return ca.Function("points", given, [ca.densify(found)])
