"""Tip steering on the elastic model, whose null space keeps motors from limits and the robot from the snap.

Damped least squares (Nakamura, Hanafusa, Inverse Kinematic Solutions with Singularity Robustness, J. Dyn. Syst.
Meas. Control 108, 1986) in the norm of Chan and Dubey (A Weighted Least-Norm Solution Based Scheme for Avoiding
Joint Limits, IEEE Trans. Robotics and Automation 11(2), 1995). In the null space motors follow the gradient of a
criterion (Liegeois, IEEE Trans. Systems, Man and Cybernetics 7(12), 1977): the logarithm of det(d alpha / d phi),
which is 0 at the snap, as long as it is less than SAFE_STABILITY_DETERMINANT; beyond, it would align all tubes.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.background import Library
from ctr_nlp.codegen.batch_evaluator import BatchEvaluator
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.protocol import symbolic_tubes
from ctr_nlp.ocp.expressions import ProgramExpressions
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot import Robot
from ctr_nlp.robot.robot import mm_per_unit
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure
from ctr_nlp.typing import Array
from reference.descent import Method
from reference.tip_jacobian import CLOSE_MM

ELASTIC_MODEL = KINEMATIC_MODELS["elastic"]
MIN_TIP_DAMPING, SINGULARITY_DAMPING, SINGULAR_MANIPULABILITY = 0.05, 3.0, 0.3
"""mu of the damped inverse J' (J J' + mu^2 I)^-1, in mm/mm: the least one, and what is added near singularities,
the more the less sqrt det J J' is than the third.
"""
MAX_TIP_STEPS_PER_FRAME = 50
"""Steps of control in a frame at most: 1 kHz for 50 ms."""
MAX_TIP_STEP_MM, MAX_NULL_SPACE_STEP_MM = 2.0, 0.05
"""mm that the tip is asked to move by in one step, and motors in the null space, angles by Robot.mm_per_unit."""
SAFE_STABILITY_DETERMINANT = 3.0
"""The determinant from which on the robot is far from the snap; of aligned tubes it is 7 to 16 (Table I)."""
NULL_SPACE_GAIN_MM2 = 3.0
"""mm^2: how much of the criterion's gradient, 1/mm, the null space follows in a step."""
LIMITED_MOTOR_WEIGHT, MAX_LIMIT_PASSES = 1e8, 3
"""The weight of motors that would leave their limits, which are asked of the others; how often this is done."""
MAX_REMAINING_DISTANCE_RATIO = 0.999
"""Part of the tip's distance that must be left at most after a step; else the target is out of reach."""
STANDSTILL_STEP_MM = 1e-3
"""mm that motors move by in a step, below which they stand."""
MIN_LIMIT_DISTANCE_FRACTION = 1e-3
"""Part of the way between two limits that a motor counts as away from them, where it is nearer."""


def tip_resolved(problem: Problem, motion_weight: float) -> Method:
    """Return the method for a problem; `motion_weight` is ignored."""
    del motion_weight
    robot = problem.robot
    steering = TipSteering(robot)

    def solve(frame: Frame, guess: Array, before: FrameResult | None) -> FrameResult:
        x = ELASTIC_MODEL.rest(robot, guess) if before is None or before.x is None else before.x
        steps = 0
        last = np.inf
        distance = np.inf
        while steps < MAX_TIP_STEPS_PER_FRAME and np.isfinite(x).all():
            new, distance, moved = steering.step(x, frame.points[-1])
            steps += 1
            if moved < STANDSTILL_STEP_MM or (
                distance > CLOSE_MM and distance > MAX_REMAINING_DISTANCE_RATIO * last
            ):
                break
            x = new
            last = distance
        if not np.isfinite(x).all():
            return FrameResult(guess, False, np.inf, np.nan, steps, "no equilibrium")
        q = ELASTIC_MODEL.configuration(robot, x[None])[0]
        return FrameResult(q, distance < 1.0, distance**2, np.nan, steps, f"tip within {distance:.3g} mm", x=x)

    return solve


class TipSteering:
    """Steps of a robot's tip, each a call of one compiled function, of some microseconds; one object a thread."""

    def __init__(self, robot: Robot) -> None:
        """Build the function of a step, which is interpreted until a compiled one is there."""
        self._robot = robot
        self._function, self._compiled = _fastest_function(robot.structure)
        self._mapped = self._map_function()

    def step(self, x: Array, goal: Array) -> tuple[Array, float, float]:
        """Unknowns (2d + 2,) after a step from x (2d + 2,) towards a tip at goal (3,), mm.

        Then how far the tip was from there, mm, and how far motors move, mm, angles by Robot.mm_per_unit.
        """
        if not self._compiled:
            self._function, self._compiled = _fastest_function(self._robot.structure)
            self._mapped = self._map_function() if self._compiled else self._mapped
        new, told = self._mapped(np.concatenate([x, goal]))
        return new[0].copy(), float(told[0, 0]), float(told[0, 1])

    def _map_function(self) -> BatchEvaluator:
        found = BatchEvaluator(self._function, 1)
        robot = self._robot
        found.inputs[1][0] = np.concatenate([robot.numbers.ravel(order="F"), robot.lower, robot.upper])
        return found


