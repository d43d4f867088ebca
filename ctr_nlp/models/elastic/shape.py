"""The shape of the elastic model: tubes that twist each other (torsion.py) share one curve.

The tangent t turns with the bending vector u (1/mm) of torsion.py in a frame (d1, d2, t) that does not spin about
t (Bishop's frame): t' = u_x d1 + u_y d2, d1' = -u_x t, d2' = -u_y t. Frames are integrated from node to node by
Magnus' series to order 4, and between nodes the tangent is a polynomial whose integral is the position (mm).

One source for symbols and numbers, as in models/dominant/shape.py: `xp` is casadi or numpy. A shape is a sum of
lengths, which depend on beta and sigma, times vectors, which depend on x alone, in axes turned with the innermost
tube's tip.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ctr_nlp.models.dominant.shape import Backbone, Travel, base_frame, combine_vectors, planar
from ctr_nlp.models.elastic.torsion import (
    ELASTIC_STEPS_PER_SECTION,
    Node,
    RobotSection,
    Twist,
    bending,
    sections,
    twist,
)
from ctr_nlp.models.protocol import combination
from ctr_nlp.robot.structure import Tubes
from ctr_nlp.typing import Vector

Axes = tuple[Vector, Vector, Vector]
"""Three unit vectors."""

MIN_ELASTIC_SECTION_LENGTH_MM = 1e-4
"""Length in mm below which sections count as empty."""
SERIES = 7
"""Terms of the series of sin(a)/a and (1 - cos(a))/a^2, where a is the angle turned from node to node."""


def backbone(
    tubes: Tubes, x: Sequence[Any], sigma: Any, xp: Any, steps: int = ELASTIC_STEPS_PER_SECTION
) -> Backbone:
    """Compute the shape at s = sigma beta_d, with sigma in [0, 1].

    tubes: of the robot. x: the 2d + 2 unknowns of torsion.py, rad and mm. xp: casadi or numpy. steps: of
    integration in each section.
    """
    beta = x[len(tubes) : 2 * len(tubes)]
    parts = sections(tubes, beta, xp)
    vectors = curves(tubes, x, parts, twist(tubes, x, parts, xp, steps), xp)
    lengths, turns = travels(tubes, beta, parts, sigma * beta[-1], xp, steps)
    base = turned_base(tubes, x, xp)
    tangent = combination([1.0, *turns], [(0.0, 0.0, 1.0), *vectors])
    return Backbone(combination(combination(lengths, vectors), base), combination(tangent, base))


def curves(tubes: Tubes, x: Sequence[Any], parts: Sequence[RobotSection], twisted: Twist, xp: Any) -> list[Vector]:
    """Return the vectors of which a shape is the sum, section by section, in axes turned with the innermost tip.

    tubes: of the robot. x: its 2d + 2 unknowns. parts: its sections. twisted: the tubes' angles along them. xp:
    casadi or numpy. A plane section has two vectors: the direction in which it bends, and its tangent at the
    beginning. Any other has the coefficients of powers of the fraction of its length in the polynomial through the
    tangents at all nodes.
    """
    beta = x[len(tubes) : 2 * len(tubes)]
    found = list[Vector]()
    axes: Axes = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    for part, nodes in zip(parts, twisted.nodes, strict=True):
        if part.plane:
            # At most one active tube: the sum is its angle, or 0.
            psi = sum(nodes[0].angles[i] for i in part.active)
            cos = xp.cos(psi)
            sin = xp.sin(psi)
            found += [combine_vectors(cos, axes[0], sin, axes[1]), axes[2]]
            angle = _arc(tubes, beta, part, part.length, xp).angle
            # The whole section is one turn, about the axis perpendicular to the direction in which it
            # bends.
            axes = rotate_axes(axes, (-angle * sin, angle * cos, 0.0))
        else:
            triads = _triads(axes, part, nodes, xp)
            found += powers([tangent for _, _, tangent in triads])
            axes = triads[-1]
    return found


def powers(tangents: Sequence[Vector]) -> list[Vector]:
    """Return the coefficients of the polynomial through a section's tangents, by powers of the fraction of its
    length.
    """
    # The inverse of Vandermonde's matrix for evenly spaced nodes maps values to coefficients.
    # The tangent is interpolated, not the angle: points are then the exact integral of a polynomial, and linear in
    # these vectors.
    to_powers = np.linalg.inv(np.vander(np.linspace(0.0, 1.0, len(tangents)), increasing=True))
    return [combination(row, tangents) for row in to_powers]


def travels(
    tubes: Tubes,
    beta: Sequence[Any],
    parts: Sequence[RobotSection],
    s: Any,
    xp: Any,
    steps: int = ELASTIC_STEPS_PER_SECTION,
) -> tuple[list[Any], list[Any]]:
    """Compute lengths along each vector of `curves` to arc lengths s, mm, and how much of each the tangent gains.

    tubes, parts: of the robot. beta: extensions, mm. xp: casadi or numpy. steps: of integration in each section.
    """
    lengths = list[Any]()
    turns = list[Any]()
    before = 0 * s
    for part in parts:
        here = xp.fmin(s, part.start + part.length)
        if part.plane:
            side, along, angle = _arc(tubes, beta, part, here - before, xp)
            lengths += [side, along]
            turns += [xp.sin(angle), xp.cos(angle) - 1]
        else:
            # (here - before) / length, which is 0 instead of NaN, with finite derivatives, where a section
            # is empty.
            fraction = (here - before) * (part.length / (part.length**2 + MIN_ELASTIC_SECTION_LENGTH_MM**2))
            powers = list(itertools.accumulate([fraction] * (2 * steps), lambda a, b: a * b, initial=1.0))
            # The integral of f^(n-1) over the arc length travelled so far is (here - before) f^(n-1) / n.
            lengths += [(here - before) / n * power for n, power in enumerate(powers, start=1)]
            # The constant coefficient is the tangent at the section's beginning, which earlier sections
            # have gained.
            turns += [0.0, *powers[1:]]
        before = here
    return lengths, turns


def turned_base(tubes: Tubes, x: Sequence[Any], xp: Any) -> Axes:
    """Return the axes of `curves` in the base frame: R of eq. (4), turned by phi_d about the insertion direction.

    tubes: of the robot. x: its 2d + 2 unknowns, rad and mm. xp: casadi or numpy.
    """
    theta_x, theta_y = x[2 * len(tubes) :]
    d1, d2, t = base_frame(theta_x, theta_y, xp)
    cos = xp.cos(x[len(tubes) - 1])
    sin = xp.sin(x[len(tubes) - 1])
    return combine_vectors(cos, d1, sin, d2), combine_vectors(-sin, d1, cos, d2), t


def _arc(tubes: Tubes, beta: Sequence[Any], part: RobotSection, length: Any, xp: Any) -> Travel:
    """Travel over a length (mm) from the beginning of a plane section, with at most one curved tube."""
    if not part.active:
        return Travel(0 * length, length, 0 * length)
    (i,) = part.active
    tube = tubes[i]
    share = part.shares[i]
    # Straight tubes beside it share the bending: the curve has the tube's share of its pre-curvature.
    bent = tube._replace(root_curvature=share * tube.root_curvature, tip_curvature=share * tube.tip_curvature)
    x_from = beta[i] - part.start
    straight = 0.0
    x_to = x_from - length
    if tubes[i].transmission_emerges:
        x_from = xp.fmin(x_from, tube.curved_length)
        x_to = xp.fmin(x_to, tube.curved_length)
        # Beyond the curved part, towards the root, the tube is straight; that part comes first.
        straight = length - (x_from - x_to)
    side, along, angle = planar(bent, x_from, x_to, xp)
    return Travel(side, straight + along, angle)


def _triads(axes: Axes, part: RobotSection, nodes: Sequence[Node], xp: Any) -> list[Axes]:
    """Bishop frames at a section's nodes, from those at its beginning, by Magnus' series to order 4."""
    u = [bending(part, node, xp) for node in nodes]
    h = part.length / (len(nodes) - 1)
    found = [axes]
    # Three nodes at a time: both halves use the quadratic through the bending vectors at all three.
    for k in range(0, len(nodes) - 1, 2):
        a, b, c = u[k : k + 3]
        found.append(rotate_axes(found[-1], _turn(h, a, b, c, a, b)))
        # The second half by the same formula with the nodes reversed: its quadrature weights are mirrored, while h
        # and the commutator keep the order of integration.
        found.append(rotate_axes(found[-1], _turn(h, c, b, a, b, c)))
    return found


def _turn(h: Any, near: Any, middle: Any, far: Any, first: Any, last: Any) -> Vector:
    """Rotation vector of Magnus' series over a length h between two nodes, in the axes at its beginning, rad.

    near, middle, far: bending vectors at three nodes, in this order from the one that h begins or ends at; first,
    last: at both ends of h.
    """
    # Integral of u over half of the three nodes' interval: weights 5/12, 8/12, -1/12 of the quadratic.
    x, y = (h * (5 / 12 * near[i] + 8 / 12 * middle[i] - 1 / 12 * far[i]) for i in range(2))
    # The axes turn about t x u = (-u_y, u_x, 0). The last entry is the commutator term: without it, the
    # series is of order 2.
    return -y, x, h**2 / 12 * (first[0] * last[1] - first[1] * last[0])


def rotate_axes(axes: Axes, turn: Vector) -> Axes:
    """Axes after a turn about a vector in these axes, rad, by Rodrigues' formula."""
    x, y, z = turn
    # s = sin(a)/a and c = 2 (1 - cos(a))/a^2 by Horner's scheme in a^2: smooth at a = 0, where quotients
    # are not.
    square = x * x + y * y + z * z
    s = 1.0
    c = 1.0
    for n in range(SERIES, 0, -1):
        s = 1 - square / (2 * n * (2 * n + 1)) * s
        c = 1 - square / ((2 * n + 1) * (2 * n + 2)) * c
    c = c / 2
    return (
        combination((1 - c * (y * y + z * z), c * x * y + s * z, c * x * z - s * y), axes),
        combination((c * x * y - s * z, 1 - c * (x * x + z * z), c * y * z + s * x), axes),
        combination((c * x * z + s * y, c * y * z - s * x, 1 - c * (x * x + y * y)), axes),
    )
