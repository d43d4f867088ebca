"""All frames of a motion in one nonlinear program: a frame's Nlp once a frame, linked by linear differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse as sp

from ctr_nlp.codegen.mapped import Mapped
from ctr_nlp.nlp.links import Link
from ctr_nlp.nlp.nlp import Nlp, Residual
from ctr_nlp.nlp.written import FrameFunctions
from ctr_nlp.typing import Array, Flags, Index

OF_ROWS = (
    "linking",
    "_transposed",
    "_picked",
    "bent",
    "curved",
    "offset",
    "bounds",
    "free",
    "reached",
    "_row_frames",
)
"""What is known of a chain's rows, and shared by all chains that have the same."""


class Slopes(NamedTuple):
    """A chain about a point: objective mm^2, its gradient (T n,), the rows' values; jacobian (T, m, n) of the
    frames' constraints.
    """

    objective: float
    gradient: Array
    value: Array
    jacobian: Array


class _Evaluators:
    """Value, slopes and expansion of all frames, for parameters (p, T); anew where other functions are given."""

    def __init__(self, functions: Callable[[], FrameFunctions], parameters: Array) -> None:
        self._functions, self._parameters = functions, parameters
        self._of: FrameFunctions | None = None
        self._mapped = dict[int, Mapped]()

    def __call__(self, which: int) -> Mapped:
        """One of the three, counted from 0, as given now."""
        found = self._functions()
        if found is not self._of:
            self._of, self._mapped = found, {}
        if which not in self._mapped:
            mapped = Mapped(found[:3][which], self._parameters.shape[1])
            mapped.inputs[1][:] = self._parameters.T
            self._mapped[which] = mapped
        return self._mapped[which]


class Excess(NamedTuple):
    """By how much a point leaves what is allowed: amount in units of the row, frame from 1."""

    name: str
    frame: int
    amount: float


