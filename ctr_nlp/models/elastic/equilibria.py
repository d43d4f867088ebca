"""Equilibria of the elastic model, one configuration after another.

alpha(x) = alpha is solved for phi by Newton's method, from a prediction along the tangent (path following). A step
that turns far from its prediction, or passes a singular d alpha / d phi, is halved until it is clear that the
stable branch ends there: at a fold, where the robot snaps. Then the energy is minimised along its gradient flow
into another equilibrium. Angles in rad, extensions in mm. The files in c/ do the same in C, with better
predictors.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

from ctr_nlp.codegen.batch_evaluator import BatchEvaluator
from ctr_nlp.models.elastic import compiled as compiled_code
from ctr_nlp.models.elastic import energy, stability
from ctr_nlp.models.elastic.compiled import (
    ELASTIC_NEWTON_TOLERANCE_RAD,
    FOLD_PERTURBATION_RAD,
    MAX_ALIGNED_TURN_STEP_RAD,
    MAX_ELASTIC_NEWTON_STEPS,
    MAX_FALL_STEP_RAD,
    MAX_FALLS_PER_STEP,
    MAX_PREDICTED_TURN_RAD,
    MAX_PREDICTION_ERROR_RAD,
    MIN_PATH_STEP_FRACTION,
    get_compiled_elastic,
    symbolic,
)
from ctr_nlp.models.elastic.energy import Energy
from ctr_nlp.robot.structure import Structure, TubeNumbers, tubes_of
from ctr_nlp.typing import Array

MIN_TURN_DENOMINATOR = 1e-300
"""Replaces 0 in a denominator; where tubes slide without turning, angles do not change."""
MAX_FALL_STEPS = 2000
"""Largest number of steps of the gradient flow after a snap."""


class EquilibriumState(NamedTuple):
    """An equilibrium x at q, (2d + 2,) both; stable: whether it is stable.

    slopes (d, d): derivatives of alpha over phi; determinant: of these.
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
    """Finds and follows a robot's equilibria; one object a thread."""

    def __init__(self, structure: Structure, numbers: Array) -> None:
        """Prepare for tubes of numbers (d, 8), in the order of structure.TUBE_NUMBER_NAMES."""
        self._d = structure.d
        self._by_tube = numbers
        self._numbers = numbers.ravel(order="F")[None]
        self._compiled = get_compiled_elastic(structure)
        self._structure = structure

    @cached_property
    def _tubes(self) -> tuple[TubeNumbers, ...]:
        """The tubes of the robot."""
        return tubes_of(self._structure, self._by_tube.tolist())

    def margins(self, x: Array) -> Array:
        """Return the stability margin (T,) at every x (T, 2d + 2); NaN where x is."""
        if self._compiled is None:
            return stability.margins(self._tubes, x)
        return self._compiled.margins(self._numbers, x)

    @cached_property
    def _motors(self) -> BatchEvaluator:
        """Function (x, numbers) -> alpha and its derivatives, compiled or interpreted, with this robot's numbers
        filled in.
        """
        # A least gap between carriages constrains motors and not equilibria: robots with and without it share the
        # function.
        code = self._compiled
        found = BatchEvaluator(
            code.motors if code else symbolic(replace(self._structure, gap=False)).scalar_functions[0], 1
        )
        found.inputs[1][0] = self._numbers
        return found

    def find_rest_state(self, q: Array) -> EquilibriumState | None:
        """Return the equilibrium at q (2d + 2,) that turning all tubes there from aligned tips reaches; or None.

        The motion begins where all tips bend alike and the innermost one is at alpha_d.
        """
        if self._compiled is not None:
            states, found = self._compiled.settle(self._numbers, q[None])
            return _from_struct(states[0], self._d, q) if found[0] else None
        d = self._d
        x = np.array(q, dtype=float)
        x[: d - 1] = 0.0
        # With aligned tips (phi_i = 0) the robot is on the stable branch; the motors' angles there are where the
        # motion begins.
        aligned = np.concatenate([self._evaluate_motors(x)[0], q[d:]])
        state = self._solve_equilibrium(aligned, x, True)
        # Long motions are divided: a single prediction over several radians could converge on another branch.
        most = MAX_ALIGNED_TURN_STEP_RAD / max(abs(q - aligned).max(), MIN_TURN_DENOMINATOR)
        return state and self._continue_to_goal(self._follow_branch(state, q, most), q)[0]

    def nearest(self, q: Array, x: Array) -> EquilibriumState | None:
        """Return the equilibrium at q near x (2d + 2,), stable or not.

        Where there is none, return that of find_rest_state.
        """
        state = self._solve_equilibrium(q, x, False)
        return self.find_rest_state(q) if state is None else state._replace(stable=self._is_stable(state))

    def follow_to_goal(self, state: EquilibriumState, goal: Array) -> tuple[EquilibriumState | None, list[Array]]:
        """Return the equilibrium at goal (2d + 2,) after a linear motion from `state`, and the tips' jumps, if
        any.

        The equilibrium is None where none is found; a jump is (d,) in rad.
        """
        if self._compiled is None:
            return self._continue_to_goal(self._follow_branch(state, goal), goal)
        code = _to_struct(state)
        there, jumps = self._compiled.follow(self._numbers, code, goal)
        return _from_struct(code, self._d, goal) if there else None, list(jumps)

    def walk_through_goals(self, state: EquilibriumState, goals: Array) -> tuple[Array, EquilibriumState]:
        """Return equilibria (k, 2d + 2) at the first k of goals (T, 2d + 2), up to a snap, and the last state.

        state: where the motion begins.
        """
        if self._compiled is None:
            found = [state.x[:0]]
            for goal in goals:
                ahead = self._follow_branch(state, goal)
                if ahead.q is not goal:
                    break
                state = ahead
                found.append(state.x)
            return np.array(found[1:]).reshape(-1, goals.shape[1]), state
        code = _to_struct(state)
        x = self._compiled.walk(self._numbers, code, goals)
        return x, _from_struct(code, self._d, goals[min(len(x), len(goals) - 1)])

    def _continue_to_goal(
        self, state: EquilibriumState, goal: Array
    ) -> tuple[EquilibriumState | None, list[Array]]:
        """Return the equilibrium at goal and the jumps, from a state to which a branch was followed on the way
        there.

        Snaps and branches alternate until goal is reached. None where no equilibrium is found.
        """
        jumps = list[Array]()
        # Identity, not equality: a state's q is the goal's own array exactly if the goal was reached.
        while state.q is not goal:
            fallen = self._fall_off_branch(state, goal) if len(jumps) < MAX_FALLS_PER_STEP else None
            if fallen is None:
                return None, jumps
            jumps.append(fallen.tips - state.tips)
            state = self._follow_branch(fallen, goal)
        return state, jumps

    def _follow_branch(self, state: EquilibriumState, goal: Array, most: float = 1.0) -> EquilibriumState:
        """Return the equilibrium as far towards goal as its branch goes.

        most: largest fraction of the path in one step.
        """
        start = state.q
        done = 0.0
        part = min(1.0, most)
        while part >= MIN_PATH_STEP_FRACTION:
            new = self._step(state, _between(start, goal, done + part))
            if new is None:
                # Either the prediction was poor, or the branch ends before this point: bisection finds out which.
                part /= 2
            else:
                state = new
                done = done + part
                # Steps grow again after a success; the last one ends at the goal.
                part = min(2 * part, most, 1 - done)
        return state

    def _step(self, state: EquilibriumState, goal: Array) -> EquilibriumState | None:
        """Return the equilibrium at goal on the branch of a nearby state.

        None where it may be on another branch.
        """
        predicted = self._predict_unknowns(state, goal)
        d = self._d
        turns = (predicted - state.x)[: d - 1]
        motors = (goal - state.q)[:d]
        # `not <` is true for NaN as well.
        if not abs(turns).max(initial=0.0) < MAX_PREDICTED_TURN_RAD + abs(motors[:-1] - motors[-1]).max(
            initial=0.0
        ):
            return None
        new = self._solve_equilibrium(goal, predicted, state.stable)
        if new is None or not abs(new.x - predicted).max() < MAX_PREDICTION_ERROR_RAD:
            return None
        # det d alpha / d phi is positive on the stable branch from aligned tubes, and its first zero is the
        # snap: a change of sign means that a fold was passed. Only an unstable branch may be followed
        # through one, and whether it is stable then has to be looked at.
        if new.determinant * state.determinant > 0:
            return new
        return None if state.stable else new._replace(stable=self._is_stable(new))

    def _predict_unknowns(self, state: EquilibriumState, goal: Array) -> Array:
        """Return the x at goal that the branch's tangent predicts."""
        # At the goal's beta and the old tips, alpha is off by goal - alpha(here); one linear step turns
        # tips by that.
        d = self._d
        here = np.concatenate([state.x[: self._d], goal[self._d :]])
        *_, turn, singular = lapack.dgesv(state.slopes, goal[:d] - self._evaluate_motors(here)[0])
        # At a fold there is no tangent: the old tips are the prediction, and Newton's method decides.
        here[:d] += 0.0 if singular else turn
        return here

    def _evaluate_motors(self, x: Array) -> tuple[Array, Array]:
        """Return the motors' angles (d,) at x and their derivatives over phi (d, d).

        The last column is ones, since turning all tubes turns the robot.
        """
        alpha, columns = self._motors(x)
        return alpha[0], np.column_stack([columns.reshape(-1, self._d).T, np.ones(self._d)])

    def _solve_equilibrium(self, q: Array, x: Array, stable: bool) -> EquilibriumState | None:
        """Return the equilibrium at q (2d + 2,) that Newton's method finds from x (2d + 2,).

        None where it does not converge. stable: the stability that is recorded in the state, without a check.
        """
        d = self._d
        x = np.concatenate([x[:d], q[d:]])
        for _ in range(MAX_ELASTIC_NEWTON_STEPS):
            alpha, slopes = self._evaluate_motors(x)
            factors, pivots, turn, singular = lapack.dgesv(slopes, q[:d] - alpha)
            size = abs(turn).max()
            # A step of 1 rad is no correction of a prediction: Newton's method diverges. `not <` is true for NaN
            # as well.
            if singular or not size < 1:
                return None
            x[:d] += turn
            if size < ELASTIC_NEWTON_TOLERANCE_RAD:
                # The determinant from the LU factors: the product of the diagonal, negative for an odd
                # number of row swaps.
                swaps = np.count_nonzero(pivots != np.arange(d))
                return EquilibriumState(q, x, slopes, (-1) ** swaps * factors.diagonal().prod(), stable)
        return None

    def _is_stable(self, state: EquilibriumState) -> bool:
        """Return whether a state is stable, by its margin."""
        return bool(self.margins(state.x[None])[0] > 0)

    def _fall_off_branch(self, state: EquilibriumState, goal: Array) -> EquilibriumState | None:
        """Return the stable equilibrium that a robot snaps into where its branch ends on the way to goal, just
        past the end.
        """
        # Just past the end of the branch first, then further and further, up to goal itself.
        for part in MIN_PATH_STEP_FRACTION ** np.linspace(1, 0, 11):
            past = _between(state.q, goal, part)
            x = self._estimate_fallen_unknowns(state, past)
            new = None if x is None else self._solve_equilibrium(past, x, True)
            if (
                x is not None
                and new is not None
                and abs(new.x - x).max() < MAX_PREDICTION_ERROR_RAD
                and self._is_stable(new)
            ):
                return new
        return None

    def _estimate_fallen_unknowns(self, state: EquilibriumState, past: Array) -> Array | None:
        """Estimate the equilibrium at `past` that a robot snaps into from a state nearby.

        None where none is found.
        """
        d = self._d
        on = self._predict_unknowns(state, past) - state.x
        (of,) = energy.energies(self._tubes, past[None])
        # A small step along the predicted direction, as a finite difference of angles: only its direction
        # is used.
        step = on * min(
            1e-4 / max(abs(on[:d]).max(), MIN_TURN_DENOMINATOR), 1e-2 / max(abs(on).max(), MIN_TURN_DENOMINATOR)
        )
        here, ahead = energy.differences(self._tubes, np.stack([state.x, state.x + step]))
        rows = len(of.strength)
        a = _fall(of, of.couples @ past[:d] + of.helix_angles[:rows], here, ahead - here)
        if a is None:
            return None
        # The minimum's coefficients a as tip angles; then relative to the innermost tube's, as x has them.
        tips = past[:d] + of.helix_angles[rows:] + of.ends @ a
        return np.concatenate([tips[:-1] - tips[-1], tips[-1:], past[d:]])


