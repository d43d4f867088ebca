"""Equilibria of the elastic model, one configuration after the other.

alpha(x) is solved for phi by Newton's method, from a prediction along the tangent. A step that turns far from its
prediction, or passes a singular d alpha / d phi, is halved until it is clear that the stable branch ends there;
then the robot falls down the gradient of its energy into another equilibrium.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import lapack

from ctr_nlp.codegen import cache, vector
from ctr_nlp.codegen.mapped import Mapped
from ctr_nlp.models.elastic import stability, torsion
from ctr_nlp.models.elastic.stability import Energy
from ctr_nlp.models.protocol import symbolic_tubes
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import NUMBERS, Structure
from ctr_nlp.typing import Array

STRIDE = 0.2
"""rad that tubes are turned by at once on the way from the aligned robot."""
CONVERGED, ITERATIONS = 1e-7, 8
"""rad of the last Newton step, whose error is about its square; steps at most."""
STRAY = 0.1
"""rad: an equilibrium further than this from its prediction may belong to another branch."""
SMALLEST = 2.0**-20
"""Part of a step at which a branch that cannot be followed is held to end."""
PUSH = 0.1
"""rad that tubes are turned by against each other where a branch ends, over what lies between discretisations."""
MOST = 20
"""Branches that may end on one step."""
TINY = 1e-300
"""What stands for 0 in a denominator; where tubes slide without turning, angles do not change."""
FALL, FALLS = 0.1, 2000
"""rad that tubes turn by against each other in one step of a fall; steps at most."""


class State(NamedTuple):
    """An equilibrium x at q, (2d + 2,) both; stable: whether it is.

    slopes (d, 2d + 2): of alpha over x; determinant: of those over phi.
    """

    q: Array
    x: Array
    slopes: Array
    determinant: float
    stable: bool

    @property
    def tips(self) -> Array:
        """The tubes' angles at their tips, (d,), rad."""
        d = len(self.slopes)
        return np.append(self.x[: d - 1] + self.x[d - 1], self.x[d - 1])


class Equilibria:
    """Follows a robot's equilibria; one object a thread."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self._tubes = robot, robot.tube_numbers
        self._motors = Mapped(_motors(robot.structure), 1, 1)
        self._motors.inputs[1][0] = robot.numbers.ravel(order="F")

    def settled(self, q: Array) -> State | None:
        """The equilibrium at q that all tubes are turned to from alpha_d."""
        d, aligned = self.robot.d, np.array(q, dtype=float)
        aligned[:d] = q[d - 1]
        x = aligned.copy()
        x[: d - 1] = 0.0
        state = self._solved(aligned, x, True)
        for goal in np.linspace(aligned, q, 2 + int(np.ptp(q[:d]) / STRIDE))[1:]:
            state = state and self.followed(state, goal)[0]
        return state

    def nearest(self, q: Array, x: Array) -> State | None:
        """The equilibrium at q near x (2d + 2,), stable or not; the settled one where there is none."""
        state = self._solved(q, x, False)
        return self.settled(q) if state is None else state._replace(stable=self._holds(state))

    def followed(self, state: State, goal: Array) -> tuple[State | None, list[Array]]:
        """The equilibrium at goal (2d + 2,) of a robot moved there in a line; what its tips jumped by (d,) rad.

        None where no equilibrium is found.
        """
        state, jumps = self._along(state, goal), list[Array]()
        while state.q is not goal:
            fallen = self._fallen(state, goal) if len(jumps) < MOST else None
            if fallen is None:
                return None, jumps
            jumps.append(fallen.tips - state.tips)
            state = self._along(fallen, goal)
        return state, jumps

    def _along(self, state: State, goal: Array) -> State:
        """The equilibrium as far towards goal as its branch goes."""
        start, done, part = state.q, 0.0, 1.0
        while part >= SMALLEST:
            new = self._step(state, _between(start, goal, done + part))
            if new is None:
                part /= 2
            else:
                state, done = new, done + part
                part = min(2 * part, 1 - done)
        return state

    def _step(self, state: State, goal: Array) -> State | None:
        """The equilibrium at goal on the branch of one nearby."""
        predicted = self._predicted(state, goal)
        new = self._solved(goal, predicted, state.stable)
        if new is None or not abs(new.x - predicted).max() < STRAY:
            return None
        if new.determinant * state.determinant > 0:
            return new
        return None if state.stable else new._replace(stable=self._holds(new))

    def _predicted(self, state: State, goal: Array) -> Array:
        """The x at goal that the tangent of the branch leads to."""
        d, change = self.robot.d, goal - state.q
        *_, turn, singular = lapack.dgesv(state.slopes[:, :d], change[:d] - state.slopes[:, d:] @ change[d:])
        return np.concatenate([state.x[:d] + (0.0 if singular else turn), goal[d:]])

    def _solved(self, q: Array, x: Array, stable: bool) -> State | None:
        """The equilibrium at q (2d + 2,) that Newton's method finds from x (2d + 2,)."""
        d = self.robot.d
        x = np.concatenate([x[:d], q[d:]])
        for _ in range(ITERATIONS):
            alpha, columns = self._motors(x)
            slopes = columns.reshape(-1, d).T
            factors, pivots, turn, singular = lapack.dgesv(slopes[:, :d], q[:d] - alpha[0])
            size = abs(turn).max()
            if singular or not size < 1:
                return None
            x[:d] += turn
            if size < CONVERGED:
                swaps = np.count_nonzero(pivots != np.arange(d))
                return State(q, x, slopes.copy(), (-1) ** swaps * factors.diagonal().prod(), stable)
        return None

    def _holds(self, state: State) -> bool:
        return bool(stability.margins(self._tubes, state.x[None])[0] > 0)

    def _fallen(self, state: State, goal: Array) -> State | None:
        """A stable equilibrium that a robot falls into where its branch ends on the way to goal; just past it."""
        for part in SMALLEST ** np.linspace(1, 0, 11):
            past = _between(state.q, goal, part)
            x = self._settling(state, past)
            new = self._solved(past, x, True)
            if new is not None and abs(new.x - x).max() < STRAY and self._holds(new):
                return new
        return None

    def _settling(self, state: State, past: Array) -> Array:
        """About the equilibrium at `past` that a robot falls into from one nearby."""
        d, on = self.robot.d, self._predicted(state, past) - state.x
        (energy,) = stability.energies(self._tubes, past[None])
        step = on * min(1e-4 / max(abs(on[:d]).max(), TINY), 1e-2 / max(abs(on).max(), TINY))
        here, ahead = stability.differences(self._tubes, np.stack([state.x, state.x + step]))
        tips = past[:d] + energy.ends @ _fall(energy, energy.couples @ past[:d], here, ahead - here)
        return np.concatenate([tips[:-1] - tips[-1], tips[-1:], past[d:]])


