"""Equilibria of loaded robots, many rows side by side, each followed in a line of configurations and loads.

Robots of the rows may differ in the numbers of their tubes.

The tip that a configuration has is found by Newton's method in d + 2 unknowns from a prediction along the tangent,
as elastic/equilibria.py does without a load; a step that strays from its prediction, or passes a singular slope,
is halved until it is clear that the branch ends there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.models.dominant.shape import base_frame
from ctr_nlp.models.elastic.compiled import LEAP, SMALLEST, STRAY
from ctr_nlp.models.loaded.acting import PLAIN, RodKind
from ctr_nlp.models.loaded.compiled import Ends, Rods
from ctr_nlp.models.loaded.tips import axes_of, turned, unknowns
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Flags

CONVERGED, ITERATIONS = 1e-7, 12
"""rad of the last Newton step, whose error is about its square; steps at most."""
ON = 1e-2
"""rad: an equilibrium so near to its prediction is the one that Newton's method finds from there."""
ALIKE = 1e-6
"""rad by which unknowns of the same equilibrium may differ."""
WIDEST, SHRINKS = 1.0, 0.7
"""rad that a Newton step may turn tips or tubes by, and the part of the step before it; else none is found."""


class States(NamedTuple):
    """T equilibria of robots of numbers (T, d, 8): q (T, 2d + 2); load (T, 17 + 3d); the tip, angles (T, d)
    relative to its axes (T, 3, 3).

    slopes (T, d + 2, d + 2): how tilt and motors follow the tip (rod.Rod); determinant (T,): of these.
    """

    numbers: Array
    q: Array
    load: Array
    angles: Array
    axes: Array
    slopes: Array
    determinant: Array

    def rows(self, which: Any) -> States:
        """Some of them."""
        return States(*(each[which] for each in self))

    def moved(self, step: Array) -> tuple[Array, Array]:
        """Angles and axes after changes (T, d + 2) of the tips."""
        return turned(self.angles, self.axes, step)

    def alike(self, others: States) -> Flags:
        """Whether they are the same equilibria as others, (T,); those that are not known are not."""
        return np.asarray(abs(self.unknowns - others.unknowns).max(axis=1, initial=0.0) < ALIKE)

    @property
    def unknowns(self) -> Array:
        """The x (T, 2d + 2) of tips.py."""
        return unknowns(self.angles, self.axes, self.q)

    @classmethod
    def nowhere(cls, numbers: Array, q: Array, load: Array) -> States:
        """Those of robots of which nothing else is known."""
        rows, d, _ = numbers.shape
        shapes = (rows, d), (rows, 3, 3), (rows, d + 2, d + 2), (rows,)
        return cls(numbers, q, load, *(np.full(shape, np.nan) for shape in shapes))

    def write(self, which: Any, others: States) -> None:
        """Put others in place of some."""
        for array, values in zip(self, others, strict=True):
            array[which] = values

    def replaced(self, which: Any, others: States) -> States:
        """The same with others in place of some."""
        found = States(*(each.copy() for each in self))
        found.write(which, others)
        return found