def _between(start: Array, goal: Array, part: float) -> Array:
    """Return the point a part of the way from start to goal; goal itself, not a copy, at its end."""
    return goal if part == 1 else start + part * (goal - start)


def _fall(energy: Energy, motors: Array, angles: Array, towards: Array) -> Array | None:
    """Return the minimum of energy along the gradient flow from an equilibrium, as coefficients a (n,).

    None where none is found. angles (rows,): between tubes at the equilibrium that is left. motors (rows,): angles
    between the tubes' motors; towards (rows,): last change of the angles.
    """
    # At an equilibrium the gradient a + strength sin(angles) turns is 0, which gives its a.
    a: Array = -(energy.strength * np.sin(angles)) @ energy.turns
    _, modes = np.linalg.eigh(energy.hessian(angles))
    # At a fold the softest mode's eigenvalue vanishes: that is the direction in which the robot leaves, on
    # the side to which it was moving.
    push = energy.turns @ modes[:, 0]
    time = 8.0
    a = a + modes[:, 0] * np.copysign(FOLD_PERTURBATION_RAD / abs(push).max(), push @ towards)
    for _ in range(MAX_FALL_STEPS):
        change, time = _step_down(energy, motors, a, time)
        a = a + change
        size = abs(energy.turns @ change).max()
        # A small step says little if its time was short: at a minimum, long ones are small as well.
        if size < ELASTIC_NEWTON_TOLERANCE_RAD and time > 40:
            return a
        # The next step is to turn by about 0.8 MAX_FALL_STEP_RAD; where this one turned by less than
        # MAX_FALL_STEP_RAD / 10, it is 8 times as long.
        time *= 0.8 * MAX_FALL_STEP_RAD / size if size > MAX_FALL_STEP_RAD / 10 else 8
    return None


