"""The lumen's wall near a robot, computed in C: wall.c, with the robot's points from compiled functions.

wall.py explains the method, and has it in numpy for use without a compiler. Lengths in mm, unknowns x in rad and
mm. Samples along the robot are evaluated side by side, one in each lane of a vector.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from ctr_nlp.codegen import cache, vector
from ctr_nlp.codegen.background import Library
from ctr_nlp.codegen.c_structures import check_structure
from ctr_nlp.models import Model
from ctr_nlp.models.protocol import frame_and_load_symbol, symbolic_tubes
from ctr_nlp.ocp.local_parameters import LocalParameterSource
from ctr_nlp.ocp.terms import LoadTerm
from ctr_nlp.ocp.terms.arrival import PENALTY_ROUNDING_MM
from ctr_nlp.ocp.terms.lumen import (
    CENTRELINE_SMOOTHING_MM,
    EXCESS_CONTACT_FACTOR,
    SLACK_SQUARE_COST,
    WALL_COLUMN_COUNT,
    WALL_SAMPLES_PER_TUBE,
)
from ctr_nlp.paths.distance_field import FAR_MM, FLATTEST_RADIUS_MM, DistanceGrid
from ctr_nlp.paths.lumen import (
    LEAST_CURVATURE_PER_MM,
    LUMEN_TABLE_SPACING_MM,
    Lumen,
    LumenProjection,
    outermost_tube_radii,
    tube_outer_radii,
)
from ctr_nlp.paths.walls import WallGeometry, Walls
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure
from ctr_nlp.typing import Array

WALL_SAMPLE_LANES = vector.VECTOR_LANES
"""Samples that are evaluated side by side."""
_WALL_INTEGER_FIELDS = "unknowns", "loaded", "tubes", "places", "finer", "samples", "lanes", "nodes"
"""Names of the integer fields of the struct Wall, in its order; the tuples below name its given arrays, its
numbers and its work arrays.
"""
_WALL_INPUT_FIELDS = "shares", "numbers", "table", "along", "path", "radius", "outer"
_WALL_NUMBER_FIELDS = "clearance", "centred", "tiny", "spacing", "widest"
_WALL_WORK_FIELDS = "x", "load", "at", "kept_x", "kept_load", "kept"

_PROJECTION_SIZES = 1, 1, 3, 3, 3, 3, 1, 1, 1, 1
"""Numbers of each field of LumenProjection, in the order in which look_beside of wall.c writes them."""
_FIELD_NUMBERS = 13
"""Numbers that evaluate_beside of wall.c writes for a point: distance, gradient and Hessian."""


# Order and types of the fields must be those of the struct in C: nothing checks them, and a mismatch reads other
# memory.
class _WallStruct(ctypes.Structure):
    """The struct Wall of wall.c, field by field."""

    known: int
    _fields_ = [
        ("points", ctypes.c_void_p),
        *((name, ctypes.c_long) for name in _WALL_INTEGER_FIELDS),
        *((name, ctypes.c_void_p) for name in _WALL_INPUT_FIELDS),
        *((name, ctypes.c_double) for name in _WALL_NUMBER_FIELDS),
        *((name, ctypes.c_void_p) for name in _WALL_WORK_FIELDS),
        ("known", ctypes.c_long),
        ("fields", ctypes.c_long),
        ("field", ctypes.c_void_p),
    ]

    def forget_points(self) -> None:
        """Clear the cache of points: the next call computes every point again."""
        self.known = 0


class _GridStruct(ctypes.Structure):
    """The struct Grid of wall.c, field by field."""

    _fields_ = [
        ("to_grid", ctypes.c_double * 12),
        ("to_mm", ctypes.c_double * 12),
        ("shape", ctypes.c_long * 3),
        ("index", ctypes.c_void_p),
        ("coefficients", ctypes.c_void_p),
    ]


class _FieldStruct(ctypes.Structure):
    """The struct Field of wall.c, field by field."""

    _fields_ = [
        ("grid", ctypes.c_void_p),
        ("grids", ctypes.c_long),
        *((name, ctypes.c_double) for name in ("sign", "margin", "sharpest", "flattest", "far")),
    ]


class _WallTables:
    """The tables of a wall as C reads them; they must live as long as the struct that has their addresses."""

    def __init__(self, geometry: WallGeometry) -> None:
        lumen = (
            geometry if isinstance(geometry, Lumen) else geometry.lumen if isinstance(geometry, Walls) else None
        )
        bodies = geometry.bodies if isinstance(geometry, Walls) else ()
        if lumen is None:
            tables, self.nodes, self.widest = [np.zeros(0)] * 4, 0, 0.0
        else:
            tables = [lumen.table[:, :3], lumen.arc_lengths, *lumen.spline_coefficients]
            self.nodes, self.widest = len(lumen.arc_lengths), float(np.diff(lumen.arc_lengths).max())
        self.arrays: list[npt.NDArray[Any]] = [np.ascontiguousarray(each) for each in tables]
        self._grids = [
            (_GridStruct * len(body.field.grids))(*map(self._grid, body.field.grids)) for body in bodies
        ]
        self._fields = (_FieldStruct * len(bodies))(
            *(
                _FieldStruct(
                    ctypes.addressof(grids),
                    len(grids),
                    body.sign,
                    body.margin,
                    body.field.sharpest_radius,
                    FLATTEST_RADIUS_MM,
                    FAR_MM,
                )
                for body, grids in zip(bodies, self._grids, strict=True)
            )
        )
        self.fields, self.field = len(bodies), ctypes.addressof(self._fields)

    def _grid(self, grid: DistanceGrid) -> _GridStruct:
        """Return the struct of a grid, and keep its arrays."""
        kept = np.ascontiguousarray(grid.index, np.int32), np.ascontiguousarray(grid.coefficients, np.float32)
        self.arrays += kept
        to_mm = np.linalg.inv(grid.to_grid)
        found = _GridStruct(index=kept[0].ctypes.data, coefficients=kept[1].ctypes.data)
        found.to_grid[:], found.to_mm[:] = grid.to_grid[:3].ravel().tolist(), to_mm[:3].ravel().tolist()
        found.shape[:] = list(grid.index.shape)
        return found


class CompiledWall:
    """The walls around a robot on a model, in C; not from two threads at once.

    clearance: least distance from the wall, mm. subsamples: for each sample point. tiny: replaces 0 in a
    denominator.
    """

    def __init__(
        self, robot: Robot, geometry: WallGeometry, model: Model, clearance: float, subsamples: int, tiny: float
    ) -> None:
        """Prepare; raises OptionError where nothing can be compiled."""
        count = robot.d * WALL_SAMPLES_PER_TUBE * subsamples
        d = robot.d
        # Rounded up to whole vectors; samples more than there are stand at the tip (_arc_length_coefficients).
        samples = -(-count // WALL_SAMPLE_LANES)
        self._points, self._made = _compile_sample_points(model.program_model, robot.structure, samples)
        unknowns = self._points.numel_in(0)
        self._loaded = 0 if model.applied_load is None else self._points.numel_in(3)
        rows = d * WALL_SAMPLES_PER_TUBE * subsamples
        self._tables = _WallTables(geometry)
        given = (
            _arc_length_coefficients(d, WALL_SAMPLES_PER_TUBE * subsamples, samples),
            # Every lane needs the numbers of the tubes, as its own column.
            np.tile(robot.numbers.ravel(order="F"), WALL_SAMPLE_LANES),
            *self._tables.arrays[:4],
            tube_outer_radii(robot),
        )
        sizes = [WALL_SAMPLE_LANES * unknowns, WALL_SAMPLE_LANES * self._loaded, WALL_SAMPLE_LANES * samples * 3]
        sizes += [unknowns, self._loaded, rows * WALL_COLUMN_COUNT + 1]
        self._arrays = [*given, *map(np.zeros, sizes)]
        # C keeps addresses: the arrays must live as long as the struct, in self._arrays.
        addresses = [array.ctypes.data for array in self._arrays]
        self._fixed = (
            *(
                unknowns,
                self._loaded,
                d,
                WALL_SAMPLES_PER_TUBE,
                subsamples,
                samples,
                WALL_SAMPLE_LANES,
                self._tables.nodes,
            ),
            *addresses[: len(given)],
            *(
                clearance,
                CENTRELINE_SMOOTHING_MM,
                tiny,
                LUMEN_TABLE_SPACING_MM,
                self._tables.widest,
            ),
            *addresses[len(given) :],
            0,
            self._tables.fields,
            self._tables.field,
        )
        self._rows = rows
        self._numbers = self._arrays[_WALL_INPUT_FIELDS.index("numbers")]
        # The robot's numbers, to go back to after other robots' were used.
        self._own = self._numbers.copy()
        self._wall = _WallStruct(None, *self._fixed)
        self._library = cache.load_c_files(__package__, "wall.c")
        for name, mirror in (("Wall", _WallStruct), ("Field", _FieldStruct), ("Grid", _GridStruct)):
            check_structure(self._library, name, mirror)
        self._compiled: ctypes.CDLL | None = None

    def ready(self, wait: bool = False) -> bool:
        """Return whether the functions have been compiled; wait: until they have."""
        if (
            self._compiled is None
            and (path := self._made.wait_for_path() if wait else self._made.path_if_ready()) is not None
        ):
            self._compiled = ctypes.CDLL(str(path))
            # Until the points' function is compiled the struct has a null pointer there, and is not called.
            points = ctypes.cast(self._compiled[self._points.name()], ctypes.c_void_p).value
            self._wall = _WallStruct(points, *self._fixed)
        return self._compiled is not None

    def __call__(self, x: Array, numbers: Array | None = None, loads: Array | None = None) -> tuple[Array, Array]:
        """Return the wall's numbers near x (T, n), and the slacks (T,) needed, mm.

        The first are (T, rows, WALL_COLUMN_COUNT), as of Wall.compute_local_wall. numbers (d, 8): of the tubes,
        where they are not the robot's. loads (T, 17 + 3d): on models with loads. Raises ValueError for other
        unknowns or loads than the model's.
        """
        loads = np.zeros((len(x), 0)) if loads is None else np.ascontiguousarray(loads, dtype=float)
        if loads.shape != (len(x), self._loaded):
            raise ValueError(f"loads have shape {loads.shape}; it must be {(len(x), self._loaded)}")
        if x.shape[1:] != (self._fixed[0],):
            raise ValueError(f"x has shape {x.shape}; the model has {self._fixed[0]} unknowns")
        x, found = np.ascontiguousarray(x, dtype=float), np.empty((len(x), self._rows * WALL_COLUMN_COUNT + 1))
        of_tubes = self._own if numbers is None else np.tile(numbers.ravel(order="F"), WALL_SAMPLE_LANES)
        if not np.array_equal(of_tubes, self._numbers):
            self._numbers[:] = of_tubes
            # C skips points that it has computed at the same x; with other tubes these are different.
            self._wall.forget_points()
        given = ctypes.c_long(len(x)), x.ctypes, loads.ctypes, found.ctypes
        self._library.around_all(ctypes.byref(self._wall), *given)
        # C writes column after column of (rows, WALL_COLUMN_COUNT), as programs pack
        # parameters.
        return found[:, :-1].reshape(len(x), WALL_COLUMN_COUNT, self._rows).transpose(0, 2, 1), found[:, -1].copy()

    def local_parameter_source(self, settled: float, rounds: int) -> LocalParameterSource:
        """Return addresses and costs for run.c, which updates every frame; valid as long as this object lives.

        settled: mm by which slacks may differ in the last round; rounds: most of them.
        """
        call = ctypes.cast(self._library.around, ctypes.c_void_p).value or 0
        named = LoadTerm.name, "wall", "contact_weight", "contact_allowed"
        costs = SLACK_SQUARE_COST, EXCESS_CONTACT_FACTOR, PENALTY_ROUNDING_MM
        return LocalParameterSource(call, ctypes.addressof(self._wall), *named, *costs, settled, rounds)


class WallDistance:
    """Signed distance of points to the nearest wall, and what that wall is like there; in C where possible."""

    def __init__(self, geometry: WallGeometry) -> None:
        """Prepare the tables of a wall for C."""
        self._geometry = geometry
        self._tables = tables = _WallTables(geometry)
        named = zip(("table", "along", "path", "radius"), tables.arrays, strict=False)
        self._wall = _WallStruct(
            nodes=tables.nodes,
            spacing=LUMEN_TABLE_SPACING_MM,
            widest=tables.widest,
            tiny=LEAST_CURVATURE_PER_MM,
            fields=tables.fields,
            field=tables.field,
            **{name: array.ctypes.data for name, array in named},
        )

    def __call__(self, points: Array) -> Array:
        """Return the room at points (.., 3) in mm, (..,) mm; NaN at points that are NaN."""
        if cache.unavailable_reason():
            near = self._geometry.project(points)
            return np.asarray(near.radius - near.distance)
        call = cache.load_c_files(__package__, "wall.c").left_beside
        return _call_beside(call, ctypes.byref(self._wall), points, 1)[..., 0]

    def project(self, points: Array) -> LumenProjection:
        """Return the nearest wall at points (.., 3), mm, as a path with a radius; NaN at points that are NaN."""
        if cache.unavailable_reason():
            return self._geometry.project(points)
        library = cache.load_c_files(__package__, "wall.c")
        found = _call_beside(library.look_beside, ctypes.byref(self._wall), points, sum(_PROJECTION_SIZES))
        parts = np.split(found, np.cumsum(_PROJECTION_SIZES)[:-1], axis=-1)
        sizes = zip(parts, _PROJECTION_SIZES, strict=True)
        return LumenProjection(*(part[..., 0] if size == 1 else part for part, size in sizes))

    def evaluate_bodies(self, points: Array) -> list[tuple[Array, Array, Array]]:
        """Return the room at points (.., 3), mm, beside each body (..,), mm, its gradient (.., 3) and Hessian.

        The Hessian is (.., 3, 3), 1/mm. The room is the signed distance less the margin, positive where the robot
        may be.
        """
        geometry = self._geometry
        bodies = geometry.bodies if isinstance(geometry, Walls) else ()
        if cache.unavailable_reason():
            flat, shape = points.reshape(-1, 3), points.shape[:-1]
            each = [(body.sign, body.margin, body.field.evaluate(flat)) for body in bodies]
            return [
                (
                    (sign * distance - margin).reshape(shape),
                    sign * gradient.reshape(*shape, 3),
                    sign * hessian.reshape(*shape, 3, 3),
                )
                for sign, margin, (distance, gradient, hessian) in each
            ]
        call = cache.load_c_files(__package__, "wall.c").evaluate_beside
        # C takes one field at a time: the address of the first one, and of those behind it.
        size = ctypes.sizeof(_FieldStruct)
        found = [
            _call_beside(call, ctypes.c_void_p(self._tables.field + k * size), points, _FIELD_NUMBERS)
            for k in range(self._tables.fields)
        ]
        return [(each[..., 0], each[..., 1:4], each[..., 4:].reshape(*each.shape[:-1], 3, 3)) for each in found]

    def clearances(self, robot: Robot, beta: Array, shape: Array, sigma: Array) -> Array:
        """Return the clearance between the wall and a robot's outermost tube, (.., T, n) mm.

        Negative beyond the wall. beta (T, d): extensions; shape (.., T, n, 3) mm: points at sigma (n,), NaN where
        there are none.
        """
        return np.asarray(self(shape) - outermost_tube_radii(robot, beta, sigma))


def _call_beside(call: Any, wall: Any, points: Array, count: int) -> Array:
    """Return what C finds with a wall at points (.., 3), mm: so many numbers for each, (.., count)."""
    # C reads and writes plain rows of doubles.
    points = np.ascontiguousarray(points, dtype=float)
    found = np.empty((*points.shape[:-1], count))
    call(wall, ctypes.c_long(points.size // 3), points.ctypes, found.ctypes)
    return found


def _arc_length_coefficients(d: int, count: int, samples: int) -> Array:
    """Return coefficients of the extensions in arc lengths of `count` samples a tube: (samples, d) by columns, by
    lanes.

    Arc lengths are those of terms.lumen.arc_lengths; samples beyond the last stand at the innermost tip.
    """
    # Sample number j of tube i is at beta_{i-1} + (j + 1) / count (beta_i - beta_{i-1}): shares 1 - f and f
    # of two neighbouring extensions, the first of which is beta_0 = 0 and has no column.
    tube, part = np.divmod(np.arange(WALL_SAMPLE_LANES * samples).clip(max=d * count - 1), count)
    fraction = (part + 1.0) / count
    found = np.zeros((WALL_SAMPLE_LANES * samples, d + 1))
    np.put_along_axis(found, tube[:, None], 1 - fraction[:, None], axis=1)
    np.put_along_axis(found, tube[:, None] + 1, fraction[:, None], axis=1)
    return np.ascontiguousarray(found[:, 1:].reshape(WALL_SAMPLE_LANES, samples, d).transpose(0, 2, 1))


@functools.lru_cache(maxsize=64)
def _compile_sample_points(model: Model, structure: Structure, samples: int) -> tuple[ca.Function, Library]:
    """Return the function sample_points_function, and its library for WALL_SAMPLE_LANES samples side by side."""
    points = sample_points_function(model, structure, samples)
    return points, Library(points.serialize(), functools.partial(tuple, (points,)), WALL_SAMPLE_LANES)


@functools.lru_cache(maxsize=64)
def sample_points_function(model: Model, structure: Structure, samples: int) -> ca.Function:
    """Build the function (x, shares (samples, d) of extensions, numbers) -> points (samples, 3), mm.

    model, structure: of the robot, whose points are those in programs. On models with loads the function takes the
    numbers of one, too.
    """
    shares = ca.SX.sym("shares", samples, structure.d)
    numbers = ca.SX.sym("numbers", structure.d, len(TUBE_NUMBER_NAMES))
    tubes = symbolic_tubes(structure, numbers)
    shape, load = frame_and_load_symbol(model, structure, tubes, lambda beta: shares @ ca.vertcat(*beta))
    given = [shape.x, shares, numbers] + [load] * (model.applied_load is not None)
    symbols, values = shape.inner.columns
    (found,) = ca.substitute([ca.SX(ca.horzcat(*shape.to_base_frame(shape.points)))], [symbols], [values])
    return ca.Function("points", given, [ca.densify(found)])
