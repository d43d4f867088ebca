"""Robots on a wall that gives, by collocation from base to tip: nothing of the library's rods is used here."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_bvp

from ctr_nlp import Robot
from ctr_nlp.loads.winkler_wall import TOE_DEPTH_MM


def compressed(depth):
    """Push over stiffness at depths, mm: an integral of the stiffness, which grows along a smooth step."""
    part = np.clip(0.5 + depth / TOE_DEPTH_MM, 0, 1)
    return TOE_DEPTH_MM * (part**3 - part**4 / 2) + np.maximum(depth - TOE_DEPTH_MM / 2, 0)


class Plane:
    """The half space of points whose part along a normal is below an offset, mm."""

    def __init__(self, normal, offset, stiffness):
        self.normal = (np.asarray(normal, dtype=float) / np.linalg.norm(normal))[:, None]
        self.offset, self.stiffness = offset, stiffness

    def push(self, points, tube_radius):
        """Force per length (3, n), N/mm, on a robot's axis at points (3, n), mm."""
        over = (self.normal * points).sum(axis=0) + tube_radius - self.offset
        return -self.stiffness * compressed(over) * self.normal


class Cylinder:
    """A straight lumen of a radius, mm, around the line through a point along a direction."""

    def __init__(self, point, direction, radius, stiffness):
        self.point = np.asarray(point, dtype=float)[:, None]
        self.direction = (np.asarray(direction, dtype=float) / np.linalg.norm(direction))[:, None]
        self.radius, self.stiffness = radius, stiffness

    def push(self, points, tube_radius):
        """Force per length (3, n), N/mm, on a robot's axis at points (3, n), mm."""
        away = points - self.point
        away = away - self.direction * (away * self.direction).sum(axis=0)
        return self._push(away, tube_radius)

    def _push(self, away, tube_radius):
        distance = np.maximum(np.linalg.norm(away, axis=0), 1e-12)
        over = tube_radius - self.radius
        amount = compressed(over + distance) - compressed(over - distance)
        return -self.stiffness * amount * away / distance


class Bend(Cylinder):
    """A lumen of a radius, mm, around the circle that leaves the origin along z and bends towards a direction."""

    def __init__(self, bend_radius, towards, radius, stiffness):
        x = np.array([np.cos(towards), np.sin(towards), 0.0])[:, None]
        self.x, self.bend_radius = x, bend_radius
        self.radius, self.stiffness = radius, stiffness

    def push(self, points, tube_radius):
        from_centre = points - self.bend_radius * self.x
        z = np.array([0.0, 0.0, 1.0])[:, None]
        in_plane = self.x * (from_centre * self.x).sum(axis=0) + z * (from_centre * z).sum(axis=0)
        circle = self.bend_radius * (self.x + in_plane / np.linalg.norm(in_plane, axis=0))
        return self._push(points - circle, tube_radius)