@functools.lru_cache(maxsize=64)
def step_function(structure: Structure) -> ca.Function:
    """(x and goal, numbers and limits) -> (x after a step, [distance of the tip, what motors move by])."""
    d = structure.d
    numbers = ca.SX.sym("numbers", d, len(TUBE_NUMBER_NAMES))
    limits = ca.SX.sym("limits", 2 * d + 2, 2)
    goal = ca.SX.sym("goal", 3)
    none = ca.SX(0)
    shape = ELASTIC_MODEL.frame(structure, symbolic_tubes(structure, numbers), lambda beta: beta[-1], none)
    theta = shape.x[2 * d :]
    far_from_snap = (
        ca.SX(0) if shape.stability is None else ca.log(ca.fmin(shape.stability[-1], SAFE_STABILITY_DETERMINANT))
    )
    told: list[Any] = [ca.vertcat(*shape.to_base_frame(shape.points)), shape.alpha, far_from_snap]
    tip, alpha, criterion = ProgramExpressions.without([shape.inner.columns], told)
    q = ca.vertcat(alpha, *shape.beta, theta)
    scale = ca.DM(mm_per_unit(d))
    by_q = ca.solve(ca.jacobian(q, shape.x), ca.SX.eye(2 * d + 2))  # dx / dq
    jacobian, uphill = (ca.jacobian(each, shape.x) @ by_q @ ca.diag(1 / scale) for each in (tip, criterion))
    far = ca.norm_2(goal - tip)
    wanted = (goal - tip) * ca.fmin(1.0, MAX_TIP_STEP_MM / (far + 1e-12))
    weights = _limit_weights(q, limits, scale)
    kept = q
    for _ in range(MAX_LIMIT_PASSES):
        aim = q + _resolve_motor_step(jacobian, uphill.T, weights, wanted) / scale
        kept = _clip_to_limits(aim, limits, d)
        weights = ca.if_else(ca.fabs(aim - kept) > 0, LIMITED_MOTOR_WEIGHT, weights)
    found = shape.x + by_q @ (kept - q)
    given = ca.vertcat(shape.x, goal), ca.vertcat(ca.vec(numbers), ca.vec(limits))
    return ca.Function("resolved", given, [found, ca.vertcat(far, ca.norm_2((kept - q) * scale))], {"cse": True})


def _limit_weights(q: ca.SX, limits: ca.SX, scale: ca.DM) -> ca.SX:
    """1 + |dH/dq| of each motor, H = sum (u - l)^2 / (4 (u - q) (q - l)), in the mm that motors are told in."""
    low = limits[:, 0]
    high = limits[:, 1]
    room = high - low
    below, above = (ca.fmax(each, MIN_LIMIT_DISTANCE_FRACTION * room) for each in (q - low, high - q))
    slope = room**2 * (2 * q - high - low) / (4 * (above * below) ** 2)
    return 1 + ca.if_else(ca.fabs(room) < 1e6, ca.fabs(slope) / scale, 0.0)


def _resolve_motor_step(jacobian: ca.SX, uphill: ca.SX, weights: ca.SX, wanted: ca.SX) -> ca.SX:
    """Return the motors' movements (2d + 2,), mm: for the tip by damped least squares, and uphill in the null
    space.

    jacobian (3, 2d + 2): of the tip; uphill (2d + 2,): gradient of the criterion; weights (2d + 2,): of motors,
    the heavier the less they move; wanted (3,): movement of the tip.
    """
    root = ca.sqrt(weights)
    light = jacobian @ ca.diag(1 / root)
    square = light @ light.T
    near = 1 - ca.fmin(1.0, ca.sqrt(ca.fmax(ca.det(square), 0.0)) / SINGULAR_MANIPULABILITY)
    inverse = light.T @ ca.solve(
        square + (MIN_TIP_DAMPING**2 + (SINGULARITY_DAMPING * near) ** 2) * ca.SX.eye(3), ca.SX.eye(3)
    )
    along = NULL_SPACE_GAIN_MM2 * uphill / root
    free = along - inverse @ (light @ along)
    free *= ca.fmin(1.0, MAX_NULL_SPACE_STEP_MM / (ca.norm_2(free) + 1e-12))
    return (inverse @ wanted + free) / root


def _clip_to_limits(q: ca.SX, limits: ca.SX, d: int) -> ca.SX:
    """Clip a configuration to its limits entry by entry; an outer tube gives way to the inner one."""
    entries = ca.vertsplit(ca.fmin(ca.fmax(q, limits[:, 0]), limits[:, 1]))
    for i in reversed(range(d, 2 * d - 1)):
        entries[i] = ca.fmax(ca.fmin(entries[i], entries[i + 1]), limits[i, 0])
    return ca.vertcat(*entries)


@functools.lru_cache(maxsize=64)
def _library(structure: Structure) -> Library:
    return Library(step_function(structure).serialize(), functools.partial(_functions, structure), 1)


def _functions(structure: Structure) -> tuple[ca.Function]:
    return (step_function(structure),)


def _fastest_function(structure: Structure) -> tuple[ca.Function, bool]:
    """Return the function of robots of a structure, and whether it is compiled."""
    structure = replace(structure, gap=False)
    if not cache.unavailable_reason() and (path := _library(structure).path_if_ready()) is not None:
        return ca.external("resolved", str(path)), True
    return step_function(structure), False
