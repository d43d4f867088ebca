"""The shape of a loaded robot in symbols: every x = (phi, beta, w) of tips.py is an equilibrium.

It is integrated from its tip, and the direction of its base then determines theta, but for a pole at theta_x = 90
deg. Where theta is an unknown beside x, two equations say that the base points where theta has it: these have no
pole. Angles are in rad, lengths in mm; R is that of eq. (4).
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from ctr_nlp.models.dominant.shape import base_frame
from ctr_nlp.models.elastic.shape import powers, rotate_axes, travels
from ctr_nlp.models.elastic.stability import determinant, responses
from ctr_nlp.models.elastic.torsion import sections
from ctr_nlp.models.inner import Inner
from ctr_nlp.models.loaded.rod import Loading, Rod, Tip, integrate_rod
from ctr_nlp.models.loaded.rod_loads import RodKind
from ctr_nlp.models.loaded.vectors import dot
from ctr_nlp.models.protocol import SampleArcLengths, SymbolicShape, combination, matrix_of, vectors_of
from ctr_nlp.robot.structure import Structure, Tubes
from ctr_nlp.typing import Vector

LOADED_NLP_STEPS_PER_SECTION = 4
"""Steps of integration a section in a nonlinear program: an error of 0.02 mm at 0.3 N, where evaluations have
0.001.
"""


def build_loaded_shape(
    load: Loading,
    kind: RodKind,
    structure: Structure,
    tubes: Tubes,
    sample_lengths: SampleArcLengths,
    margin: ca.SX | None,
    tangents: bool,
    tilted: bool,
) -> SymbolicShape:
    """Build the shape of one frame in symbols.

    load: its numbers, as symbols. kind: of the rod. structure, tubes: of the robot. sample_lengths: returns arc
    lengths of samples, mm, for extensions. margin: least stability margin, None for none. tangents: whether these
    are needed at samples. tilted: whether theta is an unknown beside x.
    """
    d = structure.d
    x = ca.SX.sym("x", 2 * structure.d + 2)
    entries = ca.vertsplit(x)
    beta = entries[d : 2 * d]
    w = entries[2 * d :]
    # phi_i is relative to phi_d, w is the rotation vector of the tip's frame, which does not spin about its
    # tangent.
    tip = Tip(
        [*(phi + entries[d - 1] for phi in entries[: d - 1]), entries[d - 1]],
        rotate_axes(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (w[0], w[1], 0.0)),
    )
    parts = sections(tubes, beta, ca, planes=False)
    rod = integrate_rod(tubes, tip, beta, parts, load, kind, ca, LOADED_NLP_STEPS_PER_SECTION)
    # One polynomial for the tangent of each section: its coefficients are vectors, and samples are linear in them.
    # travels counts steps of two intervals each, as torsion.twist has them: LOADED_NLP_STEPS_PER_SECTION intervals
    # here.
    lengths, turns = travels(tubes, beta, parts, sample_lengths(beta), ca, LOADED_NLP_STEPS_PER_SECTION // 2)
    curves = [vector for at in rod.tangents for vector in powers(at)]
    held = ca.SX.sym("theta", 2 * tilted)
    theta = (held[0], held[1]) if tilted else tilt(rod.axes[2])
    base = base_frame(theta[0], theta[1], ca)
    reach = zip(rod.angles, rod.rates, tubes, beta, strict=True)
    spin = _spin(rod, base)
    # The motor of tube i lies L_i - beta_i behind the opening, and up to there the tube's rate of twist is
    # constant.
    alpha = [angle + spin - rate * (tube.length - out) for angle, rate, tube, out in reach]
    of_base = _base_misalignment(rod, base) if tilted else theta
    values = [ca.horzcat(*lengths), matrix_of(curves), ca.vertcat(*alpha), ca.vertcat(*of_base)]
    if margin is not None:
        # The moment along the rod is frozen while tubes turn, which takes a fifteenth of the operations of the
        # exact responses, and is off by up to 0.03 at 0.3 N. Finished plans are judged with exact margins
        # (loaded/stability.py).
        found_at = responses(
            tubes, beta, parts, rod.nodes(tubes, beta, parts), margin, ca, include_common_turn=True
        )
        values.append(ca.vertcat(*(determinant(response) for response in found_at)))
    if tangents:
        # 0 * lengths gives numbers the shape of columns.
        values += [ca.horzcat(*(0 * lengths[0] + turn for turn in turns)), ca.vertcat(*rod.axes[2])]
    inner = Inner.of(values)
    travelled, directions, motors, second, *others = inner.symbols
    vectors = vectors_of(directions)
    points = combination(ca.horzsplit(travelled), vectors)
    found = None
    if tangents:
        found = combination([1.0, *ca.horzsplit(others[-2])], [*vectors_of(others[-1]), *vectors])
    x = ca.vertcat(x, held)
    rows = x.numel()
    at = rows - 2 if tilted else rows + d
    # As SymbolicShape.picks counts: alpha is in the rows after x; theta is in x if tilted, else in the rows after
    # alpha.
    picks = (*range(rows, rows + d), *range(d, 2 * d), at, at + 1, *range(d))
    stable = None if margin is None else others[0]
    told = {"aside" if tilted else "theta": second}
    return SymbolicShape(x, motors, tuple(beta), points, inner, found, None, stable, picks, **told)


def tilt(t: Vector) -> tuple[Any, Any]:
    """Return theta_x, within a quarter turn, and theta_y of the R of eq. (4) whose third column is t."""
    return -ca.asin(t[1]), ca.atan2(t[0], t[2])


def _base_misalignment(rod: Rod, base: tuple[Vector, Vector, Vector]) -> tuple[Any, Any]:
    """Return the angles between the rod's base and the third column of R of eq. (4): sines, about rad
    where small.
    """
    return dot(base[0], rod.axes[2]), dot(base[1], rod.axes[2])


def _spin(rod: Rod, base: tuple[Vector, Vector, Vector]) -> Any:
    """Return the angle about t, rad, by which the rod's frame at the base is turned from the columns of R of eq.
    (4).
    """
    (d1, d2, _), (b1, b2, _) = rod.axes, base
    # From both axes of each frame, so that it is defined, and smooth, where the tangents do not quite agree.
    return ca.atan2(dot(b2, d1) - dot(b1, d2), dot(b1, d1) + dot(b2, d2))
