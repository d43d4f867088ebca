"""Row-wise arithmetic of an interior-point method over a chain: one loop of C for tens of numpy's.

Rows are x itself, the frames' constraints and the links. Slacks turn every row into an equation, r(x) = s, and the
log barrier keeps slacks within their bounds. With multipliers z_l, z_u >= 0 of these, the conditions of a barrier
problem with barrier mu (mm^2) are

    gradient + A' (z_u - z_l) = 0,    r(x) = s,    z_l (s - l) = mu,    z_u (u - s) = mu.

Without slacks and multipliers, the Newton system has the frames' Hessians and what the rows add to them: a
symmetric matrix with a band as wide as the links reach.
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.c_structures import check_structure
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.solvers.barrier import BOUND_RELAXATION, INFINITE_BOUND
from ctr_nlp.typing import Array

CHAIN_MIN_DENOMINATOR = 1e-30
"""Replaces 0 in a denominator."""


class _Point(ctypes.Structure):
    """The struct Point of rows.c: x (T n,), then slacks and multipliers of lower and upper bounds, one a row
    each.
    """

    _fields_ = [(name, ctypes.c_void_p) for name in ("x", "slack", "at_lower", "at_upper")]


class _Chain(ctypes.Structure):
    """The struct Chain of rows.c, field by field."""

    _fields_ = [
        *((name, ctypes.c_long) for name in ("frames", "unknowns", "constraints", "links", "width")),
        *((name, ctypes.c_long) for name in ("bent", "curved")),
        *((name, ctypes.c_void_p) for name in ("lower", "upper", "low", "high", "free")),
        *((name, ctypes.c_void_p) for name in ("starts", "columns", "entries", "offset", "weight")),
        *((name, ctypes.c_void_p) for name in ("gradient", "jacobian")),
        *(
            (name, ctypes.c_void_p)
            for name in ("slope", "value", "band", "right", "rows", "per_lower", "per_upper")
        ),
        *((name, _Point) for name in ("at", "step", "trial")),
    ]


class Measures(NamedTuple):
    """Size of the violations of a barrier problem's conditions at a point.

    objective: mm^2; violation: of bounds as given; gap: largest difference of a row from its slack; stationarity:
    of the Lagrangian, mm^2 per unit of x; least, most: smallest and largest product of a multiplier and its
    slack's distance from the bound, mm^2.
    """

    objective: float
    violation: float
    gap: float
    stationarity: float
    least: float
    most: float

    def error(self, barrier: float) -> float:
        """KKT residual of the barrier problem; with barrier 0, of the problem itself."""
        # All products must equal the barrier: the smallest and the largest of them bound the error of any.
        parts = self.stationarity, self.gap, abs(self.least - barrier), abs(self.most - barrier)
        return float(np.max(parts))


class Step(NamedTuple):
    """A Newton step's measures.

    multiplier: the largest after it; primal, dual: the parts of it that keep slacks within their bounds and
    multipliers positive; slope: of the merit function along it, without the penalty's part; gap: the sum of |r -
    s| over all rows, which the penalty multiplies.
    """

    multiplier: float
    primal: float
    dual: float
    slope: float
    gap: float


class ChainRows:
    """A point of a chain's barrier problem, a step from it, and a trial point along that step."""

    def __init__(self, chain: Chain) -> None:
        """Prepare; raises OptionError where nothing can be compiled."""
        self._chain = chain
        self._loops = cache.load_c_files(__package__, "rows.c", "banded.c")
        check_structure(self._loops, "Point", _Point)
        check_structure(self._loops, "Chain", _Chain)
        self._loops.merit.restype = ctypes.c_double
        size = chain.lower.size
        rows = chain.bounds[0].size
        lower, upper = chain.bounds
        # Rows that no free unknown changes are constants. They may break their bounds by rounding, and then
        # no interior point exists; without bounds they do no harm.
        still = ~chain.changeable_rows
        # Relaxed by BOUND_RELAXATION, so that bounds that meet have an interior, too.
        self.low = np.where(still | np.isinf(lower), -INFINITE_BOUND, lower - BOUND_RELAXATION)
        self.high = np.where(still | np.isinf(upper), INFINITE_BOUND, upper + BOUND_RELAXATION)
        # The lower half of a symmetric band: width + 1 numbers for each of the T n unknowns.
        links = chain.linking
        width = _width(chain)
        # Arrays with T (n + m) entries: links pull at constraints first, whose pulls then go on to x.
        own = links.shape[1]
        self._band = np.zeros((size, width + 1))
        self._value = np.zeros(rows)
        # Point, step and trial have the same layout, so that C can exchange point and trial.
        self._at, self._step, self._trial = ([np.zeros(size), *np.zeros((3, rows))] for _ in range(3))
        _, gradient, _, jacobian, _ = chain.frame_expansion(self.x, self.multipliers)
        self._arrays = [
            *(lower, upper, self.low, self.high, chain.free.astype(float)),
            *(links.indptr.astype(np.intc), links.indices.astype(np.intc), links.data, chain.offset, chain.weight),
            *(gradient, jacobian, np.zeros(own), self._value, self._band, np.zeros(own), *np.zeros((3, rows))),
        ]
        m = chain.frame.g.numel()
        sizes = (
            chain.frames,
            chain.unknowns,
            m,
            len(chain.offset),
            width,
            chain.has_nonlinear_links,
            chain.has_nonlinear_constraints,
        )
        points = (_Point(*map(_address, point)) for point in (self._at, self._step, self._trial))
        self._struct = _Chain(*sizes, *map(_address, self._arrays), *points)
        self._chain_in_c = ctypes.byref(self._struct)
        self._found = (ctypes.c_double * 6)()
        self._out = [ctypes.byref(self._found, 8 * i) for i in range(6)]

    @property
    def address(self) -> int:
        """Address of the struct Chain in C."""
        return ctypes.addressof(self._struct)

    def sync_swapped_points(self) -> None:
        """Exchange point and trial if C has done so: C accepts a trial by swapping pointers."""
        if self._struct.at.x != _address(self._at[0]):
            self._at, self._trial = self._trial, self._at

    @property
    def x(self) -> Array:
        """The point's x (T n,)."""
        return self._at[0]

    @property
    def multipliers(self) -> Array:
        """Multipliers of all rows at the point, positive at upper bounds."""
        # z_u - z_l: positive at upper bounds, CasADi's sign.
        return self._at[3] - self._at[2]

    def start(self, x: Array, barrier: float, push: float, multipliers: Array | None = None) -> None:
        """Put the point at x (T n,), with slacks at least push within their bounds where these leave room.

        barrier: mm^2. multipliers: of all rows, of a neighbouring chain's solution. Rows that these show to be
        active keep them, with the slacks that belong to them on the central path.
        """
        _, value = self._chain.evaluate(x)
        self._value[:] = value
        # At most a tenth of the room between two bounds, so that slacks of narrow rows stay inside.
        within = np.minimum(push, 0.1 * (self.high - self.low))
        slack = np.clip(value, self.low + within, self.high - within)
        if multipliers is not None:
            # z (distance) = mu on the central path. Where this distance is less than the push, the row was
            # active: the push would throw its multiplier away.
            away = barrier / np.maximum(np.abs(multipliers), CHAIN_MIN_DENOMINATOR)
            at_bound = np.where(multipliers < 0, self.low + away, self.high - away)
            slack = np.where(away < within, at_bound, slack)
        for array, values in zip(
            self._at, (x, slack, barrier / (slack - self.low), barrier / (self.high - slack)), strict=True
        ):
            array[:] = values

    def expand(self) -> tuple[Measures, Array]:
        """Return the point's measures, and the frames' Hessians (T, n, n) of the Lagrangian."""
        f, _, g, _, hessian = self._chain.frame_expansion(self.x, self.multipliers)
        self._f = f
        self._g = g
        # Also computes the objective's slope, which `newton` needs: a point must be expanded first.
        self._loops.assess(self._chain_in_c, f.ctypes, g.ctypes, *self._out)
        n = self._chain.unknowns
        return Measures(*self._found), hessian.reshape(-1, n, n)

    def newton(self, hessian: Array, barrier: float, damping: float) -> Step | None:
        """Return the Newton step for the barrier problem's KKT conditions at the point, which has been expanded.

        hessian (T, n, n): the frames' blocks. barrier: mm^2. damping: added to the diagonal. None where the matrix
        is not positive definite, so that the step may lead uphill.
        """
        barrier_in_c = ctypes.c_double(barrier)
        self._loops.assemble(self._chain_in_c, hessian.ctypes, barrier_in_c, ctypes.c_double(damping))
        # Cholesky's factorisation exists only for positive definite matrices: its failure is the test.
        if not self._loops.solve(self._chain_in_c):
            return None
        self._loops.complete(self._chain_in_c, barrier_in_c, *self._out[:5])
        return Step(*self._found[:5])

    def convex(self, hessian: Array) -> Array:
        """Return the frames' Hessians, hessian (T, n, n), with the absolute values of their eigenvalues."""
        frames, n, _ = hessian.shape
        found = np.empty_like(hessian)
        self._loops.convex(ctypes.c_long(frames), ctypes.c_long(n), hessian.ctypes, found.ctypes)
        return found

    def merit(self, barrier: float, penalty: float) -> float:
        """Return the l1 merit function of the barrier problem at the point, which has been expanded, in mm^2.

        barrier: mm^2. penalty: weight of the rows' differences from their slacks.
        """
        return self._merit(0, self._f, self._g, barrier, penalty)

    def advance(self, primal: float, dual: float, barrier: float, penalty: float) -> float:
        """Put the trial at parts of the step and return its merit function, mm^2.

        primal, dual: parts of the step for slacks and for multipliers. barrier, penalty: of the merit function.
        """
        self._loops.advance_trial(self._chain_in_c, ctypes.c_double(primal), ctypes.c_double(dual))
        f, g = self._chain.frame_values(self._trial[0])
        return self._merit(1, f, g, barrier, penalty)

    def _merit(self, of_trial: int, f: Array, g: Array, barrier: float, penalty: float) -> float:
        """Return the merit function of the point (0) or the trial (1), from the frames' values f and g there."""
        weights = ctypes.c_double(barrier), ctypes.c_double(penalty)
        return float(self._loops.merit(self._chain_in_c, of_trial, f.ctypes, g.ctypes, *weights))

    def accept(self) -> None:
        """Make the trial the point."""
        self._loops.accept_trial(self._chain_in_c)
        self._at, self._trial = self._trial, self._at


def _width(chain: Chain) -> int:
    """Return the half-width of the band: the largest distance of unknowns that share a frame or a link.

    A constraint may depend on its whole frame, and so may a link that passes through it.
    """
    links = chain.linking
    n = chain.unknowns
    size = chain.lower.size
    if not len(chain.offset):
        # Without links, frames do not meet at all.
        return n - 1
    constraint = links.indices >= size
    rows = links.indptr[:-1]
    first = np.where(constraint, (links.indices - size) // max(1, chain.frame.g.numel()) * n, links.indices)
    last = np.where(constraint, first + n - 1, first)
    return max(n - 1, int((np.maximum.reduceat(last, rows) - np.minimum.reduceat(first, rows)).max()))


def _address(array: Array) -> int:
    """Return the address of an array's first entry; C takes arrays as contiguous."""
    assert array.flags.c_contiguous
    return array.ctypes.data
