"""The dominant-stiffness model, eqs. (1)-(4): between beta_{i-1} and beta_i, tube i alone sets the curvature.

One source for symbols and numbers: `xp` is casadi (fields are SX, samples run down a column) or numpy
(fields broadcast: configurations down, samples across).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.robot.structure import TubeNumbers, Tubes
from ctr_nlp.typing import Vector

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Within 1e-5 mm for curvatures up to 0.04 /mm that change their side along 180 mm, 1e-9 mm along 60 mm."""


class Backbone(NamedTuple):
    """points: x, y, z of the samples in mm. tangents: x, y, z of the unit tangents there."""

    points: Vector
    tangents: Vector


class Travel(NamedTuple):
    """Travel on one tube in its own plane, mm, and the angle turned, rad."""

    side: Any
    along: Any
    angle: Any

    @property
    def lengths(self) -> tuple[Any, ...]:
        """Along where the tube bends to and along the tangent, at the beginning, mm."""
        return self.side, self.along

    def gains(self, xp: Any) -> tuple[Any, ...]:
        """What the tangent gains in the same directions."""
        return xp.sin(self.angle), xp.cos(self.angle) - 1


class Winding(NamedTuple):
    """Travel on a helix of a curvature k and a torsion, 1/mm: mm `straight`, then `length` of its curved part.

    Its frame of Frenet turns about one axis (Darboux vector) by w = sqrt(k^2 + torsion^2) a mm.
    """

    k: Any
    torsion: Any
    length: Any
    straight: Any
    xp: Any

    @property
    def _turned(self) -> tuple[Any, Any, Any]:
        """w, sin(w length) and 1 - cos(w length)."""
        w = self.xp.sqrt(self.k**2 + self.torsion**2)
        sin, half = self.xp.sin(w * self.length), self.xp.sin(w * self.length / 2)
        return w, sin, 2 * half * half

    @property
    def lengths(self) -> tuple[Any, ...]:
        """Along where the tube bends to, along the tangent and across both, at the beginning, mm."""
        (w, sin, rest), k, torsion = self._turned, self.k, self.torsion
        late = (self.length - sin / w) / w**2
        return k * rest / w**2, self.straight + self.length - k**2 * late, k * torsion * late

    def gains(self, xp: Any) -> tuple[Any, ...]:
        """What the tangent gains in the same directions."""
        (w, sin, rest), k = self._turned, self.k
        return k * sin / w, -(k**2) * rest / w**2, k * self.torsion * rest / w**2

    def after(self, bend: Vector, across: Vector, t: Vector) -> tuple[Vector, Vector, Vector]:
        """The frame of Frenet at the end."""
        (w, sin, rest), k, torsion = self._turned, self.k, self.torsion
        about = combined(k / w, across, torsion / w, t)
        outwards = combined(torsion / w, across, -k / w, t)
        side, turned = combined(1 - rest, bend, sin, outwards), combined(1 - rest, outwards, -sin, bend)
        return side, combined(k / w, about, torsion / w, turned), combined(torsion / w, about, -k / w, turned)


def columns_of(q: Any) -> list[Any]:
    """The entries (T, 1) of configurations or unknowns (T, n), as numpy takes them here."""
    return [column[:, None] for column in np.asarray(q, dtype=float).T]


def backbone(tubes: Tubes, q: Sequence[Any], sigma: Any, xp: Any) -> Backbone:
    """The shape C(s | q) at s = sigma beta_d, eqs. (1) and (4); q: the 2d + 2 entries."""
    travelled = travels(tubes, q[len(tubes) : 2 * len(tubes)], sigma * q[2 * len(tubes) - 1], xp)
    planes = directions(tubes, q, xp)
    point, tangent = (0.0, 0.0, 0.0), planes[0][1]
    for travel, plane in zip(travelled, planes, strict=True):
        for length, gain, vector in zip(travel.lengths, travel.gains(xp), plane, strict=True):
            point, tangent = combined(1.0, point, length, vector), combined(1.0, tangent, gain, vector)
    return Backbone(point, tangent)


def travels(tubes: Tubes, beta: Sequence[Any], s: Any, xp: Any) -> list[Travel | Winding]:
    """What is travelled on every tube to arc lengths s, mm.

    The expression has the same structure whichever tube a sample lies on; positions are C1 in beta, also where
    rounding has put a tube's end before that of the tube around it.
    """
    start, before, travelled = 0 * beta[0], 0 * beta[0], list[Travel | Winding]()
    for i in range(len(tubes)):
        here = xp.fmin(s, beta[i])
        travelled.append(_on_tube(tubes, i, beta[i] - start, beta[i] - start - (here - before), xp))
        start, before = beta[i], here
    return travelled


