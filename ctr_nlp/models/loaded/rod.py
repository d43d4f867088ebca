"""Tubes that twist each other and share one curve (elastic/torsion.py), under a load, from the tip to the base.

At the tip force and moment are known. With the tubes' angles there, relative to a frame (d_1, d_2, t) of the tip
that does not spin along the robot, everything is integrated to the base, and every such start is an equilibrium
(Rucker, Jones, Webster, A Geometrically Exact Model for Externally Loaded Concentric-Tube Continuum Robots, IEEE
Transactions on Robotics 26(5), 2010; Antman, Nonlinear Problems of Elasticity): by equations.py from

    psi_i'(beta_i) = 0, but GJ_d psi_d'(beta_d) is the tip's moment about t.

Beside it, the responses to d + 2 changes are integrated: turns about d_1 and d_2, and of every psi_i. They are
recorded from place to place: at each they restart as responses to changes of that place, which keeps them of the
same size however far the base is. One source for symbols and numbers, as in torsion.py: `xp` is casadi or numpy;
each quantity that responds is a row of d + 2 entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.models.elastic.torsion import Node, RobotSection, curvatures_at
from ctr_nlp.models.loaded.equations import Equations, Softness, Values
from ctr_nlp.models.loaded.rod_loads import DistributedForce, Loading, PieceForce, RodKind, check_kinds
from ctr_nlp.models.loaded.vectors import cross, dot, plus, scale_vector, total, vectors
from ctr_nlp.robot.structure import Tubes
from ctr_nlp.typing import Vector

RESPONSE_RESTART_STEPS = 3
"""Steps after which responses restart. Over longer pieces, directions that are soft in torsion turn so far that
pivots become negative where no direction has lost its stability.
"""

RIGID_LENGTH_MM = 1e-3
"""Length of a rigid part that is added to every part in the test of stability on a foundation, mm."""


class Tip(NamedTuple):
    """The tubes' angles psi at their tips, rad, relative to a frame there with the given axes (d_1, d_2, t)."""

    angles: Sequence[Any]
    axes: tuple[Vector, Vector, Vector]


class Rod(NamedTuple):
    """A rod, integrated from its tip.

    states: at the nodes of every section from base to tip, evenly spaced: angles, rates, axes and moment, in the
    layout of equations.py. angles, rates, axes: at the base, rad, rad/mm. responses: from tip to base the
    matrices, row by row a list, of derivatives of the turns about d_1 and d_2 and of every tube's angle plus the
    frame's spin, over the same at the place before; the last d are of one transmission after the other.
    """

    states: list[list[Values]]
    angles: Values
    rates: Values
    axes: tuple[Vector, Vector, Vector]
    responses: list[list[Any]]

    @property
    def tangents(self) -> list[list[Vector]]:
        """Unit tangents t at the nodes of every section, from base to tip."""
        return [[vectors(state[2 * len(self.angles) :])[2] for state in nodes] for nodes in self.states]

    def nodes(self, tubes: Tubes, beta: Sequence[Any], parts: Sequence[RobotSection]) -> list[list[Node]]:
        """Return the rod's nodes for elastic/stability.py, with the moment along the rod as one from outside.

        tubes, beta, parts: those that the rod was integrated with.
        """
        found = list[list[Node]]()
        d = len(tubes)
        for part, states in zip(parts, self.states, strict=True):
            flexible = part.shares[-1] / tubes[-1].bending_stiffness
            found.append([])
            for k, state in enumerate(states):
                d1, d2, _, m = vectors(state[2 * d :])
                s = part.start + part.length * (k / (len(states) - 1))
                curvatures = curvatures_at(tubes, [0.0] * d + list(beta), part, s)
                # u without the tubes' own bending is (m . d_2, -m . d_1) / sum EI.
                found[-1].append(Node(state[:d], curvatures, (flexible * dot(m, d2), -flexible * dot(m, d1))))
        return found


