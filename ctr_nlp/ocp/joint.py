"""Joint formulation: all of q in one program, eq. (9) with the distance (8) at equal sigma.

Limits (2), (3) and speeds |q - q_before| <= v dt are bounds and constraints of the same program, instead of two
programs one after another as in the paper: errors are smaller, since beta and alpha can make up for each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.ocp.frame import fill_parameters, program
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.stage import Stage
from ctr_nlp.ocp.terms import LoadTerm, LumenClearance, Margin, MotionCost, Order, ShapeDistance, Term
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

MIN_TIP_STEP_LIMIT_RAD, TIP_TO_MOTOR_SPEED_RATIO = 0.5, 2.0
"""Where there are several equilibria, tips may turn from frame to frame by MIN_TIP_STEP_LIMIT_RAD, rad, or by
TIP_TO_MOTOR_SPEED_RATIO times what motors may, whichever is more.
"""


def frame_terms(
    robot: Robot, model: Model, margin: float | None, extra: Sequence[Term] = (), walled: bool = False
) -> tuple[Term, ...]:
    """Return the terms of a frame of a robot on a model, with the extra ones given.

    margin: the least stability margin, on models that can snap; None for any. extra: further terms; a
    ShapeDistance among these replaces the usual one. walled: whether the lumen's wall counts, as a soft
    constraint.
    """
    # A user's ShapeDistance, with weights along sigma, takes the place of the usual one instead of adding
    # to it.
    own: list[Term] = [] if any(isinstance(term, ShapeDistance) for term in extra) else [ShapeDistance()]
    # A model whose equilibria are always stable has nothing to constrain.
    held: list[Term] = [Margin(margin)] if margin is not None and model.can_snap else []
    wall: list[Term] = [LumenClearance(robot.d)] if walled else []
    load: list[Term] = [] if model.applied_load is None else [LoadTerm(model.applied_load, robot.d)]
    return (*own, *extra, *load, *held, Order(robot.carriage_gap), *wall)


def tip_step_limits(robot: Robot, dt: float) -> Array:
    """Return the angles (d,) in rad that tips of a robot may turn by in a frame of dt s.

    They are larger than the motors' own steps, and smaller than the jump of a tip that snaps.
    """
    return np.maximum(MIN_TIP_STEP_LIMIT_RAD, TIP_TO_MOTOR_SPEED_RATIO * robot.speed[: robot.d] * dt)


def joint(
    robot: Robot, settings: Settings, model: Model, extra: Sequence[Term] = (), walled: bool = False
) -> tuple[Stage, ...]:
    """Return one stage that decides all of q, so that bounds and step limits are bounds of the program.

    robot, model: what is planned on. settings: of which the stability margin counts. extra, walled: as in
    frame_terms.
    """
    terms = (*frame_terms(robot, model, settings.stability_margin, extra, walled), MotionCost(robot.d))
    # The program depends on the structure alone; the robot's numbers enter as parameters in `filled`.
    nlp = program("joint", robot.structure, model, terms)
    return (Stage(nlp, np.arange(len(robot.axes)), lambda frame, q: fill_parameters(robot, terms, frame)),)
