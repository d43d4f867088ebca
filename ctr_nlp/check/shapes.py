"""Shapes of robots whose tubes are integrated: the centreline from its bending vector.

The frame turns along the body by R' = R hat(w), w = (-u_y, u_x, 0), and its third column is the tangent t.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_nlp.check.tubes import Array, Twist, interpolate_cubic

GAUSS = 0.5 - np.sqrt(3) / 6, 0.5 + np.sqrt(3) / 6
"""Fractions of a step at which Gauss's quadrature of order 4 evaluates, with equal weights."""


@dataclass(frozen=True, eq=False)
class RobotShape:
    """Shapes of n robots at the ends of N steps: s (N + 1, n) mm, points and unit tangents (N + 1, n, 3).

    radius (N, n): of the outermost tube on each step, mm, 0 on steps of no length. Between ends a shape is a cubic
    in s.
    """

    s: Array
    points: Array
    tangents: Array
    radius: Array

    def interpolate(self, sigma: Array) -> Array:
        """Return points (n, m, 3) mm at parts sigma (m,) or (n, m) of the whole length."""
        s = sigma * self.s[-1][:, None]
        # The last end at or before s; steps of length 0, where two tubes end together, are passed over.
        step = np.clip((self.s[:, :, None] <= s[None]).sum(axis=0) - 1, 0, len(self.s) - 2)
        rows = np.arange(len(s))[:, None]
        h = self.s[step + 1, rows] - self.s[step, rows]
        z = np.clip((s - self.s[step, rows]) / np.maximum(h, 1e-12), 0.0, 1.0)
        ends = [each[at, rows] for at in (step, step + 1) for each in (self.points, self.tangents)]
        return interpolate_cubic(z[..., None], h[..., None], *ends)

    def find_places(self, spacing: float) -> tuple[Array, Array]:
        """Return points (n, m, 3), mm, at most `spacing` apart, and the radii (n, m) of the robots there.

        Both ends of every step count: where a tube ends, the place belongs to the wider tube as well.
        """
        h = np.diff(self.s, axis=0)[:, None]
        fractions = np.linspace(0, 1, int(np.ceil(h.max() / spacing)) + 1)
        sigma = ((self.s[:-1, None] + fractions[:, None] * h) / self.s[-1]).reshape(-1, len(self.s[-1]))
        return self.interpolate(sigma.T), np.repeat(self.radius, len(fractions), axis=0).T


def compute_body(twist: Twist, theta: Array) -> RobotShape:
    """Shapes of robots at base tilts theta (2, n), rad: R = Ry(theta_y) Rx(theta_x).

    The frame by Magnus' method of order 4 on Gauss's two points of every step. Points follow from the tangents t
    and t' = R (u_x, u_y, 0) at the ends of steps, by Hermite's quadrature of order 4.
    """
    h = twist.h[..., None]
    first, second = (np.stack([-u.imag, u.real, 0 * u.real], axis=-1) for u in map(twist.bending, GAUSS))
    turn = h / 2 * (first + second) + np.sqrt(3) / 12 * h**2 * np.cross(first, second)
    turns = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*turn.shape, 3)
    frames = [Rotation.from_euler("YX", theta[::-1].T).as_matrix()]
    for step in turns:
        frames.append(frames[-1] @ step)
    d1, d2, t = np.moveaxis(np.array(frames), -1, 0)
    start, end = (twist.bending(z)[..., None] for z in (0.0, 1.0))
    bent = d1[:-1] * start.real + d2[:-1] * start.imag - d1[1:] * end.real - d2[1:] * end.imag
    steps = h / 2 * (t[:-1] + t[1:]) + h**2 / 12 * bent
    points = np.cumsum(np.concatenate([np.zeros_like(steps[:1]), steps]), axis=0)
    outermost = np.take_along_axis(twist.tubes.radius, twist.present.argmax(axis=1), axis=0)
    return RobotShape(twist.s, points, t, np.where(twist.h > 0, outermost, 0.0))