class LoadedEquilibria:
    """Follows equilibria of loaded robots; one object a thread."""

    def __init__(self, structure: Structure, kind: RodKind = PLAIN) -> None:
        """Build."""
        self.d, self.rods = structure.d, Rods(structure, kind)

    def unloaded(self, numbers: Array, q: Array, tips: Array) -> States:
        """The states of robots of numbers (T, d, 8) at q (T, 2d + 2) without a load.

        tips (T, d): what is known of their angles, against each other.
        """
        placed, every = self.placed(numbers, q, tips), np.ones(len(q), dtype=bool)
        return self._solved(numbers, q, self._no_load(len(q)), *placed, every)[0]

    def placed(self, numbers: Array, q: Array, tips: Array) -> tuple[Array, Array]:
        """Angles and axes of unloaded tips with angles (T, d) against each other, whose base stands at q."""
        rows, d = len(q), self.d
        axes, angles = np.tile(np.eye(3), (rows, 1, 1)), tips - tips[:, -1:]
        ends = self.ends(numbers, angles, axes, q, self._no_load(rows))
        spin = q[:, d - 1] - ends.angles[:, -1]
        base = base_axes(q[:, 2 * d :])
        cos, sin = np.cos(spin)[:, None], np.sin(spin)[:, None]
        spun = np.stack(
            [cos * base[:, 0] + sin * base[:, 1], cos * base[:, 1] - sin * base[:, 0], base[:, 2]], axis=1
        )
        # R_tip = R_base A^T, where A is the base of a tip that stands still
        return angles, np.swapaxes(ends.axes, 1, 2) @ spun

    def along(
        self,
        states: States,
        q: Array,
        load: Array,
        most: float = 1.0,
        smallest: float = SMALLEST,
        numbers: Array | None = None,
    ) -> tuple[States, Array]:
        """The equilibria as far towards q and load as their branches go, and which part of the way that is, (T,).

        most, smallest: parts of the way that are gone in a step. numbers (T, d, 8): of the tubes at its end, None
        for those of the states.
        """
        start, done = states, np.zeros(len(q))
        tubes = np.zeros(start.numbers.shape) if numbers is None else numbers - start.numbers
        part = np.full(len(q), min(1.0, most))
        while True:
            active = np.flatnonzero((done < 1) & (part >= smallest))
            if not len(active):
                return states, done
            ahead = done[active] + part[active]
            goal = start.q[active] + ahead[:, None] * (q - start.q)[active]
            pull = start.load[active] + ahead[:, None] * (load - start.load)[active]
            here = states.rows(active)._replace(
                numbers=start.numbers[active] + ahead[:, None, None] * tubes[active]
            )
            new, there = self._step(here, goal, pull)
            gone, stopped = active[there], active[~there]
            states = states.replaced(gone, new.rows(there))
            done[gone] += part[gone]
            done[gone[done[gone] > 1 - 1e-12]] = 1.0
            part[gone] = np.minimum(np.minimum(2 * part[gone], most), 1 - done[gone])
            part[stopped] /= 2

    def linked(self, states: States, goals: States) -> Flags:
        """Whether the branches of states lead to goals in lines, (T,): as predicted but for ON, or on the way.

        Those of which either is not known do not.
        """
        found = np.isfinite(states.determinant) & np.isfinite(goals.determinant)
        known = np.flatnonzero(found)
        found[known] = self._near(states.rows(known), goals.rows(known))
        left = known[~found[known]]
        reached, done = self.along(states.rows(left), goals.q[left], goals.load[left])
        found[left] = (done == 1) & reached.alike(goals.rows(left))
        return found

    def _near(self, states: States, goals: States) -> Flags:
        """Whether goals (T,) are where the tangents of states' branches lead to, but for ON."""
        angles, axes, near = self._predicted(states, goals.q, goals.load)
        away = abs(unknowns(angles, axes, goals.q) - goals.unknowns).max(axis=1, initial=0.0)
        return np.asarray(near & (away < ON) & (goals.determinant * states.determinant > 0))

    def _step(self, states: States, q: Array, load: Array) -> tuple[States, Flags]:
        """The equilibria at q and load on the branches of some nearby, and for which they were found."""
        angles, axes, near = self._predicted(states, q, load)
        new, found = self._solved(states.numbers, q, load, angles, axes, near)
        away = np.maximum(abs(new.angles - angles).max(axis=1), abs(new.axes - axes).max(axis=(1, 2)))
        return new, found & (away < STRAY) & (new.determinant * states.determinant > 0)

    def _predicted(self, states: States, q: Array, load: Array) -> tuple[Array, Array, Flags]:
        """The tips at q and load along the tangents of states' branches; for which these turn little."""
        d = self.d
        here = self.ends(states.numbers, states.angles, states.axes, q, load)
        step = solved(states.slopes, self.misfit(q, here))
        motors = q[:, :d] - states.q[:, :d]
        apart = abs(motors[:, :-1] - motors[:, -1:]).max(axis=1, initial=0.0)
        near = abs(step[:, 2:-1] - step[:, -1:]).max(axis=1, initial=0.0) < LEAP + apart
        near &= abs(step).max(axis=1) < WIDEST
        return *states.moved(step), near

    def _solved(
        self, numbers: Array, q: Array, load: Array, angles: Array, axes: Array, wanted: Flags
    ) -> tuple[States, Flags]:
        """What Newton's method finds from tips, of the rows that are wanted; for which it ends."""
        angles, axes, rows, side = angles.copy(), axes.copy(), len(q), self.d + 2
        slopes, found, going = np.tile(np.eye(side), (rows, 1, 1)), np.zeros(rows, dtype=bool), wanted.copy()
        most = np.full(rows, WIDEST)
        for _ in range(ITERATIONS):
            at = np.flatnonzero(going)
            if not len(at):
                break
            ends = self.ends(numbers[at], angles[at], axes[at], q[at], load[at])
            slopes[at] = ends.slopes
            step = solved(slopes[at], self.misfit(q[at], ends))
            size = abs(step).max(axis=1)
            moved = size < most[at]
            found[at] |= size < CONVERGED
            going[at], most[at] = moved & (size >= CONVERGED), SHRINKS * size
            angles[at[moved]], axes[at[moved]] = turned(angles[at[moved]], axes[at[moved]], step[moved])
        return States(numbers, q, load, angles, axes, slopes, np.linalg.det(slopes)), found

    def ends(
        self, numbers: Array, angles: Array, axes: Array, q: Array, load: Array, soft: Array | None = None
    ) -> Ends:
        """The rods of tips, at the extensions of q (T, 2d + 2) and under loads (T, 17 + 3d)."""
        soft = np.ones((len(q), 2)) if soft is None else soft
        return self.rods(numbers, angles, axes, q[:, self.d : 2 * self.d], load, soft)

    def ends_of(self, states: States, soft: Array | None = None) -> Ends:
        """The rods of states."""
        return self.ends(states.numbers, states.angles, states.axes, states.q, states.load, soft)

    def states(self, numbers: Array, angles: Array, axes: Array, beta: Array, load: Array) -> States:
        """The states of tips, each an equilibrium of its own configuration."""
        q = self.configurations(numbers, angles, axes, beta, load)
        slopes = self.ends(numbers, angles, axes, q, load).slopes
        return States(numbers, q, load, angles, axes, slopes, np.linalg.det(slopes))

    def misfit(self, q: Array, ends: Ends) -> Array:
        """By what bases must turn, and motors be turned, to stand at q: (T, d + 2), in the order of responses."""
        between = _between(q, ends)
        x, y, z = (between[:, 2, k] for k in range(3))
        sine = np.hypot(x, y)
        factor = np.where(sine > 1e-12, np.arctan2(sine, z) / np.maximum(sine, 1e-300), 1.0)
        motors = q[:, : self.d] - _alpha(ends, between)
        motors -= 2 * np.pi * np.round(motors[:, -1:] / (2 * np.pi))
        return np.hstack([(-factor * y)[:, None], (factor * x)[:, None], motors])

    def configurations(self, numbers: Array, angles: Array, axes: Array, beta: Array, load: Array) -> Array:
        """The q (T, 2d + 2) of tips; theta_x within a quarter turn, and alpha up to whole turns of all tubes.

        From row to row alpha makes no such turn where the tips' angles make none.
        """
        q = np.hstack([np.zeros(beta.shape), beta, np.zeros((len(beta), 2))])
        ends = self.ends(numbers, angles, axes, q, load)
        x, y, z = ends.axes[:, 2].T
        q[:, 2 * self.d :] = np.stack([-np.arcsin(np.clip(y, -1, 1)), np.arctan2(x, z)], axis=1)
        q[:, : self.d] = _alpha(ends, _between(q, ends))
        return q

    def _no_load(self, rows: int) -> Array:
        return np.zeros((rows, self.rods.size))