def _step_down(energy: Energy, motors: Array, a: Array, time: float) -> tuple[Array, float]:
    """Return a step (n,) of the gradient flow of at most MAX_FALL_STEP_RAD rad that is never uphill, and its time.

    time: the time it should take. By Rosenbrock's method of second order that is L-stable: ROS2 of Verwer, Spee,
    Blom and Hundsdorfer, SIAM J. Sci. Comput. 20, 1999.
    """
    # The gradient flow a' = -dE/da is stiff; L-stability damps its fast parts. gamma = 1 - 1/sqrt(2).
    gamma = 1 - np.sqrt(0.5)
    angles = motors + energy.turns @ a
    slope = energy.gradient(a, angles)
    bent = energy.hessian(angles)
    height = energy.height(a, angles)
    while True:
        # I + gamma time (K + V). Where it is not positive definite, the time is too long for the local
        # curvature.
        factors, broken = lapack.dpotrf(np.eye(len(a)) + gamma * time * bent, lower=1)
        size = 0.0
        if not broken:
            first, _ = lapack.dpotrs(factors, -slope, lower=1)
            ahead = a + time * first
            pull = energy.gradient(ahead, motors + energy.turns @ ahead)
            second, _ = lapack.dpotrs(factors, -pull - 2 * first, lower=1)
            change: Array = time * (1.5 * first + 0.5 * second)
            turn = energy.turns @ change
            size = abs(turn).max()
            if size < 1e-6 or (size <= MAX_FALL_STEP_RAD and energy.height(a + change, angles + turn) < height):
                return change, time
        # Shorter in proportion where the step was too far; half where it went uphill or nothing could be
        # solved.
        time *= max(0.1, 0.8 * MAX_FALL_STEP_RAD / size) if size > MAX_FALL_STEP_RAD else 0.5