def solve_contact(robot: Robot, q, wall, start, tip, tolerance=1e-6):
    """Solve for a robot on a wall, from a shape and the angles of its tubes at the tip to start from.

    start: returns points and tangents (n, 3) at arc lengths (n,), mm. tip: angles (d,) of the tubes, each at its
    own tip, rad, and the frame (3, 3) at the robot's tip that they are relative to. A robot on a wall may have
    several equilibria: angles decide which of them is found. Returns a function from arc lengths to points, and
    the sum of the wall's forces' sizes, N. Tubes have one curvature each and are extended by no straight part. The
    unknowns of every section between ends of tubes are, side by side, p, d_1, t, m, n, psi and psi'.
    """
    d = robot.d
    alpha, beta, theta = q[:d], q[d : 2 * d], q[2 * d :]
    edges = np.concatenate([[0.0], beta])
    lengths = np.diff(edges)
    bending = np.array([tube.bending_stiffness for tube in robot.tubes])
    twisting = np.array([tube.bending_stiffness / (1 + tube.poisson_ratio) for tube in robot.tubes])
    curvature = np.array([tube.tip_curvature for tube in robot.tubes])
    radii = [tube.outer_diameter / 2 for tube in robot.tubes]
    free = np.array([tube.length for tube in robot.tubes]) - beta
    size = 15 + 2 * d
    cx, sx, cy, sy = np.cos(theta[0]), np.sin(theta[0]), np.cos(theta[1]), np.sin(theta[1])
    base = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])

    def bend(k, d1, t, m, psi):
        """Bending (2, n) of section k in d_1 and d_2, 1/mm, and second derivatives (d, n) of the tubes' angles."""
        present = slice(k, d)
        pull = bending[present, None] * curvature[present, None]
        cos, sin = np.cos(psi[present]), np.sin(psi[present])
        d2 = np.cross(t, d1, axis=0)
        u1 = ((m * d2).sum(axis=0) + (pull * cos).sum(axis=0)) / bending[present].sum()
        u2 = (-(m * d1).sum(axis=0) + (pull * sin).sum(axis=0)) / bending[present].sum()
        turning = np.zeros_like(psi)
        turning[present] = pull / twisting[present, None] * (u1 * sin - u2 * cos)
        return u1, u2, turning

    def slopes(x, y):
        found = np.zeros_like(y)
        for k in range(d):
            here = y[k * size : (k + 1) * size]
            p, d1, t, m, n = (here[3 * j : 3 * j + 3] for j in range(5))
            psi, rate = here[15 : 15 + d], here[15 + d :]
            u1, u2, turning = bend(k, d1, t, m, psi)
            moving = rate.copy()
            moving[:k] = 0.0
            d2 = np.cross(t, d1, axis=0)
            parts = [t, -u1 * t, u1 * d1 + u2 * d2, -np.cross(t, n, axis=0), -wall.push(p, radii[k])]
            found[k * size : (k + 1) * size] = lengths[k] * np.vstack([*parts, moving, turning])
        return found

    def ends(a, b):
        first = a[:size]
        found = [first[:3], first[3:6] - base[:, 0], first[6:9] - base[:, 2]]
        found.append(first[15 : 15 + d] - alpha - first[15 + d :] * free)
        for k in range(d):
            last = b[k * size : (k + 1) * size]
            if k + 1 < d:
                # A tube that ends here has no rate of twist; all else goes on. Beyond its end it is constant.
                following = a[(k + 1) * size : (k + 2) * size]
                jump = following - last
                jump[15 + d + k] = last[15 + d + k]
                found.append(jump)
            else:
                found += [last[9:12], last[12:15], last[15 + d :]]
        return np.concatenate(found)

    # Internal force and moment to start from: those of the wall's pushes on the shape beyond each place.
    along = np.linspace(0.0, beta[-1], 401)
    shape = start(along)[0]
    which = np.minimum((along[:, None] > beta[None]).sum(axis=1), d - 1)
    pushes = np.stack([wall.push(p[:, None], radii[k])[:, 0] for p, k in zip(shape, which, strict=True)])

    def beyond(values):
        steps = (values[1:] + values[:-1]) / 2 * np.diff(along)[:, None]
        return np.vstack([np.cumsum(steps[::-1], axis=0)[::-1], np.zeros((1, 3))])

    forces = beyond(pushes)
    moments = beyond(np.cross(shape, pushes)) - np.cross(shape, forces)
    # A frame that does not spin, carried along the shape, and the tubes' angles in it, from their tips to the
    # base.
    tangents = start(along)[1]
    frames = [base[:, 0]]
    for t in tangents[1:]:
        carried = frames[-1] - t * (t @ frames[-1])
        frames.append(carried / np.linalg.norm(carried))
    angles, axes = tip
    spun = np.arctan2(axes[0] @ np.cross(tangents[-1], frames[-1]), axes[0] @ frames[-1])
    turned, rates = np.zeros((2, len(along), d))
    turned[-1] = angles + spun
    for j in range(len(along) - 1, 0, -1):
        k = which[j]
        step = along[j] - along[j - 1]
        columns = (each[:, None] for each in (frames[j], tangents[j], moments[j], turned[j]))
        rates[j - 1] = rates[j] - step * bend(k, *columns)[2][:, 0]
        turned[j - 1] = turned[j] - step * rates[j - 1]
    # Whole turns of all tubes together are free.
    turned += 2 * np.pi * np.round((alpha[-1] - turned[0, -1] + rates[0, -1] * free[-1]) / (2 * np.pi))
    given = np.hstack([shape, np.array(frames), tangents, moments, forces, turned, rates])
    x = np.linspace(0, 1, 41)
    y = np.zeros((d * size, len(x)))
    for k in range(d):
        at = edges[k] + lengths[k] * x
        here = y[k * size : (k + 1) * size]
        for j in range(size):
            here[j] = np.interp(at, along, given[:, j])
    solved = solve_bvp(slopes, ends, x, y, tol=tolerance, max_nodes=20_000)
    assert solved.success, solved.message
    fine = np.linspace(0, 1, 4001)
    values = solved.sol(fine)
    force = sum(
        lengths[k]
        * np.trapezoid(np.linalg.norm(wall.push(values[k * size : k * size + 3], radii[k]), axis=0), fine)
        for k in range(d)
    )

    def points(s):
        k = np.minimum((s[:, None] > beta[None]).sum(axis=1), d - 1)
        at = solved.sol((s - edges[k]) / lengths[k])
        return np.array([at[size * k[j] : size * k[j] + 3, j] for j in range(len(s))])

    return points, float(force)
