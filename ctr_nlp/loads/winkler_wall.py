"""A wall as an elastic (Winkler) foundation: the force per length that it exerts on points of a robot, and its
slope.

At a depth D of the robot's surface beyond the wall, mm, the wall presses with k P(D) per mm of the robot, N/mm,
towards the lumen's path. Where the lumen is narrower than the robot, the far side presses, too, with k P(B). With
a = p - c the vector from the path's nearest point c to the point p of the robot's axis, e = a / |a|, t the path's
tangent, kappa its curvature vector and r' the growth of the lumen's radius along the tangent,

    w = -k (P(D) - P(B)) e,   dD/dp = e - r' t,   dB/dp = -e - r' t,   dc/dp = t t^T / (1 - a . kappa).

The last one holds between the path's ends; beyond them c stays.

The wall of a body is known by its signed distance d(p), positive inside (paths/distance_field.py). Its depth is
D = r - d for a robot of radius r, and it presses with

    w = k P(D) grad d,   dw/dp = k (P(D) hess d - P'(D) grad d grad d^T),

the slope of an energy. The gradient's length is 1, but for the middle of a lumen, where it vanishes smoothly, so
that both sides of a lumen that is narrower than the robot press. Of several walls each presses on the robot.

Winkler's P(D) is max(0, D). Here its slope grows smoothly from 0 to 1 over a toe of h mm around depth 0,

    P'(D) = 3 x^2 - 2 x^3,   P(D) = h (x^3 - x^4 / 2),   x = 1 / 2 + D / h in [0, 1],   and beyond   P(D) = D,

so that forces are Winkler's from h / 2 on, and larger by at most 0.1 k h before, never smaller.
With a corner at 0, shapes and forces would have corners as functions of q, stability margins jumps, and searches
over q would end at these.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctr_nlp.ocp.compiled_wall import WallDistance
from ctr_nlp.paths.lumen import LumenProjection
from ctr_nlp.paths.walls import WallGeometry, Walls
from ctr_nlp.typing import Array, Flags

NEGLIGIBLE_DISTANCE_MM = 1e-9
"""Distance from the path below which a push has no direction and counts as 0, mm."""
MIN_PATH_STRETCH = 0.1
"""Least 1 - a . kappa: at 0 the point is the path's centre of curvature, and has no nearest point."""
TOE_DEPTH_MM, PLANNED_TOE_DEPTH_MM = 0.02, 1.0
"""Depth over which the stiffness of a wall grows from 0, half of it before the surface, mm: of a robot whose
equilibrium is asked for, and in searches for plans. The latter was chosen by trial: with 0.1 mm searches over
motions take several times as long to converge, since a robot's tip moves by tens of mm for a rad of its motors.
"""


class WallPush(NamedTuple):
    """Depth and push of a wall at points (..,) of a robot's axis, and the push's slope.

    beyond (..,): how far the robot's surface is beyond the wall, mm, negative where it does not touch. push (..,
    3): force per length on the robot, N/mm. slope (.., 3, 3): its derivative by the point, N/mm per mm; flat_slope
    (.., 3, 3): the same of a wall that is flat around each point.
    """

    beyond: Array
    push: Array
    slope: Array
    flat_slope: Array


@dataclass(frozen=True)
class WinklerWall:
    """A wall that gives.

    stiffness: k, N/mm for every mm of depth and every mm of length along the robot. toe: depth h over which it
    grows from 0, half of it before the surface, mm.
    """

    geometry: WallGeometry
    stiffness: float
    toe: float = TOE_DEPTH_MM

    @cached_property
    def _distance(self) -> WallDistance:
        """All walls as C reads them."""
        return WallDistance(self.geometry)

    @cached_property
    def _lumen_distance(self) -> WallDistance | None:
        """The lumen around a path, where that is a wall."""
        lumen = self.geometry.lumen if isinstance(self.geometry, Walls) else self.geometry
        return None if lumen is None else WallDistance(lumen)

    def push(self, points: Array, radius: Array) -> WallPush:
        """Return what the walls do to points (.., 3), mm, of a robot of these radii (..,), mm."""
        beyond = np.full(points.shape[:-1], -np.inf)
        push, slope, flat = np.zeros(points.shape), *np.zeros((2, *points.shape, 3))
        if self._lumen_distance is not None:
            near = self._lumen_distance.project(points)
            beyond, push, slope, flat = self._push_of_path(near, points, radius)
        for room, gradient, hessian in self._distance.evaluate_bodies(points):
            depth = radius - room
            pressed, hardness = _compress(depth, self.toe)
            beyond = np.maximum(beyond, depth)
            push = push + self.stiffness * pressed[..., None] * gradient
            hardened = self.stiffness * hardness[..., None, None] * _outer(gradient, gradient)
            slope = slope + self.stiffness * pressed[..., None, None] * hessian - hardened
            flat = flat - hardened
        return WallPush(beyond, push, slope, flat)

    def is_narrower(self, points: Array, radius: Array) -> Flags:
        """Return whether the lumen at points (.., 3), mm, is narrower than a robot of these radii (..,), mm."""
        return np.asarray(radius > self._distance.project(points).radius)

    def _push_of_path(self, near: LumenProjection, points: Array, radius: Array) -> WallPush:
        """Return what the lumen around a path does to points; near: the path there."""
        over = radius - near.radius
        pressed, hardness = _compress(over + near.distance, self.toe)
        pressed_behind, hardness_behind = _compress(over - near.distance, self.toe)
        away = np.maximum(near.distance, NEGLIGIBLE_DISTANCE_MM)
        e = (points - near.centre) / away[..., None]
        amount = pressed - pressed_behind
        widening = near.taper[..., None] * near.tangent
        growth = hardness[..., None] * (e - widening) + hardness_behind[..., None] * (e + widening)
        # The path's nearest point moves along the tangent, unless it is an end of the path.
        inside = (near.length_before > 0) & (near.length_after > 0)
        stretch = np.maximum(1.0 - ((points - near.centre) * near.curvature_vector).sum(axis=-1), MIN_PATH_STRETCH)
        follows = np.where(inside, 1.0 / stretch, 0.0)[..., None, None]
        turning = np.eye(3) - _outer(e, e) - follows * _outer(near.tangent, near.tangent)
        # e turns by (I - e e^T)(da) / |a|; t is perpendicular to e, so that the product has three terms.
        flat = -self.stiffness * _outer(e, growth)
        slope = flat - self.stiffness * (amount / away)[..., None, None] * turning
        return WallPush(over + near.distance, -self.stiffness * amount[..., None] * e, slope, flat)


def _compress(depth: Array, toe: float) -> tuple[Array, Array]:
    """Return P, mm, and its slope at depths (..,), mm, negative outside of the wall; toe: h, mm."""
    part = np.clip(0.5 + depth / toe, 0.0, 1.0)
    beyond = np.maximum(depth - toe / 2, 0.0)
    return toe * part**3 * (1 - part / 2) + beyond, part**2 * (3 - 2 * part)


def _outer(a: Array, b: Array) -> Array:
    """Return the products a b^T (.., 3, 3) of vectors (.., 3)."""
    return np.asarray(a[..., :, None] * b[..., None, :])
