"""Joint formulation: all of q in one NLP, eq. (9) with the distance (8) at equal sigma."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ctr_nlp import terms
from ctr_nlp.formulations.stage import Stage
from ctr_nlp.models import dominant
from ctr_nlp.nlp import Nlp
from ctr_nlp.robot import Robot
from ctr_nlp.settings import Settings
from ctr_nlp.target import SIGMA

STRIDE = 5
"""Every STRIDE-th of the target's 101 samples enters the NLP, 21 in all."""


def joint(robot: Robot, settings: Settings) -> tuple[Stage, ...]:
    """One stage that decides q itself, so that bounds and step limits are bounds of the NLP."""
    n = 2 * robot.d + 2
    sigma = SIGMA[::STRIDE]
    weights = np.full(len(sigma), 1 / (len(sigma) - 1))
    weights[[0, -1]] /= 2
    q, previous, root = ca.SX.sym("q", n), ca.SX.sym("previous", n), ca.SX.sym("motion_root")
    target = ca.SX.sym("target", len(sigma), 3)
    entries = ca.vertsplit(q)
    points = dominant.backbone(robot, entries, ca.DM(sigma), ca).points
    nlp = Nlp(
        "joint",
        q,
        robot.lower,
        robot.upper,
        {"target": target, "previous": previous, "motion_root": root},
        residuals=(
            terms.shape(points, target, ca.DM(weights)),
            terms.motion(q, previous, robot.mm_per_unit, root),
        ),
        constraints=terms.order(robot, entries[robot.d : 2 * robot.d]),
    )
    return (Stage(nlp, np.arange(n), lambda frame, q: {"target": frame.points[::STRIDE]}),)
