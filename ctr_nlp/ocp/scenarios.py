"""A motion that several robots make together: each frame's program once for every robot, with the motors shared.

    minimise  sum_j sum_s w_s f_j(phi_{s,j}, q_j; tubes_s) + links(q)
    subject to  alpha(phi_{s,j}, q_j; tubes_s) = alpha_j + offset_s   for every scenario s and frame j

with q_j = (alpha, beta, theta) in frame j, in rad and mm, tips phi_{s,j} of scenario s in rad, weights w_s that
sum to 1, and the frame's objective f_j (mm^2). These records only describe the program; ocp/shared builds them,
and solvers/scenarios solves it. See "Robust plans" in docs/method.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.expressions import FrameFunctions
from ctr_nlp.ocp.links import FrameLink
from ctr_nlp.ocp.nlp import Nlp
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES
from ctr_nlp.support.value_checks import frozen
from ctr_nlp.typing import Array, Index


@dataclass(frozen=True)
class Scenarios:
    """S robots whose motors move alike; the first is the nominal one, and the others are compared with it.

    numbers (S, d, 8): of the tubes, in the order of structure.TUBE_NUMBER_NAMES. offsets (S, d): of the motors'
    zeros, added to alpha, rad. weights (S,): how much each one's shape error counts, >= 0 and not all 0. forces
    (S, 3): at their tips, N, in the base's directions; none by default. Raises OptionError.
    """

    numbers: Array
    offsets: Array
    weights: Array
    forces: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        if not len(self.forces):
            # The dataclass is frozen; its own arrays may only be set this way.
            object.__setattr__(self, "forces", np.zeros((len(self.weights), 3)))
        for name in ("numbers", "offsets", "weights", "forces"):
            object.__setattr__(self, name, frozen(np.array(getattr(self, name), dtype=float)))
        count = len(self.weights)
        d = self.offsets.shape[-1]
        shapes = {
            "numbers": (count, d, len(TUBE_NUMBER_NAMES)),
            "offsets": (count, d),
            "weights": (count,),
            "forces": (count, 3),
        }
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape or not count or not np.isfinite(values).all():
                raise OptionError(f"{name} of scenarios have shape {values.shape}; give finite numbers {shape}")
        if self.weights.min() < 0 or self.weights.sum() <= 0:
            raise OptionError("weights of scenarios are not all >= 0, or all are 0; give weights >= 0")

    def __len__(self) -> int:
        return len(self.weights)

    def append_robots(self, numbers: Array, offsets: Array, forces: Array, weight: float = 0.0) -> Scenarios:
        """Return these robots followed by k others, whose errors count with a weight.

        numbers (k, d, 8), offsets (k, d) in rad, forces (k, 3) in N: of the others, as in Scenarios. With the
        default weight 0 they only have to stay stable and near the nominal robot's branch.
        """
        # A robot of weight 0 has no part in the mean error; only its constraints count.
        weights = np.full(len(offsets), weight)
        pairs = zip(self.arrays, (numbers, offsets, weights, forces), strict=True)
        return Scenarios(*(np.concatenate(pair) for pair in pairs))

    @property
    def has_tip_forces(self) -> bool:
        """Whether a force acts at the tip of any robot."""
        return bool(self.forces.any())

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """The four arrays, in the order of the fields."""
        return self.numbers, self.offsets, self.weights, self.forces

    def shrink_differences(self, part: float, since: int = 0) -> Scenarios:
        """Return robots with only a `part` of these robots' differences from the first, from number `since` on."""
        # Those before `since` are the design's, whose mean and covariance are those of the tolerances: they keep
        # their differences.
        parts = np.where(np.arange(len(self)) < since, 1.0, part)[:, None]
        numbers = self.numbers[0] + parts[..., None] * (self.numbers - self.numbers[0])
        offsets, forces = (of[0] + parts * (of - of[0]) for of in (self.offsets, self.forces))
        return replace(self, numbers=numbers, offsets=offsets, forces=forces)


