"""How far a plan's configurations are from the known ones, up to what no shape can tell."""

from __future__ import annotations

import numpy as np

from ctr_nlp.plan.plan import Plan
from ctr_nlp.simulation.forward import other_way
from ctr_nlp.typing import Array, Flags


def error_from_truth(plan: Plan) -> Array:
    """The error q - truth (T, 2d + 2) in rad, mm, where the truth is known; NaN for frames never reached.

    Two things that leave every shape as it is do not count. Whole turns of any angle. And the two ways to
    write one rotation, R(theta_x, theta_y) Rz(alpha) = R(pi - theta_x, theta_y + pi) Rz(alpha + pi): the
    truth is written in the way that is nearer to the plan, the same for the whole motion.
    """
    assert plan.truth is not None
    q, d = plan.q, plan.robot.d
    angles = np.r_[:d, 2 * d : 2 * d + 2]
    errors = []
    for truth in (plan.truth, other_way(plan.robot, plan.truth)):
        error = q - truth
        error[:, angles] = without_whole_turns(error[:, angles])
        errors.append(error)
    return min(errors, key=lambda error: float(np.nansum(np.abs(error[:, angles]))))


def without_whole_turns(angle: Array) -> Array:
    """Angles (T, n) in rad without jumps of whole turns from frame to frame, and each column nearest to zero."""
    result = np.array(angle, dtype=float)
    known = np.isfinite(result).all(axis=1)
    if known.any():
        smooth = np.unwrap(result[known], axis=0)
        result[known] = smooth - 2 * np.pi * np.round(np.median(smooth, axis=0) / (2 * np.pi))
    return result


def indistinct(plan: Plan) -> Flags:
    """Frames (T,) whose known theta_x is within 0.05 rad of +-pi/2, where alpha and theta_y are one rotation."""
    assert plan.truth is not None
    return np.abs(np.cos(plan.truth[:, -2])) < np.sin(0.05)
