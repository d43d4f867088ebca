"""Tip steering on the elastic model, whose null space keeps motors from limits and the robot from the snap.

Damped least squares (Nakamura, Hanafusa, Inverse Kinematic Solutions with Singularity Robustness, J. Dyn. Syst.
Meas. Control 108, 1986) in the norm of Chan and Dubey (A Weighted Least-Norm Solution Based Scheme for Avoiding
Joint Limits, IEEE Trans. Robotics and Automation 11(2), 1995). In the null space motors follow the gradient of a
criterion (Liegeois, IEEE Trans. Systems, Man and Cybernetics 7(12), 1977): the logarithm of det(d alpha / d phi),
which is 0 at the snap, as long as it is less than SAFE_STABILITY_DETERMINANT; beyond, it would align all tubes.

    dq' = J'^+ e + (I - J'^+ J') g',   J' = J S^-1/2,   J'^+ = J'^T (J' J'^T + mu^2 I)^-1,   dq = S^-1/2 dq'

with J the Jacobian of the tip over the motors q in mm (angles by W, 10 mm/rad), S the motors' weights, e the tip's
error and g the criterion's gradient. What differs from the publications: mu^2 has a constant part beside
Nakamura and Hanafusa's k_0 (1 - w / w_0)^2; weights of Chan and Dubey count on the way away from a limit, too;
motors that would leave their limits are weighted out of the step, which is then resolved again; and the criterion
is the distance from the snap, where Liegeois' is that from limits. The model is the torsionally compliant one.
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
in proportion to 1 - w / w_0, where the manipulability w = sqrt det J J' is less than w_0, the third.
"""
MAX_TIP_STEPS_PER_FRAME = 50
"""Largest number of control steps in a frame: 50 ms at 1 kHz."""
MAX_TIP_STEP_MM, MAX_NULL_SPACE_STEP_MM = 2.0, 0.05
"""Largest movement in one step, mm: of the tip, and of motors in the null space (angles by Robot.mm_per_unit)."""
SAFE_STABILITY_DETERMINANT = 3.0
"""det(d alpha / d phi) above which the robot is far from the snap; for aligned tubes of Table I it is 7 to 16."""
NULL_SPACE_GAIN_MM2 = 3.0
"""Gain from the criterion's gradient, 1/mm, to the step in the null space, mm; mm^2."""
LIMITED_MOTOR_WEIGHT, MAX_LIMIT_PASSES = 1e8, 3
"""Weight of motors that would leave their limits, so that others move instead; number of such passes in a step."""
MAX_REMAINING_DISTANCE_RATIO = 0.999
"""A target is out of reach where a step leaves more than this part of the tip's distance."""
STANDSTILL_STEP_MM = 1e-3
"""Motors stand still where they move by less than this in a step, mm."""
MIN_LIMIT_DISTANCE_FRACTION = 1e-3
"""Least distance of a motor from a limit that its weight is computed with, relative to its range."""


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
        # `distance` is that of x, before the step. Where it has hardly fallen since the last step, or motors stand
        # still, x is final and the step is dropped.
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
    """Control steps of a robot's tip: one call of a compiled function each, some microseconds.

    An object must not be shared by threads.
    """

    def __init__(self, robot: Robot) -> None:
        """Build the function of a step for a robot; it is interpreted until its compiled form is ready."""
        self._robot = robot
        self._function, self._compiled = _fastest_function(robot.structure)
        self._mapped = self._map_function()

    def step(self, x: Array, goal: Array) -> tuple[Array, float, float]:
        """Make one step from unknowns x (2d + 2,) towards a tip at goal (3,), mm.

        Returns the unknowns (2d + 2,) after it; the distance of the tip from the goal before it, mm; and the norm
        of the motors' movements, mm, with angles by Robot.mm_per_unit.
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
    """Build the CasADi function of one control step, for all robots of a structure.

    It maps (x and goal, numbers and limits) to (x after the step, [distance of the tip, movement of the motors]),
    mm; see TipSteering.step.
    """
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
    # alpha is an explicit function of the unknowns x: dq/dx is differentiated and inverted. It is singular at the
    # snap, where the motors no longer determine the robot.
    by_q = ca.solve(ca.jacobian(q, shape.x), ca.SX.eye(2 * d + 2))  # dx / dq
    jacobian, uphill = (ca.jacobian(each, shape.x) @ by_q @ ca.diag(1 / scale) for each in (tip, criterion))
    far = ca.norm_2(goal - tip)
    # The Jacobian holds near the present pose only. 1e-12 keeps a tip that has arrived from dividing by 0.
    wanted = (goal - tip) * ca.fmin(1.0, MAX_TIP_STEP_MM / (far + 1e-12))
    weights = _limit_weights(q, limits, scale)
    kept = q
    # Motors that were clipped get a weight that all but freezes them, and the step is resolved among the others.
    # The number of passes is fixed, since a compiled expression has no loop that ends early.
    for _ in range(MAX_LIMIT_PASSES):
        aim = q + _resolve_motor_step(jacobian, uphill.T, weights, wanted) / scale
        kept = _clip_to_limits(aim, limits, d)
        weights = ca.if_else(ca.fabs(aim - kept) > 0, LIMITED_MOTOR_WEIGHT, weights)
    found = shape.x + by_q @ (kept - q)
    given = ca.vertcat(shape.x, goal), ca.vertcat(ca.vec(numbers), ca.vec(limits))
    return ca.Function("resolved", given, [found, ca.vertcat(far, ca.norm_2((kept - q) * scale))], {"cse": True})


def _limit_weights(q: ca.SX, limits: ca.SX, scale: ca.DM) -> ca.SX:
    """Compute the weights of Chan and Dubey, 1 + |dH/dq| of each motor, with motors in mm.

    H = sum (u - l)^2 / (4 (u - q) (q - l)) with limits (2d + 2, 2), l and u, of q (2d + 2,). scale: mm per unit of
    each motor.
    """
    low = limits[:, 0]
    high = limits[:, 1]
    room = high - low
    # At a limit H has a pole: a motor counts as a little away from it.
    below, above = (ca.fmax(each, MIN_LIMIT_DISTANCE_FRACTION * room) for each in (q - low, high - q))
    slope = room**2 * (2 * q - high - low) / (4 * (above * below) ** 2)
    # Motors without limits have an infinite range, whose slope is NaN; if_else drops it.
    return 1 + ca.if_else(ca.fabs(room) < 1e6, ca.fabs(slope) / scale, 0.0)


def _resolve_motor_step(jacobian: ca.SX, uphill: ca.SX, weights: ca.SX, wanted: ca.SX) -> ca.SX:
    """Compute the motors' movements (2d + 2,) in mm: damped least squares for the tip, uphill in the null space.

    jacobian (3, 2d + 2): of the tip; uphill (2d + 2,): gradient of the criterion, 1/mm; weights (2d + 2,): of
    motors, the heavier the less they move; wanted (3,): movement of the tip, mm.
    """
    root = ca.sqrt(weights)
    light = jacobian @ ca.diag(1 / root)
    square = light @ light.T
    # det J J^T is not negative but for rounding. near is 1 - w / w_0, 0 far from singularities.
    near = 1 - ca.fmin(1.0, ca.sqrt(ca.fmax(ca.det(square), 0.0)) / SINGULAR_MANIPULABILITY)
    inverse = light.T @ ca.solve(
        square + (MIN_TIP_DAMPING**2 + (SINGULARITY_DAMPING * near) ** 2) * ca.SX.eye(3), ca.SX.eye(3)
    )
    along = NULL_SPACE_GAIN_MM2 * uphill / root
    free = along - inverse @ (light @ along)
    free *= ca.fmin(1.0, MAX_NULL_SPACE_STEP_MM / (ca.norm_2(free) + 1e-12))
    return (inverse @ wanted + free) / root


def _clip_to_limits(q: ca.SX, limits: ca.SX, d: int) -> ca.SX:
    """Clip q (2d + 2,) of d tubes to limits (2d + 2, 2) entry by entry; outer tubes give way to inner ones."""
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
    """Return the function of a step for robots of a structure, and whether it is compiled."""
    # The carriage gap has no part in a step: robots that differ in it alone share one compiled function.
    structure = replace(structure, gap=False)
    if not cache.unavailable_reason() and (path := _library(structure).path_if_ready()) is not None:
        return ca.external("resolved", str(path)), True
    return step_function(structure), False
