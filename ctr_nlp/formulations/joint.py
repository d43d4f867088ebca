"""Joint formulation: all of q in one NLP, eq. (9) with the distance (8) at equal sigma."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.formulations import contact
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.stage import Stage
from ctr_nlp.models import MODELS
from ctr_nlp.nlp import terms
from ctr_nlp.nlp.nlp import Nlp
from ctr_nlp.robot import Robot
from ctr_nlp.simulation.following import settled, untwisted
from ctr_nlp.target.target import SIGMA, Frame
from ctr_nlp.typing import Array

STRIDE = 5
"""Every STRIDE-th of the target's 101 samples enters the NLP, 21 in all."""
TIP_STEP, TIP_SPEED = 0.5, 2.0
"""On the elastic model tips may turn by the first, rad, from frame to frame, or by this times what motors may."""


def alone(
    robot: Robot, model: str = "dominant", stable: bool = False, stride: int = STRIDE, walled: bool = False
) -> Nlp:
    """One frame without neighbours: its unknowns with all limits, and the distance (8) to the target.

    stable: with the least stability margin on the elastic model as a parameter, margin. stride: every so many-th
    of the target's samples is used. walled: kept within a lumen, as far as that goes.
    """
    sigma = ca.DM(SIGMA[::stride])
    weights = np.full(sigma.numel(), 1 / (sigma.numel() - 1))
    weights[[0, -1]] /= 2
    parameters = {"target": ca.SX.sym("target", sigma.numel(), 3)}
    if stable:
        parameters["margin"] = ca.SX.sym("margin")

    def places(beta: Sequence[ca.SX]) -> ca.SX:
        return ca.vertcat(sigma * beta[-1], *(contact.arc_lengths(beta) if walled else ()))

    shape = MODELS[model](robot, places, parameters.get("margin"))
    motors = () if shape.picks is None else (terms.motors(robot, shape.alpha),)
    x, y, z = (axis[: sigma.numel()] for axis in shape.points)
    frame = Nlp(
        "frame",
        shape.x,
        shape.lower,
        shape.upper,
        parameters,
        residuals=(terms.shape((x, y, z), shape.seen(parameters["target"]), ca.DM(weights)),),
        constraints=(*motors, *map(terms.stability, shape.stability), *terms.order(robot, shape.beta)),
        inner=(shape.inner,),
        picks=shape.picks,
    )
    return contact.walled(frame, shape) if walled else frame


def tip_steps(robot: Robot, dt: float) -> Array:
    """What tips (d,) may turn by in a frame of dt s, rad: more than motors, and less than where a robot snaps."""
    return np.maximum(TIP_STEP, TIP_SPEED * robot.speed[: robot.d] * dt)


def target_of(frame: Frame, margin: float | None = None) -> dict[str, Any]:
    """The parameters of `alone` for a frame; margin where it is stable."""
    return {"target": frame.points[::STRIDE]} | ({} if margin is None else {"margin": margin})


def joint(robot: Robot, settings: Settings, model: str = "dominant", walled: bool = False) -> tuple[Stage, ...]:
    """One stage that decides all of q, so that bounds and step limits are bounds of the NLP; walled: as alone."""
    margin = settings.stability_margin if model == "elastic" else None
    frame = alone(robot, model, margin is not None, walled=walled)
    previous, root = ca.SX.sym("previous", len(robot.axes)), ca.SX.sym("motion_root")
    nlp = replace(
        frame,
        name="joint",
        parameters={**frame.parameters, "previous": previous, "motion_root": root},
        residuals=(*frame.residuals, terms.motion(frame.q[: len(robot.axes)], previous, robot.mm_per_unit, root)),
    )
    stage = Stage(nlp, np.arange(len(robot.axes)), lambda at, q: target_of(at, margin))
    if model == "elastic":
        rest, guess = (functools.partial(start, robot) for start in (settled, untwisted))
        stage = replace(stage, rest=rest, guess=guess)
    return (stage,)