def base_axes(theta: Array) -> Array:
    """The columns of R of eq. (4), (T, 3, 3), row by row d_1, d_2 and t."""
    return axes_of(base_frame(theta[:, 0], theta[:, 1], np))


def _between(q: Array, ends: Ends) -> Array:
    """The turns (T, 3, 3) from where rods' bases point to where those of q (T, 2d + 2) do."""
    d = ends.angles.shape[1]
    return base_axes(q[:, 2 * d :]) @ np.swapaxes(ends.axes, 1, 2)


def _alpha(ends: Ends, between: Array) -> Array:
    """The motors' angles (T, d) of rods, as shape.py tells them in symbols, for what _between has found."""
    spin = np.arctan2(between[:, 1, 0] - between[:, 0, 1], between[:, 0, 0] + between[:, 1, 1])
    return ends.angles + spin[:, None]


def solved(slopes: Array, misfit: Array) -> Array:
    """The steps (T, n) that make up for misfits (T, n); NaN where there is none."""
    fine = np.asarray(np.isfinite(slopes).all(axis=(1, 2)) & (abs(np.linalg.det(slopes)) > 0))
    found = np.full(misfit.shape, np.nan)
    found[fine] = np.linalg.solve(slopes[fine], misfit[fine][..., None])[..., 0]
    return found