def directions(tubes: Tubes, q: Sequence[Any], xp: Any) -> list[tuple[Vector, ...]]:
    """Where every tube bends to, the tangent and, of a helix, across both, at the beginning of its segment."""
    alpha, beta, (theta_x, theta_y) = q[: len(tubes)], q[len(tubes) : 2 * len(tubes)], q[2 * len(tubes) :]
    d1, d2, t = base_frame(theta_x, theta_y, xp)
    start, planes = 0 * beta[0], list[tuple[Vector, ...]]()
    for i in range(len(tubes)):
        travel, turn = _on_tube(tubes, i, beta[i] - start, 0 * start, xp), alpha[i]
        if isinstance(travel, Winding):
            turn = turn + tubes[i].spin * (tubes[i].curved_length - travel.length)
        cos, sin = xp.cos(turn), xp.sin(turn)
        bend, normal = combined(cos, d1, sin, d2), combined(-sin, d1, cos, d2)
        if isinstance(travel, Winding):
            planes.append((bend, t, normal))
            bend, normal, t = travel.after(bend, normal, t)
            turn = alpha[i] + tubes[i].spin * tubes[i].curved_length
            cos, sin = xp.cos(turn), xp.sin(turn)
        else:
            planes.append((bend, t))
            c, z = xp.cos(travel.angle), xp.sin(travel.angle)
            bend, t = combined(c, bend, -z, t), combined(z, bend, c, t)
        d1, d2 = combined(cos, bend, -sin, normal), combined(sin, bend, cos, normal)
        start = beta[i]
    return planes


def _on_tube(tubes: Tubes, i: int, x_from: Any, x_to: Any, xp: Any) -> Travel | Winding:
    """Travel on tube i between distances from its tip."""
    tube = tubes[i]
    if tube.kind == "helix":
        curved_from, curved_to = (xp.fmin(x, tube.curved_length) for x in (x_from, x_to))
        length = curved_from - curved_to
        return Winding(tube.tip_curvature, tube.spin, length, x_from - x_to - length, xp)
    if not tubes[i].shown:
        return planar(tube, x_from, x_to, xp)
    end = tube.curved_length
    lead = xp.fmax(x_from, end) - xp.fmax(x_to, end)
    side, along, angle = planar(tube, xp.fmin(x_from, end), xp.fmin(x_to, end), xp)
    return Travel(side, lead + along, angle)


def planar(tube: TubeNumbers, x_from: Any, x_to: Any, xp: Any) -> Travel:
    """Travel on the curved part of a tube between distances from its tip."""
    length = x_from - x_to
    if tube.kind == "straight":
        return Travel(0 * length, length, 0 * length)
    if tube.kind == "arc":
        k = tube.tip_curvature
        sin, cos = xp.sin(k / 2 * length), xp.cos(k / 2 * length)
        return Travel(2 / k * sin * sin, 2 / k * sin * cos, k * length)
    angle_from = _turning(tube, x_from)
    side = along = 0.0
    for node, weight in zip((_NODES + 1) / 2, _WEIGHTS / 2, strict=True):
        angle = angle_from - _turning(tube, x_from - node * length)
        side, along = side + weight * xp.sin(angle), along + weight * xp.cos(angle)
    return Travel(side * length, along * length, angle_from - _turning(tube, x_to))


def _turning(tube: TubeNumbers, x: Any) -> Any:
    """Integral of the curvature over the last x mm of a tube's curved part, rad."""
    return tube.tip_curvature * x + tube.slope * x**2 / 2


def base_frame(theta_x: Any, theta_y: Any, xp: Any) -> tuple[Vector, Vector, Vector]:
    """The columns of R = Ry(theta_y) Rx(theta_x), eq. (4)."""
    cx, sx, cy, sy = xp.cos(theta_x), xp.sin(theta_x), xp.cos(theta_y), xp.sin(theta_y)
    return (cy, 0.0, -sy), (sy * sx, cx, cy * sx), (sy * cx, -sx, cy * cx)


def combined(a: Any, u: Vector, b: Any, v: Vector) -> Vector:
    """A u + b v."""
    return a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2]


def curvature(tubes: Tubes, beta: Sequence[Any], s: Any, step: Any, xp: Any) -> Any:
    """k(s | beta) in 1/mm, eq. (10), whatever alpha is; step(x) goes from 0 to 1 as x mm passes 0."""
    value = _profile(tubes, 0, beta[0] - s, step, xp)
    for i in range(1, len(tubes)):
        jump = _profile(tubes, i, beta[i] - s, step, xp) - _profile(tubes, i - 1, beta[i - 1] - s, step, xp)
        value = value + jump * step(s - beta[i - 1])
    return value


def _profile(tubes: Tubes, i: int, x: Any, step: Any, xp: Any) -> Any:
    """Pre-curvature of tube i at x mm from its tip, 1/mm."""
    tube = tubes[i]
    value = tube.tip_curvature + tube.slope * xp.fmin(xp.fmax(x, 0.0), tube.curved_length)
    return value * step(tube.curved_length - x) if tubes[i].shown else value


def curved_part(tubes: Tubes, i: int, start: Any, end: Any, xp: Any) -> tuple[Any, Any, Any]:
    """Where between start and end (mm) tube i begins to curve, k there (1/mm) and dk/ds (1/mm^2)."""
    tube = tubes[i]
    low = xp.fmax(start, end - tube.curved_length) if tubes[i].shown else start
    return low, tube.tip_curvature + tube.slope * (end - low), -tube.slope