def walk_robot_batch(
    structure: Structure, numbers: Array, goals: Array
) -> list[tuple[Array, EquilibriumState] | None]:
    """Return equilibria of up to vector_lanes() robots of numbers (n, d, 8) along goals (n, T, 2d + 2).

    structure: what the robots share. Each robot settles at its first goal and follows its branch in whole steps.
    Returns for each the equilibria (k, 2d + 2) at the goals that it reached, and the last state; None for one that
    does not settle, and for all without compiled code. The result of a robot does not depend on those in other
    lanes.
    """
    code = get_compiled_elastic(structure)
    count = len(numbers)
    if code is None:
        return [None] * count
    every = np.arange(code.lanes) % count
    flat = np.ascontiguousarray(numbers.swapaxes(1, 2)).reshape(count, -1)[every]
    states, settled = code.settle(flat, goals[every, 0])
    # A copy: walking changes the states in place.
    begin = np.frombuffer(memoryview(states), compiled_code.STATE_DTYPE)["x"][:, : goals.shape[2]].copy()
    x, reached = code.walk_batch(flat, states, goals[:, 1:])
    known = [np.concatenate([begin[k : k + 1], x[k, :far]]) for k, far in enumerate(reached.tolist())]
    ends = [_from_struct(states[k], structure.d, goals[k, reached[k]]) for k in range(count)]
    return [each if settled[k] else None for k, each in enumerate(zip(known, ends, strict=True))]


def _to_struct(state: EquilibriumState) -> compiled_code.StateStruct:
    """Convert a state to the struct of C."""
    found = compiled_code.StateStruct(determinant=state.determinant, stable=state.stable)
    for array, values in ((found.q, state.q), (found.x, state.x), (found.slopes, state.slopes.ravel(order="F"))):
        np.ctypeslib.as_array(array)[: len(values)] = values
    return found


def _from_struct(code: compiled_code.StateStruct, d: int, goal: Array) -> EquilibriumState:
    """Convert the struct of C to a state; its q is goal itself where that is reached."""
    q = np.array(code.q[: 2 * d + 2])
    x = np.array(code.x[: 2 * d + 2])
    # C has matrices by columns.
    slopes = np.array(code.slopes[: d * d]).reshape(d, d).T
    return EquilibriumState(goal if (q == goal).all() else q, x, slopes, code.determinant, bool(code.stable))