def _between(start: Array, goal: Array, part: float) -> Array:
    return goal if part == 1 else start + part * (goal - start)


def _fall(energy: Energy, motors: Array, angles: Array, towards: Array) -> Array:
    """The least energy that a robot comes to down its gradient, from angles (rows,) of an equilibrium, as a (n,).

    motors (rows,): angles between the tubes' motors; towards (rows,): how angles last changed. Where the energy is
    a paraboloid, steps follow the gradient flow a' = -dE/da exactly.
    """
    a: Array = -(energy.strength * np.sin(angles)) @ energy.turns
    _, modes = np.linalg.eigh(energy.hessian(angles))
    push = energy.turns @ modes[:, 0]
    a = a + modes[:, 0] * np.copysign(PUSH / abs(push).max(), push @ towards)
    time = 1.0
    for _ in range(FALLS):
        angles = motors + energy.turns @ a
        curvatures, modes = np.linalg.eigh(energy.hessian(angles))
        slopes = modes.T @ energy.gradient(a, angles)
        time *= 8
        while abs(energy.turns @ (change := -modes @ (slopes * _decay(curvatures, time)))).max() > FALL:
            time /= 2
        a = a + change
        if curvatures[0] > 0 and time * curvatures[0] > 40 and abs(energy.turns @ change).max() < CONVERGED:
            break
    return a


def _decay(rates: Array, time: float) -> Array:
    """(1 - exp(-rate time)) / rate, the integral of exp(-rate t) over the time."""
    exponents = np.clip(rates * time, -100.0, 100.0)
    small = abs(exponents) < 1e-9
    found: Array = np.where(small, time, -np.expm1(-exponents) / np.where(small, 1.0, rates))
    return found


@functools.lru_cache(maxsize=64)
def _motors(structure: Structure) -> ca.Function:
    """(x, numbers of the tubes (d, 6)) -> alpha and its slopes over x, compiled where possible."""
    d = structure.d
    x, numbers = ca.SX.sym("x", 2 * d + 2), ca.SX.sym("numbers", d, len(NUMBERS))
    tubes, entries = symbolic_tubes(structure, numbers), ca.vertsplit(x)
    twisted = torsion.twist(tubes, entries, torsion.sections(tubes, entries[d : 2 * d], ca), ca)
    alpha = ca.densify(ca.vertcat(*torsion.motors(tubes, entries, twisted)))
    outputs = [alpha, ca.densify(ca.jacobian(alpha, x))]
    function = ca.Function("equilibrium", [x, numbers], outputs, {"cse": True})
    if cache.missing():
        return function
    code = vector.vector_code((function,), 1)
    return ca.external(function.name(), str(cache.library(code, lambda: code)))