@dataclass(frozen=True)
class ConstraintScenarios:
    """Robots that only have to stay stable: K of them in each of T frames, different ones in each frame.

    numbers (T, K, d, 8), offsets (T, K, d), forces (T, K, 3): units as in Scenarios.
    """

    numbers: Array
    offsets: Array
    forces: Array

    def at(self, picked: Index | list[int]) -> ConstraintScenarios:
        """Return the constraint scenarios of the frames `picked`."""
        return ConstraintScenarios(self.numbers[picked], self.offsets[picked], self.forces[picked])


@dataclass(frozen=True)
class CommonUnknowns:
    """Unknowns p (P,) that all frames and scenarios have in common, such as the numbers of designed tubes.

    program: over p. Its first rows are k further unknowns of a frame, of the first scenario; those of other
    scenarios are factors (S, k) times these. Its other rows and its objective concern p alone. parameters: of the
    program. lower, upper (P,): of p, equal where it is fixed.
    """

    program: Nlp
    factors: Array
    parameters: Array
    lower: Array
    upper: Array


@dataclass(frozen=True)
class ReducedProgram:
    """A program of a frame with fewer terms than the whole one, over the same unknowns and with the same rows.

    Attributes
    ----------
    functions : callable
        Returns its functions, compiled or not.
    columns : (n_p,) int
        Positions of its parameters among those of the whole program.
    """

    functions: Callable[[], FrameFunctions]
    columns: Index


def with_constraint_scenarios(of_scenarios: Array, of_guards: Array | None, frames: int) -> Array:
    """Return values (T, S + K, ..): those of scenarios in every frame, followed by those of constraint scenarios.

    of_scenarios (S, ..): the same in each of `frames` frames. of_guards (T, K, ..): of the constraint scenarios of
    each frame; None for none.
    """
    found = np.repeat(of_scenarios[None], frames, axis=0)
    return found if of_guards is None else np.concatenate([found, of_guards], axis=1)


def assemble_robot_unknowns(q: Array, phi: Array, shared_entries: Index) -> Array:
    """Return the unknowns (T, S, m) of robots with tips phi (T, S, k) at the shared q (T, n).

    shared_entries (n - d,): positions among a robot's m unknowns of beta and theta, the last n - d entries of q.
    """
    # Motors move the tubes of all robots alike, so that these share beta and theta. Alpha is no unknown of a
    # robot: it follows from the tips, and is compared with q's.
    frames, count, k = phi.shape
    found = np.empty((frames, count, k + len(shared_entries)))
    found[..., np.setdiff1d(np.arange(k + len(shared_entries)), shared_entries)] = phi
    found[..., shared_entries] = q[:, None, q.shape[1] - len(shared_entries) :]
    return found