def integrate_rod(
    tubes: Tubes,
    tip: Tip,
    beta: Sequence[Any],
    parts: Sequence[RobotSection],
    load: Loading,
    kind: RodKind,
    xp: Any,
    steps: int,
    *,
    soft: Softness | None = None,
    section_forces: Sequence[PieceForce] = (),
) -> Rod:
    """Integrate the rod of a tip to the base, with the classical method of Runge and Kutta of order 4.

    tubes, beta, parts: of the robot, extensions in mm, sections from base to tip. load: what acts, of which kind
    selects the terms that count. xp: casadi or numpy. steps: in each section. soft: softness of the responses;
    None for no responses. section_forces: forces that act along each of the parts beside the tubes' weights.
    Raises LoadError for a helix.
    """
    check_kinds([tube.kind for tube in tubes])
    d = len(tubes)
    force = load.force
    # A moment about the tip's tangent alone needs no axes of the tool, which saves operations in most kinds of
    # rods.
    axial = load.tool_moment[2]
    moment = scale_vector(axial, tip.axes[2])
    twistable = tubes[-1].torsional_ratio / tubes[-1].bending_stiffness
    if kind.follows:
        force = plus(force, 1.0, _tool_to_base(tip, load.tool_force, xp))
    if kind.bends:
        moment = plus(load.moment, 1.0, _tool_to_base(tip, load.tool_moment, xp))
        # The moment about the tip's tangent twists the innermost tube, which alone reaches the tip.
        axial = dot(moment, tip.axes[2])
    # psi_i' = 0 at free ends; 0 times an angle has the shape of a column, or is a symbol.
    rates = [*[0.0 * tip.angles[0]] * (d - 1), axial * twistable]
    y: Values = [*tip.angles, *rates, *(entry for axis in tip.axes for entry in axis), *moment]
    by = [] if soft is None else _changes(tip, load, kind, twistable, xp)
    states = []
    responses = list[list[Any]]()
    along = DistributedForce(load.distributed, load.between, beta[-1], xp) if kind.distributed else None
    # From tip to base: force and moment are known at the tip.
    for k, part in reversed(list(enumerate(parts))):
        # Weight per volume times cross-section, N/mm, of the tubes that are present in this section.
        weights = [scale_vector(tubes[i].area, load.weights[i]) for i in part.present] if kind.weighs else []
        growth: Vector | None = None
        foundation: Sequence[Vector] = ()
        if section_forces:
            mean, growth, foundation = section_forces[k]
            weights.append(mean)
        weight = total(weights)
        section = Equations(
            tubes, beta, part, force, weight, growth, foundation, along, soft or Softness(), xp, steps
        )
        nodes = [y]
        for step in range(steps):
            y, by = _runge_kutta_step(section, step, y, by)
            nodes.append(y)
            # Also at each section's end, so that places of responses do not depend on RESPONSE_RESTART_STEPS
            # dividing the steps.
            if by and (step + 1 == steps or (step + 1) % RESPONSE_RESTART_STEPS == 0):
                lengths = part.length * ((step % RESPONSE_RESTART_STEPS + 1) / steps)
                by = _restart_responses(by, responses, y, lengths if kind.founded else None, d, xp)
        states.append(nodes[::-1])
        # Weights are dead loads in the base's directions: the internal force grows by that of the section.
        force = plus(force, part.length, weight)
    if by:
        for i, tube in enumerate(tubes):
            # From the opening to its motor each tube turns by its rate over L_i - beta_i. One transmission after
            # the other, so that one direction at a time can lose its stability.
            by[i] = by[i] - by[d + i] * (tube.length - beta[i])
            by = _restart_responses(by, responses, y, 0.0 if kind.founded else None, d, xp)
    d1, d2, t, _ = vectors(y[2 * d :])
    return Rod(states[::-1], y[:d], y[d : 2 * d], (d1, d2, t), responses)


def _runge_kutta_step(section: Equations, k: int, y: Values, by: Values) -> tuple[Values, Values]:
    """Return the state and its responses after step k from the tip's end of a section.

    The method's four slopes are found as changes over the parts of a step that they are used with, so that sums
    have few terms.
    """
    first = _plus((y, by), section.changes(k, 1 / 2, y, by))
    second = _plus((y, by), section.changes(k + 0.5, 1 / 2, *first))
    third = section.changes(k + 0.5, 1.0, *second)
    fourth = section.changes(k + 1.0, 1 / 6, *_plus((y, by), third))
    y, by = (
        # With a = y + h k_1 / 2, b = y + h k_2 / 2, c = h k_3 and d = h k_4 / 6 this is y + h (k_1 + 2 k_2 + 2 k_3
        # + k_4) / 6.
        [(a + 2 * b + c) / 3 + d for a, b, c, d in zip(*stages, strict=True)]
        for stages in zip(first, second, third, fourth, strict=True)
    )
    return y, by


def _plus(begin: tuple[Values, Values], changes: tuple[Values, Values]) -> tuple[Values, Values]:
    """Add changes to a state and its responses."""
    y, by = ([a + b for a, b in zip(*both, strict=True)] for both in zip(begin, changes, strict=True))
    return y, by


