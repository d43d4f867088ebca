"""Geometry of the dominant-stiffness model, eqs. (1)-(4): between beta_{i-1} and beta_i, tube i sets the
curvature.

A point is a sum over tubes, C(s) = sum_i (a_i N_i + b_i T_i + c_i B_i): lengths a, b, c in mm travelled on tube i
to arc length s, times the directions at the beginning of its segment: N_i where it bends to, T_i the tangent, and
B_i = T_i x N_i across both, which only a helix needs. Lengths depend on beta and s, directions on q alone:
programs differentiate sums of products, and batches are matrix products. Tangents are the same sums of gains.

Curvatures k are in 1/mm, torsions and angles in rad/mm and rad; x is a distance from a tube's tip in mm, so that
the tip's end is at 0 and the curved part ends at x = curved_length. One source for symbols and numbers: `xp` is
casadi (fields are SX, samples run down a column) or numpy (fields broadcast: configurations down, samples across).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.robot.structure import TubeNumbers, Tubes
from ctr_nlp.typing import Vector

# Gauss-Legendre nodes and weights on [-1, 1], for curvatures that are linear in arc length: their integrals
# of sines are Fresnel's, which casadi has not.
_GAUSS_LEGENDRE_NODES, _GAUSS_LEGENDRE_WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Within 1e-5 mm for curvatures up to 0.04 /mm that change their side along 180 mm, 1e-9 mm along 60 mm."""


class Backbone(NamedTuple):
    """The shape at samples. points: x, y, z in mm. tangents: x, y, z of the unit tangents."""

    points: Vector
    tangents: Vector


class Travel(NamedTuple):
    """Travel on one tube in its own plane: side and along in mm, and the angle turned, rad."""

    side: Any
    along: Any
    angle: Any

    @property
    def lengths(self) -> tuple[Any, ...]:
        """Lengths along N (where the tube bends to) and T (the tangent) at the beginning of its segment, mm."""
        return self.side, self.along

    def gains(self, xp: Any) -> tuple[Any, ...]:
        """Return the gain of the tangent along N and T: (sin, cos - 1) of the angle turned.

        xp: casadi or numpy.
        """
        return xp.sin(self.angle), xp.cos(self.angle) - 1


class HelixTravel(NamedTuple):
    """Travel on a helix of curvature k and torsion, 1/mm: `straight` mm, then `length` mm of its curved part.

    Its Frenet frame turns about a fixed axis, the Darboux vector k B + torsion T, at the rate w = sqrt(k^2 +
    torsion^2) in rad/mm. xp: casadi or numpy.
    """

    k: Any
    torsion: Any
    length: Any
    straight: Any
    xp: Any

    @property
    def _rotation_terms(self) -> tuple[Any, Any, Any]:
        """w, sin(w length) and 1 - cos(w length)."""
        w = self.xp.sqrt(self.k**2 + self.torsion**2)
        # 1 - cos(a) = 2 sin(a / 2)^2, without the cancellation at small angles.
        sin = self.xp.sin(w * self.length)
        half = self.xp.sin(w * self.length / 2)
        return w, sin, 2 * half * half

    @property
    def lengths(self) -> tuple[Any, ...]:
        """Lengths along N, T and B at the beginning of its curved part, mm."""
        (w, sin, rest), k, torsion = self._rotation_terms, self.k, self.torsion
        # The tangent at length s is T + k sin(ws)/w N - k^2 (1 - cos(ws))/w^2 T + k torsion (1 -
        # cos(ws))/w^2 B; these are its integrals.
        late = (self.length - sin / w) / w**2
        # w > 0, since a helix has k > 0 and torsion of either sign; a limit at w = 0 is not needed.
        return k * rest / w**2, self.straight + self.length - k**2 * late, k * torsion * late

    def gains(self, xp: Any) -> tuple[Any, ...]:
        """Return the gain of the tangent along N, T and B. xp: not used, as the helix has its own."""
        (w, sin, rest), k = self._rotation_terms, self.k
        return k * sin / w, -(k**2) * rest / w**2, k * self.torsion * rest / w**2

    def after(self, bend: Vector, across: Vector, t: Vector) -> tuple[Vector, Vector, Vector]:
        """Return the Frenet frame (N, B, T) at the end, from that at the beginning: bend N, across B and tangent
        t.
        """
        (w, sin, rest), k, torsion = self._rotation_terms, self.k, self.torsion
        # about: unit axis of the turn. outwards: perpendicular to it and to N, the direction in which N
        # turns.
        about = combine_vectors(k / w, across, torsion / w, t)
        outwards = combine_vectors(torsion / w, across, -k / w, t)
        side = combine_vectors(1 - rest, bend, sin, outwards)
        turned = combine_vectors(1 - rest, outwards, -sin, bend)
        return (
            side,
            combine_vectors(k / w, about, torsion / w, turned),
            combine_vectors(torsion / w, about, -k / w, turned),
        )


