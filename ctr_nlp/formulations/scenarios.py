"""Scenarios: robots of slightly other tubes that make the same motion, planned for together.

alpha, beta and theta of every frame belong to all of S robots, and each has tips phi of its own, which its motors'
angles and their offsets determine: alpha(phi_s, beta; tubes_s) = alpha + offset_s. What is minimised is the
weighted mean of their shape errors and the motion (9); each keeps a stability margin, and tips near the first's,
so that all are on one branch of a fork, which the margin does not see.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.frame import filled, packed, program
from ctr_nlp.formulations.horizon import Ends, interpreted, motion_links
from ctr_nlp.formulations.joint import terms_of
from ctr_nlp.formulations.terms import Term
from ctr_nlp.models import Model
from ctr_nlp.nlp.links import Link
from ctr_nlp.nlp.nlp import FrameFunctions, Nlp
from ctr_nlp.robot import Robot
from ctr_nlp.support.values import frozen
from ctr_nlp.target.target import Frame
from ctr_nlp.typing import Array, Index

APART = 0.7
"""rad by which a scenario's tips, relative to the innermost one, may differ from the first scenario's."""
MARGIN = 0.1
"""Least stability margin of every scenario."""


@dataclass(frozen=True)
class Scenarios:
    """S robots that are moved alike; the first is the one as described, and others are compared with it.

    numbers (S, d, 6): of the tubes, in the order of structure.NUMBERS. offsets (S, d): of the motors' zeros, added
    to alpha, rad. weights (S,): how much each one's shape error counts, >= 0 and not all 0. Raises OptionError.
    """

    numbers: Array
    offsets: Array
    weights: Array

    def __post_init__(self) -> None:
        for name in ("numbers", "offsets", "weights"):
            object.__setattr__(self, name, frozen(np.array(getattr(self, name), dtype=float)))
        count, d = len(self.weights), self.offsets.shape[-1]
        for name, shape in (("numbers", (count, d, 6)), ("offsets", (count, d)), ("weights", (count,))):
            values = getattr(self, name)
            if values.shape != shape or not count or not np.isfinite(values).all():
                raise OptionError(f"{name} of scenarios have shape {values.shape}; give finite numbers {shape}")
        if self.weights.min() < 0 or self.weights.sum() <= 0:
            raise OptionError("weights of scenarios are not all >= 0, or all are 0; give weights >= 0")

    def __len__(self) -> int:
        return len(self.weights)

    def joined(self, other: Scenarios) -> Scenarios:
        """These and then others."""
        pairs = ((self.numbers, other.numbers), (self.offsets, other.offsets), (self.weights, other.weights))
        return Scenarios(*(np.concatenate(pair) for pair in pairs))

    @classmethod
    def balanced(cls, numbers: Array, of_numbers: Array, of_offsets: Array) -> Scenarios:
        """A robot, which does not count, and robots that have the mean and the covariance of what it may be.

        numbers (d, 6). of_numbers (F, d, 6), of_offsets (F, d): what each of F independent deviations of variance
        1 changes.
        """
        signs = np.vstack([np.zeros((1, len(of_offsets))), balanced(len(of_offsets))])
        weights = np.r_[0.0, np.ones(len(signs) - 1)]
        return cls(numbers + np.tensordot(signs, of_numbers, 1), signs @ of_offsets, weights)

    def shrunk(self, part: float) -> Scenarios:
        """The same robots, differing from the first by only a part of what they do."""
        numbers, offsets = (each[0] + part * (each - each[0]) for each in (self.numbers, self.offsets))
        return replace(self, numbers=numbers, offsets=offsets)


def balanced(count: int) -> Array:
    """Deviations (N, count) of so many independent quantities, each of mean 0 and variance 1; N is the next
    prime's successor.

    Over them, the mean of a function up to its second order is that over all values of the quantities: columns are
    orthogonal (Plackett and Burman, The design of optimum multifactorial experiments, Biometrika 33, 1946).
    """
    size = count
    while size % 4 != 3 or any(size % k == 0 for k in range(2, size)):
        size += 1
    squares = {k * k % size for k in range(1, size)}
    row = np.array([1.0 if k in squares or k == 0 else -1.0 for k in range(size)])
    signs = np.vstack([*(np.roll(row, -k) for k in range(size)), -np.ones(size)])
    return signs[:, :count]


@dataclass(frozen=True)
class SharedMotion:
    """Minimise the scenarios' mean shape error and the links' costs over q (T, n) and the tips (T, S, d).

    frame: the program of one robot in one frame over (phi, beta, theta), the last two of them q's own. parameters
    (T S, p): a row for every scenario of every frame. lower, upper (T, n): of q, equal where it is fixed.
    """

    frame: Nlp
    d: int
    scenarios: Scenarios
    parameters: Array
    lower: Array
    upper: Array
    links: tuple[Link, ...]
    apart: float
    functions: Callable[[], FrameFunctions]

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Frames T, scenarios S, entries n of q, and d."""
        return len(self.lower), len(self.scenarios), self.lower.shape[1], self.d

    @cached_property
    def weights(self) -> Array:
        """The share (S,) of every scenario in the mean."""
        found: Array = self.scenarios.weights / self.scenarios.weights.sum()
        return found

    @cached_property
    def own_rows(self) -> Index:
        """Which of a frame's constraints each scenario has of its own: those that its tips change."""
        return np.flatnonzero(self.frame.g_depends[:, : self.d].any(axis=1))[self.d :]

    @cached_property
    def common_rows(self) -> Index:
        """Which of them are the same for all."""
        return np.flatnonzero(~self.frame.g_depends[:, : self.d].any(axis=1))

    @cached_property
    def row_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (T, m) of a frame's rows: of scenario after scenario its own, and how far its
        tips are from the first's; then the common ones.
        """
        bounds = list[Array]()
        for bound, side in zip(self.frame.g_bounds, (-self.apart, self.apart), strict=True):
            _, count, _, d = self.sizes
            tips = np.full((count - 1) * (d - 1), side)
            parts = [np.tile(bound[self.own_rows], count), tips, bound[self.common_rows]]
            bounds.append(np.tile(np.concatenate(parts), (len(self.lower), 1)))
        return bounds[0], bounds[1]

    @cached_property
    def linking(self) -> sp.csr_array:
        """The matrices of all links over q, (l, T n)."""
        return sp.csr_array(sp.vstack([link.matrix for link in self.links]))

    def of_links(self, name: str) -> Array:
        """The offset, weight, lower or upper bounds of all links, (l,)."""
        return np.concatenate([getattr(link, name) for link in self.links])


def shared_motion(
    robot: Robot,
    frames: Sequence[Frame],
    dt: float,
    motion_weight: float,
    ends: Ends,
    model: Model,
    scenarios: Scenarios,
    functions: Callable[[Nlp], Callable[[], FrameFunctions]] = interpreted,
    margin: float = MARGIN,
    extra: Sequence[Term] = (),
    apart: float = APART,
) -> SharedMotion:
    """The motion through frames, dt s apart, of scenarios of a robot on a model with several equilibria.

    As horizon, but for tips that may turn as they do; margin: of every scenario; apart: rad. Raises OptionError.
    """
    if not model.several_equilibria:
        raise OptionError(
            f"model of scenarios is {model.name}; the tubes' numbers matter on the elastic one alone"
        )
    if scenarios.offsets.shape[1] != robot.d:
        raise OptionError(f"scenarios have {scenarios.offsets.shape[1]} tubes and the robot has {robot.d}")
    terms = terms_of(robot, model, margin, extra)
    frame = program("frame", robot.structure, model, terms)
    each = packed(frame, [filled(robot, terms, at) for at in frames])
    parameters = np.repeat(each[:, None], len(scenarios), axis=1)
    parameters[..., frame.place("tubes")] = scenarios.numbers.transpose(0, 2, 1).reshape(len(scenarios), -1)
    lower, upper = (np.tile(bound, (len(frames), 1)) for bound in (robot.lower, robot.upper))
    if ends.end is not None:
        lower[-1] = upper[-1] = ends.end
    before, after = ([] if q is None else [q] for q in (ends.start, ends.end))
    links = motion_links(robot, len(frames), dt, motion_weight, before, after, np.zeros(0))
    flat = parameters.reshape(len(frames) * len(scenarios), -1)
    return SharedMotion(frame, robot.d, scenarios, flat, lower, upper, links, apart, functions(frame))
