"""The seed's two stages: curvature to extensions, eqs. (10)-(11), then extensions to rotations, eq. (12)."""

from __future__ import annotations

import itertools
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.stage import Stage
from ctr_nlp.models import dominant
from ctr_nlp.nlp import terms
from ctr_nlp.nlp.nlp import Nlp
from ctr_nlp.robot import Robot
from ctr_nlp.target.target import SIGMA, Frame
from ctr_nlp.typing import Array

TIGHTENING = (6.0, 2.5, 1.0)
"""Widths of the smoothed jumps of curvature, in units of the last, solved for one after the other."""
LENGTH_WEIGHT = 100.0
"""Weight of (beta_d - length)^2 in stage one: eq. (11) does not see how far the robot is out."""


def two_stage(robot: Robot, settings: Settings, model: str = "dominant") -> tuple[Stage, ...]:
    """Extension with smoothed jumps of curvature, tightened to settings.jump_width; then rotation."""
    _check_model(model)
    return _extension(robot, tuple(factor * settings.jump_width for factor in TIGHTENING)), _rotation(robot)


def two_stage_exact(robot: Robot, settings: Settings, model: str = "dominant") -> tuple[Stage, ...]:
    """Extension with the integral (11) itself, through the target's cumulative integrals; then rotation."""
    _check_model(model)
    return _extension(robot, None), _rotation(robot)


def _check_model(model: str) -> None:
    if model != "dominant":
        raise OptionError(
            f"model is {model!r}; two-stage formulations need 'dominant', where alpha does not change curvatures"
        )


def _extension(robot: Robot, widths: tuple[float, ...] | None) -> Stage:
    """Stage one decides beta; widths = None takes the exact form."""
    beta, previous = ca.SX.sym("beta", robot.d), ca.SX.sym("previous", robot.d)
    length, root, width = ca.SX.sym("length"), ca.SX.sym("motion_root"), ca.SX.sym("width")
    kappa, turning = ca.SX.sym("kappa", len(SIGMA)), ca.SX.sym("turning", len(SIGMA))
    entries = ca.vertsplit(beta)
    decides = np.arange(robot.d, 2 * robot.d)
    parameters = {"turning": turning, "length": length, "previous": previous, "motion_root": root}
    residuals = (
        terms.length(entries[-1], length, LENGTH_WEIGHT),
        terms.motion(beta, previous, robot.mm_per_unit[decides], root),
    )
    if widths is None:
        parameters["kappa"] = kappa
        curvature = terms.curvature_exact(robot, entries, kappa, turning, length)
    else:
        parameters["width"] = width
        curvature = terms.curvature(robot, entries, turning, length, width)

    def fill(frame: Frame, q: Array) -> dict[str, Any]:
        values = {"turning": frame.turning, "length": frame.length}
        return values | {"kappa": frame.curvature} if widths is None else values

    nlp = Nlp(
        "extension",
        beta,
        robot.lower[decides],
        robot.upper[decides],
        parameters,
        residuals,
        (curvature,),
        terms.order(robot, entries),
    )
    return Stage(nlp, decides, fill, ({},) if widths is None else tuple({"width": w} for w in widths))


def _rotation(robot: Robot) -> Stage:
    """Stage two decides alpha and theta at given beta, sampled at the ends and midpoint of every segment.

    Simpson's rule over these samples is the distance (8); each stands opposite the target's point of the
    same sigma.
    """
    d = robot.d
    decides = np.concatenate([np.arange(d), np.arange(2 * d, 2 * d + 2)])
    x, previous = ca.SX.sym("alpha_theta", d + 2), ca.SX.sym("previous", d + 2)
    beta, root, target = ca.SX.sym("beta", d), ca.SX.sym("motion_root"), ca.SX.sym("target", 2 * d, 3)
    entries = ca.vertsplit(ca.vertcat(x[:d], beta, x[d:]))
    sigma, quadrature = _samples(ca.vertsplit(beta), ca)
    points = dominant.backbone(robot, entries, ca.vertcat(*sigma), ca).points
    x_target, y_target, z_target = ca.horzsplit(target)
    nlp = Nlp(
        "rotation",
        x,
        robot.lower[decides],
        robot.upper[decides],
        {"beta": beta, "target": target, "previous": previous, "motion_root": root},
        residuals=(
            terms.shape(points, (x_target, y_target, z_target), ca.vertcat(*quadrature)),
            terms.motion(x, previous, robot.mm_per_unit[decides], root),
        ),
    )

    def fill(frame: Frame, q: Array) -> dict[str, Any]:
        extensions = robot.split(q)[1]
        sigma, _ = _samples(extensions, np)
        return {"beta": extensions, "target": frame.at(np.array(sigma))}

    return Stage(nlp, decides, fill)


def _samples(beta: Any, xp: Any) -> tuple[list[Any], list[Any]]:
    """Sigma at the midpoints, then the ends of all segments, and Simpson's weights there.

    The base point never moves and is left out. A solver's beta may break the order by its tolerance, and
    weights must not become negative.
    """
    edges = [0 * beta[0], *(beta[i] for i in range(len(beta)))]
    widths = [xp.fmax(high - low, 0) / beta[-1] for low, high in itertools.pairwise(edges)]
    middles = [(low + high) / 2 / beta[-1] for low, high in itertools.pairwise(edges)]
    at_ends = [(low + high) / 6 for low, high in itertools.pairwise([*widths, 0])]
    sigma = [*middles, *(edge / beta[-1] for edge in edges[1:])]
    return sigma, [*(4 * width / 6 for width in widths), *at_ends]
