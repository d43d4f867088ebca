"""The paper's two stages: curvature to extensions, eqs. (10)-(11), then extensions to rotations, eq. (12).

On the dominant model the curvature along the robot depends on beta alone. Stage one finds beta from it
(curvature.py), with a term for the robot's length, which eq. (11) does not see; stage two finds alpha and theta at
this beta from the distance (8). Both have the motion term of eq. (9). Objectives are in mm^2, unknowns in rad and
mm.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS, Model
from ctr_nlp.models.dominant import shape
from ctr_nlp.models.protocol import columns_of, symbolic_tubes
from ctr_nlp.ocp import curvature
from ctr_nlp.ocp.frame import MAX_CACHED_FRAME_PROGRAMS, robot_values
from ctr_nlp.ocp.nlp import Nlp
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.stage import Stage
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.terms.feasible import order
from ctr_nlp.ocp.terms.motion import motion_residual
from ctr_nlp.ocp.terms.shape import shape_residual
from ctr_nlp.paths.target import SIGMA_GRID, Frame
from ctr_nlp.robot import Robot
from ctr_nlp.robot.robot import mm_per_unit
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure
from ctr_nlp.typing import Array

JUMP_WIDTH_FACTORS = (6.0, 2.5, 1.0)
"""Widths of the smoothed jumps of curvature, in units of the last, solved for one after the other."""
DEPLOYED_LENGTH_WEIGHT = 100.0
"""Weight of (beta_d - length)^2 in stage one: eq. (11) does not depend on how far the robot is out."""


def two_stage(robot: Robot, settings: Settings, model: Model, extra: Sequence[Term] = ()) -> tuple[Stage, ...]:
    """Return a stage with smoothed jumps of curvature, tightened to settings.jump_width, and one for rotations.

    robot: what is planned for. model: one where alpha does not change curvatures. extra: must be empty. Raises
    OptionError.
    """
    _check_model_and_terms(model, extra)
    return _extension(robot, tuple(factor * settings.jump_width for factor in JUMP_WIDTH_FACTORS)), _rotation(
        robot
    )


def two_stage_exact(
    robot: Robot, settings: Settings, model: Model, extra: Sequence[Term] = ()
) -> tuple[Stage, ...]:
    """Return a stage with the integral (11) itself, and one for rotations.

    robot: what is planned for. settings: not used, as nothing is smoothed. model, extra: as in two_stage. Raises
    OptionError.
    """
    _check_model_and_terms(model, extra)
    return _extension(robot, None), _rotation(robot)


def _check_model_and_terms(model: Model, extra: Sequence[Term]) -> None:
    """Raise OptionError for a model whose curvature depends on alpha, and for further terms."""
    if not model.bends_by_extension:
        allowed = ", ".join(repr(name) for name, each in KINEMATIC_MODELS.items() if each.bends_by_extension)
        raise OptionError(
            f"model is {model.name!r}; two-stage formulations need {allowed}, where alpha does not change "
            "curvatures"
        )
    if extra:
        raise OptionError(
            f"the term {extra[0].name} is given; two-stage formulations have terms of their own; use the joint "
            "formulation, or a horizon"
        )


def _extension(robot: Robot, widths: tuple[float, ...] | None) -> Stage:
    """Return stage one, which decides beta; widths of smoothed jumps in mm, or None for the exact form.

    Widths are solved for one after another.
    """
    gap = robot.carriage_gap

    def fill(frame: Frame, q: Array) -> dict[str, Any]:
        """Parameters for a target frame; q is not needed."""
        values = robot_values(robot) | {"reach": robot.reach, "turning": frame.turning, "length": frame.length}
        values |= {} if gap is None else {"gap": gap}
        return values | {"kappa": frame.curvature} if widths is None else values

    schedule = ({},) if widths is None else tuple({"width": width} for width in widths)
    nlp = _extension_program(robot.structure, widths is None)
    # beta are the entries d to 2 d of q, eq. (5).
    return Stage(nlp, np.arange(robot.d, 2 * robot.d), fill, schedule)


@functools.lru_cache(maxsize=MAX_CACHED_FRAME_PROGRAMS)
def _extension_program(structure: Structure, exact: bool) -> Nlp:
    """Build the program of stage one over beta (d,), smoothed or exact."""
    d = structure.d
    sizes: dict[str, Any] = {
        "tubes": (d, len(TUBE_NUMBER_NAMES)),
        "reach": 1,
        "turning": len(SIGMA_GRID),
        "length": 1,
    }
    # A robot without a least gap has a program without that constraint and its parameter.
    sizes |= {"gap": 1} if structure.gap else {}
    # The exact form takes the target's curvature itself, the smoothed one a width.
    sizes |= {"previous": d, "motion_root": 1} | ({"kappa": len(SIGMA_GRID)} if exact else {"width": 1})
    p = {name: ca.SX.sym(name, *np.atleast_1d(size).tolist()) for name, size in sizes.items()}
    beta = ca.SX.sym("beta", d)
    tubes = symbolic_tubes(structure, p["tubes"])
    entries = ca.vertsplit(beta)
    target = (p["turning"], p["length"])
    if exact:
        cost = curvature.curvature_exact(tubes, entries, p["reach"], p["kappa"], *target)
    else:
        cost = curvature.curvature(tubes, entries, p["reach"], *target, p["width"])
    # Length and motion are least squares; the curvature is a cost of its own (curvature.curvature says
    # why).
    residuals = (
        curvature.length_residual(entries[-1], p["length"], DEPLOYED_LENGTH_WEIGHT),
        motion_residual(beta, p["previous"], mm_per_unit(d)[d : 2 * d], p["motion_root"]),
    )
    free = np.full(d, np.inf)
    return Nlp("extension", beta, -free, free, p, residuals, (cost,), order(tubes, entries, p.get("gap")))


def _rotation(robot: Robot) -> Stage:
    """Return stage two, which decides alpha and theta at given beta, sampled at ends and middles of segments."""
    d = robot.d

    def fill(frame: Frame, q: Array) -> dict[str, Any]:
        """Parameters for a target frame, with beta taken from q."""
        extensions = robot.split(q)[1]
        # The target's points are computed here, in numbers: they depend on beta, which is no unknown.
        sigma, _ = _quadrature_samples(extensions, np)
        return robot_values(robot) | {"beta": extensions, "target": frame.at(np.array(sigma))}

    # alpha and theta: the entries of q before and after beta.
    return Stage(_rotation_program(robot.structure), np.r_[0:d, 2 * d : 2 * d + 2], fill)


@functools.lru_cache(maxsize=MAX_CACHED_FRAME_PROGRAMS)
def _rotation_program(structure: Structure) -> Nlp:
    """Build the program of stage two: the distance (8) by Simpson's rule over samples at equal sigma."""
    d = structure.d
    numbers = ca.SX.sym("tubes", d, len(TUBE_NUMBER_NAMES))
    beta = ca.SX.sym("beta", d)
    x = ca.SX.sym("alpha_theta", d + 2)
    previous = ca.SX.sym("previous", d + 2)
    root = ca.SX.sym("motion_root")
    target = ca.SX.sym("target", 2 * d, 3)
    entries = ca.vertsplit(ca.vertcat(x[:d], beta, x[d:]))
    sigma, quadrature = _quadrature_samples(ca.vertsplit(beta), ca)
    points = shape.backbone(symbolic_tubes(structure, numbers), entries, ca.vertcat(*sigma), ca).points
    scale = mm_per_unit(d)[np.r_[0:d, 2 * d : 2 * d + 2]]
    free = np.full(d + 2, np.inf)
    return Nlp(
        "rotation",
        x,
        -free,
        free,
        {"tubes": numbers, "beta": beta, "target": target, "previous": previous, "motion_root": root},
        residuals=(
            # Square roots of the weights: the residual is squared.
            shape_residual(points, columns_of(target), ca.sqrt(ca.vertcat(*quadrature))),
            motion_residual(x, previous, scale, root),
        ),
    )


def _quadrature_samples(beta: Any, xp: Any) -> tuple[list[Any], list[Any]]:
    """Return sigma at the middles, then the ends of all segments, and Simpson's weights there.

    The base point never moves and is left out. A solver's beta may violate the order by its tolerance, and weights
    must not become negative.
    """
    edges = [0 * beta[0], *(beta[i] for i in range(len(beta)))]
    widths = [xp.fmax(high - low, 0) / beta[-1] for low, high in itertools.pairwise(edges)]
    middles = [(low + high) / 2 / beta[-1] for low, high in itertools.pairwise(edges)]
    # An end belongs to the segments on both of its sides; beyond the last there is none.
    at_ends = [(low + high) / 6 for low, high in itertools.pairwise([*widths, 0])]
    sigma = [*middles, *(edge / beta[-1] for edge in edges[1:])]
    return sigma, [*(4 * width / 6 for width in widths), *at_ends]