def columns_of(q: Any) -> list[Any]:
    """Split configurations or unknowns q (T, n) into n columns (T, 1)."""
    return [column[:, None] for column in np.asarray(q, dtype=float).T]


def backbone(tubes: Tubes, q: Sequence[Any], sigma: Any, xp: Any) -> Backbone:
    """Compute the shape C(s | q) at s = sigma beta_d, eqs. (1) and (4).

    tubes: of the robot. q: its 2d + 2 entries, in rad and mm. sigma: in [0, 1]. xp: casadi or numpy.
    """
    travelled = travels(tubes, q[len(tubes) : 2 * len(tubes)], sigma * q[2 * len(tubes) - 1], xp)
    planes = directions(tubes, q, xp)
    point = (0.0, 0.0, 0.0)
    tangent = planes[0][1]
    for travel, plane in zip(travelled, planes, strict=True):
        for length, gain, vector in zip(travel.lengths, travel.gains(xp), plane, strict=True):
            point = combine_vectors(1.0, point, length, vector)
            tangent = combine_vectors(1.0, tangent, gain, vector)
    return Backbone(point, tangent)


def travels(tubes: Tubes, beta: Sequence[Any], s: Any, xp: Any) -> list[Travel | HelixTravel]:
    """Compute the lengths travelled on each tube to arc lengths s, mm.

    tubes: of the robot. beta: extensions, mm. xp: casadi or numpy. The expression has the same structure whichever
    tube a sample lies on; positions are C1 in beta, also where rounding has put a tube's end before that of the
    tube around it.
    """
    # 0 * beta has the type and shape of beta, a symbol or a column, which the number 0 has not.
    start = 0 * beta[0]
    before = 0 * beta[0]
    travelled = list[Travel | HelixTravel]()
    for i in range(len(tubes)):
        # A sample beyond tube i's tip travels all of its segment, one before it nothing beyond s: clamping
        # replaces the cases of eq. (1).
        here = xp.fmin(s, beta[i])
        travelled.append(_on_tube(tubes, i, beta[i] - start, beta[i] - start - (here - before), xp))
        # Segment i begins at beta_{i-1}. Distances from the tip: beta_i - start at its beginning, and less
        # by what has been travelled.
        start = beta[i]
        before = here
    return travelled


def directions(tubes: Tubes, q: Sequence[Any], xp: Any) -> list[tuple[Vector, ...]]:
    """Compute for each tube the directions where its segment begins: N, the tangent T and, of a helix, B.

    tubes: of the robot. q: its 2d + 2 entries, in rad and mm. xp: casadi or numpy.
    """
    alpha, beta, (theta_x, theta_y) = q[: len(tubes)], q[len(tubes) : 2 * len(tubes)], q[2 * len(tubes) :]
    d1, d2, t = base_frame(theta_x, theta_y, xp)
    start = 0 * beta[0]
    planes = list[tuple[Vector, ...]]()
    for i in range(len(tubes)):
        travel = _on_tube(tubes, i, beta[i] - start, 0 * start, xp)
        turn = alpha[i]
        if isinstance(travel, HelixTravel):
            # alpha is the direction where the curved part begins, in the robot's hidden part; from there to
            # the segment's beginning the helix has turned by its own torsion.
            turn = turn + tubes[i].spin * (tubes[i].curved_length - travel.length)
        cos = xp.cos(turn)
        sin = xp.sin(turn)
        bend = combine_vectors(cos, d1, sin, d2)
        normal = combine_vectors(-sin, d1, cos, d2)
        if isinstance(travel, HelixTravel):
            planes.append((bend, t, normal))
            bend, normal, t = travel.after(bend, normal, t)
            # Direction at the helix's tip: turning back by it leaves axes that have not spun, from which
            # the next tube's alpha is measured.
            turn = alpha[i] + tubes[i].spin * tubes[i].curved_length
            cos = xp.cos(turn)
            sin = xp.sin(turn)
        else:
            planes.append((bend, t))
            c = xp.cos(travel.angle)
            z = xp.sin(travel.angle)
            # Rotation by the angle turned, in the plane of N and T.
            bend, t = combine_vectors(c, bend, -z, t), combine_vectors(z, bend, c, t)
        # Undo the turn by alpha_i: alpha is absolute, eq. (5), so the next tube's is measured from the same
        # axes.
        d1 = combine_vectors(cos, bend, -sin, normal)
        d2 = combine_vectors(sin, bend, cos, normal)
        start = beta[i]
    return planes


