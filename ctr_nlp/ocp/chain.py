"""All frames of a motion in one nonlinear program: a frame's Nlp repeated, coupled by linear differences.

    minimise  sum_j f_j(x_j) + sum_k w_k (A q + b)_k^2     subject to bounds of x_j, g_j(x_j) and A q + b

with x_j the unknowns and q_j the configuration in frame j, which is picked from x_j and g_j. The second sum is the
motion term of eq. (9), the rows A q + b are speeds and accelerations (links.py). Units are mm and rad, the
objective is in mm^2.

Derivatives of frames are block-diagonal; only links couple frames. So everything here keeps frames as rows of
arrays (T, ..) and treats links as one sparse matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse as sp

from ctr_nlp.codegen.batch_evaluator import BatchEvaluator
from ctr_nlp.ocp.expressions import FrameFunctions
from ctr_nlp.ocp.links import FrameLink
from ctr_nlp.ocp.nlp import Nlp, Residual
from ctr_nlp.typing import Array, Flags, Index

OF_ROWS = (
    "linking",
    "_linking_transpose",
    "_configuration_rows",
    "has_nonlinear_links",
    "has_nonlinear_constraints",
    "offset",
    "bounds",
    "free",
    "changeable_rows",
    "_row_frames",
)
"""Properties that depend on a chain's rows alone, shared by chains with the same rows."""


class Slopes(NamedTuple):
    """First derivatives of a chain at a point.

    objective: mm^2; gradient: (T n,); value: of all rows; jacobian (T, m, n): of the frames' constraints.
    """

    objective: float
    gradient: Array
    value: Array
    jacobian: Array


class _Evaluators:
    """Value, slopes and expansion of all frames, for parameters (p, T).

    Evaluators are rebuilt when `functions` returns others.
    """

    def __init__(self, functions: Callable[[], FrameFunctions], parameters: Array) -> None:
        self._functions = functions
        self._parameters = parameters
        self._of: FrameFunctions | None = None
        self._mapped = dict[int, BatchEvaluator]()

    def __call__(self, which: int) -> BatchEvaluator:
        """Return the evaluator number `which` of value, slopes and expansion, of the functions as they are now."""
        # Functions change when compiled ones, made in the background, take the place of interpreted ones.
        found = self._functions()
        if found is not self._of:
            self._of = found
            self._mapped = {}
        if which not in self._mapped:
            mapped = BatchEvaluator(found[:3][which], self._parameters.shape[1])
            mapped.inputs[1][:] = self._parameters.T
            self._mapped[which] = mapped
        return self._mapped[which]


class Excess(NamedTuple):
    """A row that violates its bounds: its name, the frame (from 1) and by how much, in units of the row."""

    name: str
    frame: int
    amount: float