@dataclass(frozen=True)
class Chain:
    """Minimise the sum of all frames' objectives and of all links' costs, within bounds, constraints and links.

    frame: the Nlp of every frame, with n unknowns x and m constraint values g, from which it picks a configuration
    q of k entries. axes: names of these; scale (k,): what a unit of each counts as, mm.
    parameters (p, T): packed, a column a frame. lower, upper (T, n): equal where an unknown is fixed.
    functions: gives the frame's, as symbols or, once they are, compiled. surroundings: where some parameters hold
    near a motion only, these (T, ..), by name, of the robot's unknowns (T, n - slacks), and the slacks (T,) that
    they need there. held: lower and upper bounds (T, m) of the frames' constraints; None for the frame's own.

    x is (T n,), frame by frame. Rows are, in this order: x itself; the frames' constraints, frame by frame;
    the links, one after the other.
    """

    frame: Nlp
    axes: tuple[str, ...]
    scale: Array
    parameters: Array
    lower: Array
    upper: Array
    links: tuple[Link, ...]
    functions: Callable[[], FrameFunctions]
    surroundings: Callable[[Array], tuple[Mapping[str, Array], Array]] | None = None
    held: tuple[Array, Array] | None = None

    @property
    def frames(self) -> int:
        """T, the number of frames."""
        return self.parameters.shape[1]

    @property
    def unknowns(self) -> int:
        """n, of one frame."""
        return self.frame.x.numel()

    def robot_of(self, x: Array) -> Array:
        """The robot's unknowns (T, n - slacks) of x (T n,)."""
        return x.reshape(self.frames, -1)[:, : self.unknowns - self.frame.slacks]

    def around(self, motion: Array) -> tuple[Chain, Array]:
        """The chain near to a motion, (T, n - slacks) or its entries in one row, and that motion as x (T n,)."""
        unknowns = motion.reshape(self.frames, -1)
        if self.surroundings is None:
            return self, np.pad(unknowns, ((0, 0), (0, self.frame.slacks))).ravel()
        values, slack = self.surroundings(unknowns)
        return self.with_parameters(values), np.column_stack([unknowns, slack]).ravel()

    def with_parameters(self, values: Mapping[str, Array]) -> Chain:
        """The same chain with other values (T, ..) of some parameters."""
        parameters = self.parameters.copy()
        for name, value in values.items():
            columns = [each.ravel(order="F") for each in np.asarray(value)]
            parameters[self.frame.place(name)] = np.transpose(columns)
        return self._with(parameters=parameters)

    def with_cost(self, factor: float) -> Chain:
        """The same chain with the links' costs times a factor."""
        return self._with(links=tuple(replace(link, weight=link.weight * factor) for link in self.links))

    def _with(self, **changes: Any) -> Chain:
        """The same chain with other parameters, costs or functions, which have no part in its rows."""
        found = replace(self, **changes)
        vars(found).update({name: getattr(self, name) for name in OF_ROWS})
        return found

    def nearest(self, x: Array) -> Chain:
        """The chain that finds the point nearest to x (T n,), in mm, among those within all bounds.

        An unknown counts as the axis of the same number, of which there must be as many.
        """
        own, to = self.frame, ca.SX.sym("to", self.unknowns)
        frame = Nlp(
            "nearest",
            own.x,
            own.lower,
            own.upper,
            {**own.parameters, "to": to},
            (Residual("nearest", ca.DM(self.scale[: self.unknowns]) * (own.x - to)),),
            constraints=own.constraints,
            inner=own.inner,
            picks=own.picks,
        )
        parameters = np.vstack([self.parameters, x.reshape(self.frames, self.unknowns).T])
        return replace(self.with_cost(0.0), frame=frame, parameters=parameters, functions=lambda: frame.functions)

    @cached_property
    def difference(self) -> sp.csr_array:
        """The matrices of all links over q, (l, T k)."""
        return sp.csr_array(sp.vstack([link.matrix for link in self.links]))

    @cached_property
    def linking(self) -> sp.csr_array:
        """The matrices of all links over the frames' rows, (l, T (n + m)): all x, and then all g."""
        over_q, rows = self.difference, self.frames * (self.unknowns + self.frame.g.numel())
        entries = over_q.data, self._picked[over_q.indices], over_q.indptr
        found = sp.csr_array(entries, shape=(len(self.offset), rows), copy=True)
        found.sum_duplicates()
        return found

    @cached_property
    def _picked(self) -> Index:
        """The rows that q's entries are, (T k,)."""
        picks, n, m = self.frame.configuration, self.unknowns, self.frame.g.numel()
        frame = np.arange(self.frames)[:, None]
        return np.where(picks < n, frame * n + picks, self.lower.size + frame * m + picks - n).ravel()

    @cached_property
    def bent(self) -> bool:
        """Whether links pass through constraints, so that they need not be linear in x."""
        return bool(self.linking.indices.max(initial=0) >= self.lower.size)

    @cached_property
    def curved(self) -> bool:
        """Whether constraints of frames are not linear."""
        return bool(self.frame.g_nonlinear.any())

    @cached_property
    def _transposed(self) -> sp.csr_array:
        return sp.csr_array(self.linking.T)

    def _linked(self, pick: Callable[[Link], Array]) -> Array:
        return np.concatenate([pick(link) for link in self.links])

    def _rows(self, x: Array, g: Array) -> tuple[Array, Array]:
        """Values of all rows where the frames' constraints are g (T, m), and of the links alone."""
        own = np.concatenate([x, g.ravel()])
        linked = self.linking @ own + self.offset
        return np.concatenate([own, linked]), linked

    @cached_property
    def offset(self) -> Array:
        """Of all links, (l,)."""
        return self._linked(lambda link: link.offset)

    @cached_property
    def weight(self) -> Array:
        """Of all links, (l,), mm^2 per squared unit of a row."""
        return self._linked(lambda link: link.weight)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all rows."""
        low, high = self.held or (np.tile(bound, (self.frames, 1)) for bound in self.frame.g_bounds)
        return (
            np.concatenate([self.lower.ravel(), low.ravel(), self._linked(lambda link: link.lower)]),
            np.concatenate([self.upper.ravel(), high.ravel(), self._linked(lambda link: link.upper)]),
        )

    def as_given_now(self) -> Chain:
        """The same, with the functions that are given now: for whoever holds on to arrays that these write."""
        now = self.functions()
        return self._with(functions=lambda: now)

    def evaluators(self) -> list[Mapped]:
        """What evaluates values, and expansions, of all frames now."""
        return [self._evaluators(0), self._evaluators(2)]

    @cached_property
    def _evaluators(self) -> _Evaluators:
        return _Evaluators(self.functions, self.parameters)

    def frame_values(self, x: Array) -> list[Array]:
        """Objectives (T, 1) and constraints (T, m) of the frames at x; the next call overwrites them."""
        return self._evaluators(0)(x)

    def frame_expansion(self, x: Array, multipliers: Array) -> list[Array]:
        """Second-order expansions of the frames at x; the next call overwrites them.

        multipliers: of all rows. Objectives (T, 1), gradients (T, n), constraints (T, m), their Jacobians (T, n m)
        by columns, and Hessians (T, n n) of the Lagrangian. B' diag(2 weight) B is left out, with B the links'
        Jacobian: it has entries between frames.
        """
        end = x.size + self.frames * self.frame.g.numel()
        of_frames = multipliers[x.size : end]
        if self.bent:
            _, linked = self._rows(x, self.frame_values(x)[1])
            of_frames = of_frames + (self._transposed @ (multipliers[end:] + 2 * self.weight * linked))[x.size :]
        return self._evaluators(2)(x, np.ones(self.frames), of_frames)

    def evaluate(self, x: Array) -> tuple[float, Array]:
        """The objective in mm^2 and the rows' values at x."""
        f, g = self.frame_values(x)
        value, linked = self._rows(x, g)
        return float(f.sum() + self.weight @ linked**2), value

    def configurations(self, value: Array) -> Array:
        """The frames' q, (T, k), from values of all rows."""
        return value[self._picked].reshape(self.frames, -1)

    def by_frame(self, x: Array) -> tuple[Array, Array]:
        """What each frame adds to the objective, (T,) mm^2: by itself, and by the links that end at it."""
        f, g = self.frame_values(x)
        cost = np.zeros(self.frames)
        frame = np.concatenate([link.frame for link in self.links])
        np.add.at(cost, frame, self.weight * self._rows(x, g)[1] ** 2)
        return f.ravel().copy(), cost

    def slopes(self, x: Array) -> Slopes:
        """First derivatives at x."""
        f, gradient, g, columns = self._evaluators(1)(x)
        value, linked = self._rows(x, g)
        jacobian = columns.reshape(self.frames, self.unknowns, -1).transpose(0, 2, 1).copy()
        pulls = np.concatenate([np.zeros(x.size + g.size), 2 * self.weight * linked])
        gradient = gradient.ravel() + self.transposed(jacobian, pulls)
        return Slopes(float(f.sum() + self.weight @ linked**2), gradient, value, jacobian)

    def transposed(self, jacobian: Array, rows: Array) -> Array:
        """The transposed Jacobian of all rows times rows, (T n,)."""
        frames, m, n = jacobian.shape
        of_x, of_g, of_links = np.split(rows, [frames * n, frames * (n + m)])
        through_x, through_g = np.split(self._transposed @ of_links, [frames * n])
        product = ((of_g + through_g).reshape(frames, 1, m) @ jacobian).ravel()
        return of_x + product + through_x

    def violation(self, value: Array) -> float:
        """By how much rows leave their bounds at most."""
        low, high = self.bounds
        return float(np.maximum(low - value, value - high).max())

    def excesses(self, value: Array, tolerance: float) -> list[Excess]:
        """The rows that leave their bounds by more than tolerance, worst first."""
        low, high = self.bounds
        amount = np.nan_to_num(np.maximum(low - value, value - high), nan=np.inf)
        worst = [int(i) for i in np.argsort(-amount) if amount[i] > tolerance]
        return [Excess(*self.place(row), float(amount[row])) for row in worst]

    def place(self, row: int) -> tuple[str, int]:
        """What a row limits and in which frame, from 1."""
        own = self._own_names
        for names in (own[: self.unknowns], own[self.unknowns :]):
            if row < self.frames * len(names):
                return names[row % len(names)], row // len(names) + 1
            row -= self.frames * len(names)
        for link in self.links:
            if row < len(link.offset):
                return f"{link.name} of {self.axes[link.axis[row]]}", int(link.frame[row]) + 1
            row -= len(link.offset)
        raise IndexError(row)

    @cached_property
    def _own_names(self) -> list[str]:
        """What the rows of a frame limit, of x and then of g; axes where these are picked."""
        names = [f"limits of {self.frame.x[i]}" for i in range(self.unknowns)]
        names += [c.name for c in self.frame.constraints for _ in range(c.value.numel())]
        for axis, pick in zip(self.axes, self.frame.configuration, strict=True):
            names[pick] = f"limits of {axis}"
        return names

    def kkt(self, x: Array, multipliers: Array) -> Array:
        """How far each frame is from a KKT point, (T,), from the problem alone and not from what a solver says.

        The largest of its stationarity (mm^2 per unit of x), infeasibility (units of a row) and complementarity
        (mm^2). multipliers: of all rows, positive at upper bounds.
        """
        at = self.slopes(x)
        slope = np.where(self.free, at.gradient + self.transposed(at.jacobian, multipliers), 0.0)
        low, high = self.bounds
        outside = np.maximum(np.maximum(low - at.value, at.value - high), 0.0)
        to_bound = np.abs(np.where(multipliers > 0, high, low) - at.value)
        slack = np.abs(multipliers) * np.where(np.isfinite(to_bound), to_bound, 1.0)
        found = np.abs(slope).reshape(self.frames, -1).max(axis=1)
        np.maximum.at(found, self._row_frames, np.maximum(outside, slack))
        return found

    @cached_property
    def free(self) -> Flags:
        """Which entries of x (T n,) are not fixed."""
        return (self.lower < self.upper).ravel()

    @cached_property
    def reached(self) -> Flags:
        """Which rows some free unknown changes; solvers leave the others alone."""
        of_frames = (self.free.reshape(self.frames, -1) @ self.frame.g_depends.T).ravel()
        own = np.concatenate([self.free, of_frames])
        return np.concatenate([own, abs(self.linking) @ own]) > 0

    @cached_property
    def _row_frames(self) -> Index:
        """The frame of every row, from 0."""
        own = [np.repeat(np.arange(self.frames), count) for count in (self.unknowns, self.frame.g.numel())]
        return np.concatenate([*own, *(link.frame for link in self.links)])