def _changes(tip: Tip, load: Loading, kind: RodKind, twistable: Any, xp: Any) -> Values:
    """Return the initial responses at the tip, to turns about d_1 and d_2, changes of angles, and displacements.

    The last ones are there on a foundation alone. twistable: 1 / GJ_d, of the innermost tube. xp: casadi or numpy.
    """
    d, (d1, d2, t) = len(tip.angles), tip.axes
    a, b, *others = _units(d + kind.place_changes, xp)
    angles = others[:d]
    none = 0.0 * a
    # A turn (a, b) changes t by b d_1 - a d_2. A tool that is turned by `about` takes its force and moment along;
    # the axial moment is along t.
    turned = plus(scale_vector(b, d1), -1.0 * a, d2)
    about = plus(plus(scale_vector(a, d1), b, d2), angles[-1], t)
    moment = scale_vector(load.tool_moment[2], turned)
    force = (none, none, none)
    axial = none
    if kind.bends:
        moment = cross(about, _tool_to_base(tip, load.tool_moment, xp))
        axial = dot(load.moment, turned)
    if kind.follows:
        force = cross(about, _tool_to_base(tip, load.tool_force, xp))
    # Displacements are counted in the tip's axes, as at every other place, and stored in those of the base.
    moved = [
        sum(axis[k] * unit for axis, unit in zip(tip.axes, others[d:], strict=False)) for k in range(3)
    ] * bool(others[d:])
    return [*angles, *[none] * (d - 1), axial * twistable, a, b, none, *moment, *force, *moved]


def _restart_responses(
    by: Values, responses: list[list[Any]], y: Values, founded: Any | None, d: int, xp: Any
) -> Values:
    """Restart responses at this place, of state y: return `by` as responses to changes of this place.

    The responses of this place over the place before are appended to `responses`. They are inverted by elimination
    without a choice of pivots, which are positive where a robot is stable (stability.py). founded: on a
    foundation, the length since the place before, mm; else None.
    """
    a, b, c = by[2 * d : 2 * d + 3]
    # An angle in space is psi plus the spin c of its frame. Only such sums matter, so that d + 2 numbers describe
    # a place. On a foundation its displacement matters, too, here in the place's own axes.
    rows = [a, b, *(c + psi for psi in by[:d])]
    if founded is None:
        responses.append(rows)
    else:
        moved = vectors(by[2 * d + 9 :])[0]
        rows += [dot(axis, moved) for axis in vectors(y[2 * d :])[:3]]
        responses.append(_weigh_displacements(rows, founded, d))
    for k, unit in enumerate(_units(len(rows), xp)):
        # Gauss and Jordan's elimination on columns: column k becomes a unit vector, and all responses are changed
        # alike.
        change = (unit - rows[k]) / rows[k][:, k : k + 1]
        rows, by = ([row + row[:, k : k + 1] * change for row in some] for some in (rows, by))
    return by


def _weigh_displacements(rows: list[Any], length: Any, d: int) -> list[Any]:
    """Return the rows of a place's response on a foundation, multiplied by the stiffness that couples it.

    rows: turns, angles and displacements in the place's axes. length: from the place before, mm. With S the
    stiffness of all beyond that one, and K_jj, K_jn those of the part between, the response is -K_jn^-1 (K_jj +
    S), and the robot is stable where the pivots of K_jj + S are positive. Where only turns count, K_jn is diagonal
    and negative. Displacements couple with turns: of a beam, -K_jn = [[-2 h^2, 6 h], [-6 h, 12]] EI / h^3 for a
    turn and a displacement in one plane. Positive factors of rows are left out.
    """
    # Sections may be empty, and transmissions have no beam: a short rigid one stands for them.
    h = length + RIGID_LENGTH_MM
    found = list(rows)
    # Towards the base, a turn about d_2 moves the axis by -d_1, and one about d_1 by d_2.
    for turn, side, sign in ((1, d + 2, -1.0), (0, d + 3, 1.0)):
        moved = rows[side] + RIGID_LENGTH_MM * sign * rows[turn]
        found[turn] = 3 * sign * moved - h * rows[turn]
        found[side] = 2 * moved - h * sign * rows[turn]
    return found


def _units(size: int, xp: Any) -> list[Any]:
    """Return the rows of the identity matrix as symbols, or as arrays (1, size)."""
    return [xp.SX(ca.DM(row).T) if xp is ca else row[None] for row in np.eye(size)]


def _tool_to_base(tip: Tip, vector: Vector, xp: Any) -> Vector:
    """Return a vector, given in the tool's directions, in those of the base.

    The tool's x bends with the innermost tube.
    """
    cos, sin, (d1, d2, t) = xp.cos(tip.angles[-1]), xp.sin(tip.angles[-1]), tip.axes
    x = cos * vector[0] - sin * vector[1]
    y = sin * vector[0] + cos * vector[1]
    return plus(plus(scale_vector(x, d1), y, d2), vector[2], t)