@dataclass(frozen=True)
class Chain:
    """Minimise the sum of all frames' objectives and of all links' costs, within bounds, constraints and links.

    frame: the Nlp of every frame, with n unknowns x and m constraint values g, from which it picks a configuration
    q of k entries. axes: names of these; scale (k,): mm that a unit of each counts as. parameters (p, T): packed,
    a column a frame. lower, upper (T, n): bounds of x, equal where an unknown is fixed. functions: returns the
    frame's functions, interpreted or, as soon as they are ready, compiled. local_parameters: None, or a function
    of the robot's unknowns (T, n - slacks) that returns parameters (T, ..) by name that are valid near these only,
    and the slacks (T,) needed there. constraint_bounds: lower and upper bounds (T, m) of the frames' constraints;
    None for the frame's own.

    x is (T n,), frame by frame. Rows are, in this order: x itself; the frames' constraints, frame by frame; the
    links, one after the other.
    """

    frame: Nlp
    axes: tuple[str, ...]
    scale: Array
    parameters: Array
    lower: Array
    upper: Array
    links: tuple[FrameLink, ...]
    functions: Callable[[], FrameFunctions]
    local_parameters: Callable[[Array], tuple[Mapping[str, Array], Array]] | None = None
    constraint_bounds: tuple[Array, Array] | None = None

    @property
    def frames(self) -> int:
        """T, the number of frames."""
        return self.parameters.shape[1]

    @property
    def unknowns(self) -> int:
        """n, the number of unknowns of one frame."""
        return self.frame.x.numel()

    def robot_of(self, x: Array) -> Array:
        """Return the robot's unknowns (T, n - slacks) of x (T n,)."""
        return x.reshape(self.frames, -1)[:, : self.unknowns - self.frame.slacks]

    def linearise_at(self, motion: Array) -> tuple[Chain, Array]:
        """Return the chain linearised near a motion, and that motion as x (T n,).

        motion: (T, n - slacks), or its entries in one row. Slacks get the values needed there.
        """
        unknowns = motion.reshape(self.frames, -1)
        if self.local_parameters is None:
            return self, np.pad(unknowns, ((0, 0), (0, self.frame.slacks))).ravel()
        values, slack = self.local_parameters(unknowns)
        return self.with_parameters(values), np.column_stack([unknowns, slack]).ravel()

    def with_parameters(self, values: Mapping[str, Array]) -> Chain:
        """Return a chain with other values (T, ..) of some parameters, by name, and the rest unchanged."""
        parameters = self.parameters.copy()
        for name, value in values.items():
            # A parameter is packed column by column (Nlp.pack), a column of `parameters` a frame.
            columns = [each.ravel(order="F") for each in np.asarray(value)]
            parameters[self.frame.parameter_slice(name)] = np.transpose(columns)
        return self._with(parameters=parameters)

    def with_cost(self, factor: float) -> Chain:
        """Return a chain whose links cost `factor` times as much."""
        return self._with(links=tuple(replace(link, weight=link.weight * factor) for link in self.links))

    def _with(self, **changes: Any) -> Chain:
        """Return a chain with other parameters, costs or functions, none of which the rows depend on."""
        found = replace(self, **changes)
        # dataclasses.replace drops cached properties; those of the rows are still valid and are taken over.
        vars(found).update({name: getattr(self, name) for name in OF_ROWS})
        return found

    def nearest(self, x: Array) -> Chain:
        """Return the chain that finds the point nearest to x (T n,), in mm, among those within all bounds.

        Distances are |scale (x - to)|^2 with the unknown number i scaled as axis number i, of which there must be
        as many.
        """
        own = self.frame
        to = ca.SX.sym("to", self.unknowns)
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
        # `to` is the last parameter, so its values are rows after all others.
        parameters = np.vstack([self.parameters, x.reshape(self.frames, self.unknowns).T])
        return replace(self.with_cost(0.0), frame=frame, parameters=parameters, functions=lambda: frame.functions)

    @cached_property
    def difference(self) -> sp.csr_array:
        """The matrices of all links over q, (l, T k)."""
        return sp.csr_array(sp.vstack([link.matrix for link in self.links]))

    @cached_property
    def linking(self) -> sp.csr_array:
        """The matrices of all links over the frames' rows, (l, T (n + m)): all x, and then all g."""
        over_q = self.difference
        rows = self.frames * (self.unknowns + self.frame.g.numel())
        # Renaming columns moves the matrix from q to the rows from which q is picked. Two entries may meet
        # in one column; then they are summed.
        entries = over_q.data, self._configuration_rows[over_q.indices], over_q.indptr
        found = sp.csr_array(entries, shape=(len(self.offset), rows), copy=True)
        found.sum_duplicates()
        return found

    @cached_property
    def _configuration_rows(self) -> Index:
        """The rows that the entries of q are picked from, (T k,)."""
        picks = self.frame.configuration
        n = self.unknowns
        m = self.frame.g.numel()
        frame = np.arange(self.frames)[:, None]
        # A pick below n is an entry of x, one from n on a constraint; constraints of all frames come after
        # all x.
        return np.where(picks < n, frame * n + picks, self.lower.size + frame * m + picks - n).ravel()

    @cached_property
    def has_nonlinear_links(self) -> bool:
        """Whether links pass through constraints, and so need not be linear in x."""
        return bool(self.linking.indices.max(initial=0) >= self.lower.size)

    @cached_property
    def has_nonlinear_constraints(self) -> bool:
        """Whether any constraint of a frame is nonlinear."""
        return bool(self.frame.g_nonlinear.any())

    @cached_property
    def _linking_transpose(self) -> sp.csr_array:
        return sp.csr_array(self.linking.T)

    def _concatenate_links(self, pick: Callable[[FrameLink], Array]) -> Array:
        """Return the values that `pick` takes from each link, in one row."""
        return np.concatenate([pick(link) for link in self.links])

    def _rows(self, x: Array, g: Array) -> tuple[Array, Array]:
        """Return values of all rows where the frames' constraints are g (T, m), and of the links alone."""
        own = np.concatenate([x, g.ravel()])
        linked = self.linking @ own + self.offset
        return np.concatenate([own, linked]), linked

    @cached_property
    def offset(self) -> Array:
        """Constants b of all links A q + b, (l,)."""
        return self._concatenate_links(lambda link: link.offset)

    @cached_property
    def weight(self) -> Array:
        """Weights of the links' squares in the objective, (l,), mm^2 per squared unit of a row."""
        return self._concatenate_links(lambda link: link.weight)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all rows."""
        low, high = self.constraint_bounds or (np.tile(bound, (self.frames, 1)) for bound in self.frame.g_bounds)
        return (
            np.concatenate([self.lower.ravel(), low.ravel(), self._concatenate_links(lambda link: link.lower)]),
            np.concatenate([self.upper.ravel(), high.ravel(), self._concatenate_links(lambda link: link.upper)]),
        )

    def with_fixed_functions(self) -> Chain:
        """Return a copy with the functions fixed to those available now.

        For callers that keep the arrays that these write.
        """
        now = self.functions()
        return self._with(functions=lambda: now)

    def evaluators(self) -> list[BatchEvaluator]:
        """Return the evaluators of values and of expansions of all frames, with the functions available now."""
        return [self._evaluators(0), self._evaluators(2)]

    @cached_property
    def _evaluators(self) -> _Evaluators:
        return _Evaluators(self.functions, self.parameters)

    def frame_values(self, x: Array) -> list[Array]:
        """Return objectives (T, 1) and constraints (T, m) of the frames at x; the next call overwrites them."""
        return self._evaluators(0)(x)

    def frame_expansion(self, x: Array, multipliers: Array) -> list[Array]:
        """Return second-order expansions of the frames at x; the next call overwrites them.

        multipliers: of all rows. Returns objectives (T, 1), gradients (T, n), constraints (T, m), their Jacobians
        (T, n m) by columns, and Hessians (T, n n) of the Lagrangian. B' diag(2 weight) B is left out, with B the
        links' Jacobian: it has entries between frames.
        """
        end = x.size + self.frames * self.frame.g.numel()
        of_frames = multipliers[x.size : end]
        # A link A q(g(x)) + b bends with g: its multiplier and its cost's slope 2 w (A q + b) act on the
        # curvature of g like multipliers of g, so they are added to these.
        if self.has_nonlinear_links:
            _, linked = self._rows(x, self.frame_values(x)[1])
            of_frames = (
                of_frames + (self._linking_transpose @ (multipliers[end:] + 2 * self.weight * linked))[x.size :]
            )
        return self._evaluators(2)(x, np.ones(self.frames), of_frames)

    def evaluate(self, x: Array) -> tuple[float, Array]:
        """Return the objective in mm^2 and the rows' values at x."""
        f, g = self.frame_values(x)
        value, linked = self._rows(x, g)
        return float(f.sum() + self.weight @ linked**2), value

    def configurations(self, value: Array) -> Array:
        """Return the configurations q of the frames, (T, k), from the values of all rows (value)."""
        return value[self._configuration_rows].reshape(self.frames, -1)

    def by_frame(self, x: Array) -> tuple[Array, Array]:
        """Return each frame's contributions to the objective at x (T n,): its own, and those of links that end
        there.

        Both are (T,) mm^2.
        """
        f, g = self.frame_values(x)
        cost = np.zeros(self.frames)
        frame = np.concatenate([link.frame for link in self.links])
        # Several links may end at one frame: np.add.at adds all of them, cost[frame] += would keep one.
        np.add.at(cost, frame, self.weight * self._rows(x, g)[1] ** 2)
        return f.ravel().copy(), cost

    def slopes(self, x: Array) -> Slopes:
        """Return first derivatives at x."""
        f, gradient, g, columns = self._evaluators(1)(x)
        value, linked = self._rows(x, g)
        # CasADi stores matrices by columns: (T, n m) is read as (T, n, m) and transposed to (T, m, n).
        jacobian = columns.reshape(self.frames, self.unknowns, -1).transpose(0, 2, 1).copy()
        # Gradient of the links' costs: the transposed Jacobian times 2 w (A q + b), which is no
        # constraint's multiplier but enters in the same place.
        pulls = np.concatenate([np.zeros(x.size + g.size), 2 * self.weight * linked])
        gradient = gradient.ravel() + self.multiply_transposed_jacobian(jacobian, pulls)
        return Slopes(float(f.sum() + self.weight @ linked**2), gradient, value, jacobian)

    def multiply_transposed_jacobian(self, jacobian: Array, rows: Array) -> Array:
        """Return the transposed Jacobian of all rows times a vector over the rows (rows), (T n,).

        jacobian (T, m, n): of the frames' constraints over their unknowns.
        """
        frames, m, n = jacobian.shape
        # Links reach x directly or through g: first A' to both, then g's part through the frames'
        # Jacobians.
        of_x, of_g, of_links = np.split(rows, [frames * n, frames * (n + m)])
        through_x, through_g = np.split(self._linking_transpose @ of_links, [frames * n])
        product = ((of_g + through_g).reshape(frames, 1, m) @ jacobian).ravel()
        return of_x + product + through_x

    def violation(self, value: Array) -> float:
        """Return the largest violation of a bound by the rows' values (value).

        Negative where all are strictly inside.
        """
        low, high = self.bounds
        return float(np.maximum(low - value, value - high).max())

    def excesses(self, value: Array, tolerance: float) -> list[Excess]:
        """Return the rows whose values (value) violate their bounds by more than tolerance, worst first."""
        low, high = self.bounds
        # NaN counts as infinite: a row that could not be evaluated is the worst of all.
        amount = np.nan_to_num(np.maximum(low - value, value - high), nan=np.inf)
        worst = [int(i) for i in np.argsort(-amount) if amount[i] > tolerance]
        return [Excess(*self.describe_row(row), float(amount[row])) for row in worst]

    def describe_row(self, row: int) -> tuple[str, int]:
        """Return the name of the quantity that a row limits, and the frame it belongs to, from 1."""
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
        """Names of a frame's rows, of x and then of g; a row that is picked for q is named after its axis."""
        names = [f"limits of {self.frame.x[i]}" for i in range(self.unknowns)]
        names += [c.name for c in self.frame.constraints for _ in range(c.value.numel())]
        for axis, pick in zip(self.axes, self.frame.configuration, strict=True):
            names[pick] = f"limits of {axis}"
        return names

    def kkt(self, x: Array, multipliers: Array) -> Array:
        """Return how far each frame is from a KKT point, (T,), computed from the problem alone.

        It is the largest of stationarity (mm^2 per unit of x), infeasibility (units of a row) and complementarity
        (mm^2), whatever a solver reports. x (T n,); multipliers: of all rows, positive at upper bounds.
        """
        at = self.slopes(x)
        # A fixed unknown may have any slope: its bounds, which meet, can take any multiplier.
        slope = np.where(self.free, at.gradient + self.multiply_transposed_jacobian(at.jacobian, multipliers), 0.0)
        low, high = self.bounds
        outside = np.maximum(np.maximum(low - at.value, at.value - high), 0.0)
        # As in nlp.kkt_residual: the multiplier's sign names the bound, and an infinite one must have none.
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
    def changeable_rows(self) -> Flags:
        """Whether any free unknown changes a row; solvers leave the other rows alone."""
        # A product of booleans is an `or` of `and`s: a constraint is reached if any x that it depends on is
        # free. A row that only fixed unknowns enter is a constant: no solver can mend what it misses by
        # rounding.
        of_frames = (self.free.reshape(self.frames, -1) @ self.frame.g_depends.T).ravel()
        own = np.concatenate([self.free, of_frames])
        return np.concatenate([own, abs(self.linking) @ own]) > 0

    @cached_property
    def _row_frames(self) -> Index:
        """The frame of every row, from 0."""
        own = [np.repeat(np.arange(self.frames), count) for count in (self.unknowns, self.frame.g.numel())]
        return np.concatenate([*own, *(link.frame for link in self.links)])