def _on_tube(tubes: Tubes, i: int, x_from: Any, x_to: Any, xp: Any) -> Travel | HelixTravel:
    """Travel on tube i between distances x_from and x_to from its tip, x_from >= x_to, mm."""
    tube = tubes[i]
    if tube.kind == "helix":
        # Distances beyond the curved part lie on its straight part: clamping splits the travel.
        curved_from, curved_to = (xp.fmin(x, tube.curved_length) for x in (x_from, x_to))
        length = curved_from - curved_to
        return HelixTravel(tube.tip_curvature, tube.spin, length, x_from - x_to - length, xp)
    if not tubes[i].transmission_emerges:
        return planar(tube, x_from, x_to, xp)
    end = tube.curved_length
    # The straight transmission comes first, as it is further from the tip.
    lead = xp.fmax(x_from, end) - xp.fmax(x_to, end)
    side, along, angle = planar(tube, xp.fmin(x_from, end), xp.fmin(x_to, end), xp)
    return Travel(side, lead + along, angle)


def planar(tube: TubeNumbers, x_from: Any, x_to: Any, xp: Any) -> Travel:
    """Compute the travel on the curved part of a tube between distances x_from >= x_to from its tip, mm.

    xp: casadi or numpy.
    """
    length = x_from - x_to
    if tube.kind == "straight":
        return Travel(0 * length, length, 0 * length)
    if tube.kind == "arc":
        k = tube.tip_curvature
        # side = (1 - cos kL) / k and along = sin(kL) / k, by half angles: without cancellation at small
        # angles.
        sin = xp.sin(k / 2 * length)
        cos = xp.cos(k / 2 * length)
        return Travel(2 / k * sin * sin, 2 / k * sin * cos, k * length)
    # Linear curvature: sides and lengths are integrals of the sine and cosine of the angle turned so far.
    angle_from = _turning(tube, x_from)
    side = along = 0.0
    for node, weight in zip((_GAUSS_LEGENDRE_NODES + 1) / 2, _GAUSS_LEGENDRE_WEIGHTS / 2, strict=True):
        # Angle turned from the beginning of the travel to the node.
        angle = angle_from - _turning(tube, x_from - node * length)
        side = side + weight * xp.sin(angle)
        along = along + weight * xp.cos(angle)
    return Travel(side * length, along * length, angle_from - _turning(tube, x_to))


def _turning(tube: TubeNumbers, x: Any) -> Any:
    """Integral of the curvature over the last x mm of a tube's curved part, rad."""
    return tube.tip_curvature * x + tube.slope * x**2 / 2


def base_frame(theta_x: Any, theta_y: Any, xp: Any) -> tuple[Vector, Vector, Vector]:
    """Return the columns of R = Ry(theta_y) Rx(theta_x), eq. (4): the base's axes.

    The third is the insertion direction. theta_x, theta_y: the tilt, rad. xp: casadi or numpy.
    """
    cx = xp.cos(theta_x)
    sx = xp.sin(theta_x)
    cy = xp.cos(theta_y)
    sy = xp.sin(theta_y)
    return (cy, 0.0, -sy), (sy * sx, cx, cy * sx), (sy * cx, -sx, cy * cx)


def combine_vectors(a: Any, u: Vector, b: Any, v: Vector) -> Vector:
    """Return the vector a u + b v."""
    return a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2]


def curvature(tubes: Tubes, beta: Sequence[Any], s: Any, step: Any, xp: Any) -> Any:
    """Compute the curvature k(s | beta) in 1/mm, eq. (10), which does not depend on alpha.

    tubes: of the robot. beta: extensions, mm. s: arc lengths, mm. step(x) goes from 0 to 1 as x mm passes 0: the
    Heaviside function, or a smooth one that programs can differentiate. xp: casadi or numpy.
    """
    value = _profile(tubes, 0, beta[0] - s, step, xp)
    for i in range(1, len(tubes)):
        # At s = beta_{i-1}, tube i takes over from tube i - 1.
        jump = _profile(tubes, i, beta[i] - s, step, xp) - _profile(tubes, i - 1, beta[i - 1] - s, step, xp)
        value = value + jump * step(s - beta[i - 1])
    return value


def _profile(tubes: Tubes, i: int, x: Any, step: Any, xp: Any) -> Any:
    """Return the pre-curvature of tube i at x mm from its tip, 1/mm; step as in `curvature`."""
    tube = tubes[i]
    # Clamped, so that a smoothed step does not extrapolate the linear curvature beyond the tube's curved
    # part.
    value = tube.tip_curvature + tube.slope * xp.fmin(xp.fmax(x, 0.0), tube.curved_length)
    return value * step(tube.curved_length - x) if tubes[i].transmission_emerges else value


def curved_part(tubes: Tubes, i: int, start: Any, end: Any, xp: Any) -> tuple[Any, Any, Any]:
    """Return where between start and end (mm) tube i begins to curve, k there (1/mm) and dk/ds (1/mm^2).

    tubes: of the robot; `end` is the tip of tube i. xp: casadi or numpy.
    """
    tube = tubes[i]
    low = xp.fmax(start, end - tube.curved_length) if tubes[i].transmission_emerges else start
    # slope is per mm from the tip towards the root, that is against s: hence the sign of dk/ds.
    return low, tube.tip_curvature + tube.slope * (end - low), -tube.slope