@dataclass(frozen=True)
class SharedMotion:
    """Minimise the scenarios' mean shape error and the links' costs over q (T, n) and the tips (T, S, k).

    The S robots of a frame are the scenarios and, if there are any, its constraint scenarios, whose errors do not
    count. frame: the program of one robot in one frame, over its unknowns x (m,) and those given by common
    unknowns, which are then solved for, too. shared_entries (n - d,): the entries of x that are beta and theta,
    and equal to q's. The other k entries are each robot's own: d tip angles and, under a load, the turn of the
    tip's axes. The frame's first k rows are their equations: alpha is that of q plus the offsets, and under a load
    the base points where theta has it. parameters (T S, p): a row for every robot of every frame. lower, upper (T,
    n): of q, equal where it is fixed. max_tip_differences (S,): by how much a scenario's tips, relative to the
    innermost one, may differ from the first scenario's, rad. twist_steps (T,): rad by which the first's may turn
    beyond its motors between a frame and the one before; infinite where there is none.

    local_parameters: None, or a function of all robots' unknowns (T, S, m) that returns parameters (T, S, ..) by
    name that are valid near these only. without_wall: the program without the wall, for robots far from it;
    without_objective: the program without any objective, for robots whose errors do not count. None: the whole
    program is used.
    """

    frame: Nlp
    d: int
    shared_entries: Index
    scenarios: Scenarios
    parameters: Array
    lower: Array
    upper: Array
    links: tuple[FrameLink, ...]
    max_tip_differences: Array
    twist_steps: Array
    functions: Callable[[], FrameFunctions]
    local_parameters: Callable[[Array], Mapping[str, Array]] | None = None
    common: CommonUnknowns | None = None
    constraint_scenarios: ConstraintScenarios | None = None
    without_wall: ReducedProgram | None = None
    without_objective: ReducedProgram | None = None

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Frames T, robots S of each, entries n of q, and d."""
        return len(self.lower), len(self.max_tip_differences), self.lower.shape[1], self.d

    @cached_property
    def own(self) -> Index:
        """The entries (k,) of x that each robot has of its own."""
        given = 0 if self.common is None else self.common.factors.shape[1]
        return np.setdiff1d(np.arange(self.frame.x.numel() - given), self.shared_entries)

    @cached_property
    def weights(self) -> Array:
        """The share (S,) of every robot in the mean."""
        shares = self.scenarios.weights / self.scenarios.weights.sum()
        # Constraint scenarios come after the scenarios and have no part in the mean.
        return np.append(shares, np.zeros(len(self.max_tip_differences) - len(shares)))

    @cached_property
    def offsets(self) -> Array:
        """Offsets of the robots' motors, (T, S, d) rad."""
        of_guards = None if self.constraint_scenarios is None else self.constraint_scenarios.offsets
        return with_constraint_scenarios(self.scenarios.offsets, of_guards, len(self.lower))

    @cached_property
    def own_rows(self) -> Index:
        """Constraints of a frame that each scenario has of its own: those that depend on its tips."""
        # The first k rows are the equations, which are no constraints with bounds: solvers eliminate them.
        return np.flatnonzero(self.frame.g_depends[:, self.own].any(axis=1))[len(self.own) :]

    @cached_property
    def common_rows(self) -> Index:
        """Constraints of a frame that depend on the shared q alone and so are the same for all robots."""
        # One copy suffices: a row that no tip enters has the same value for every robot.
        return np.flatnonzero(~self.frame.g_depends[:, self.own].any(axis=1))

    @cached_property
    def row_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (T, m) of a frame's rows.

        First each scenario's own rows, scenario by scenario; then how far its tips, relative to the innermost one,
        are from the first scenario's, d - 1 each; then the common rows.
        """
        bounds = list[Array]()
        for bound, side in zip(
            self.frame.g_bounds, (-self.max_tip_differences, self.max_tip_differences), strict=True
        ):
            _, count, _, d = self.sizes
            tips = np.repeat(side[1:], d - 1)
            parts = [np.tile(bound[self.own_rows], count), tips, bound[self.common_rows]]
            bounds.append(np.tile(np.concatenate(parts), (len(self.lower), 1)))
        return bounds[0], bounds[1]

    def by_robot(self, rows: Array) -> Array:
        """Return sums (T, S) of values over the rows that each robot has of its own, or together with the first.

        rows (T, m): these values.
        """
        frames, count, _, d = self.sizes
        size = count * len(self.own_rows)
        found = rows[:, :size].reshape(frames, count, -1).sum(axis=2)
        found[:, 1:] += rows[:, size : size + (count - 1) * (d - 1)].reshape(frames, count - 1, d - 1).sum(axis=2)
        return np.asarray(found)

    def unknowns(self, q: Array, phi: Array, given: Array) -> Array:
        """Return unknowns (T, S, m + g) of every robot in every frame, at q (T, n) and tips phi (T, S, k).

        given (S, g): values that common unknowns give every scenario.
        """
        of_given = np.broadcast_to(given, (len(q), *given.shape))
        return np.concatenate([assemble_robot_unknowns(q, phi, self.shared_entries), of_given], axis=2)

    @cached_property
    def linking(self) -> sp.csr_array:
        """The matrices of all links over q, (l, T n)."""
        return sp.csr_array(sp.vstack([link.matrix for link in self.links]))

    def of_links(self, name: str) -> Array:
        """Return the field `name` of all links, one after the other, (l,): offset, weight, lower or upper."""
        return np.concatenate([getattr(link, name) for link in self.links])
