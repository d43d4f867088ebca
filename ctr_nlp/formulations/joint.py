"""Joint formulation: all of q in one NLP, eq. (9) with the distance (8) at equal sigma."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp import terms
from ctr_nlp.formulations.stage import Stage
from ctr_nlp.models import dominant
from ctr_nlp.nlp import Inner, Nlp
from ctr_nlp.robot import Robot
from ctr_nlp.settings import Settings
from ctr_nlp.target import SIGMA, Frame

STRIDE = 5
"""Every STRIDE-th of the target's 101 samples enters the NLP, 21 in all."""


def alone(robot: Robot, stride: int = STRIDE) -> Nlp:
    """One frame without neighbours: q with its bounds and order, and the distance (8) to the target.

    stride: every so many-th of the target's samples is used.
    """
    sigma = SIGMA[::stride]
    weights = np.full(len(sigma), 1 / (len(sigma) - 1))
    weights[[0, -1]] /= 2
    q, target = ca.SX.sym("q", 2 * robot.d + 2), ca.SX.sym("target", len(sigma), 3)
    entries = ca.vertsplit(q)
    beta = entries[robot.d : 2 * robot.d]
    travelled = [ca.horzcat(side, along) for side, along, _ in dominant.arms(robot, beta, ca.DM(sigma), ca)]
    planes = [ca.horzcat(ca.vertcat(*bend), ca.vertcat(*t)) for bend, t in dominant.directions(robot, entries, ca)]
    inner = Inner.of(travelled + planes)
    arms = (ca.horzsplit(symbol) for symbol in inner.symbols[: robot.d])
    bends = ([ca.vertsplit(vector) for vector in ca.horzsplit(symbol)] for symbol in inner.symbols[robot.d :])
    points = dominant.points(list(arms), list(bends))
    return Nlp(
        "frame",
        q,
        robot.lower,
        robot.upper,
        {"target": target},
        residuals=(terms.shape(points, target, ca.DM(weights)),),
        constraints=terms.order(robot, beta),
        inner=inner,
    )


def target_of(frame: Frame) -> dict[str, Any]:
    """The parameters of `alone` for a frame."""
    return {"target": frame.points[::STRIDE]}


def joint(robot: Robot, settings: Settings) -> tuple[Stage, ...]:
    """One stage that decides q itself, so that bounds and step limits are bounds of the NLP."""
    frame = alone(robot)
    previous, root = ca.SX.sym("previous", frame.x.numel()), ca.SX.sym("motion_root")
    nlp = replace(
        frame,
        name="joint",
        parameters={**frame.parameters, "previous": previous, "motion_root": root},
        residuals=(*frame.residuals, terms.motion(frame.x, previous, robot.mm_per_unit, root)),
    )
    return (Stage(nlp, np.arange(nlp.x.numel()), lambda at, q: target_of(at)),)
