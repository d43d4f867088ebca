"""Lumens to test on, and where points are in them by brute force."""

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_nlp import Curve, curve_from_points
from ctr_nlp.paths.target import SIGMA_GRID


def wandering(seed, bend=1 / 20, length=90.0):
    """A smooth path in space that starts upwards and bends by up to so much, 1/mm, with a radius."""
    rng = np.random.default_rng(seed)
    u = np.linspace(0, 1, 200)
    waves = [rng.normal(size=(3, 1)) * np.sin(2 * np.pi * k * u + rng.uniform(0, 6)) for k in (1, 2)]
    rates, step = sum(waves).T, length / (len(u) - 1)
    headings = [np.array([0.0, 0.0, 1.0])]
    for rate in rates[1:] * bend / np.linalg.norm(rates, axis=1).max():
        headings.append(Rotation.from_rotvec(step * rate).apply(headings[-1]))
    points = np.cumsum([0 * headings[0], *headings[:-1]], axis=0) * step
    return curve_from_points(points, 3 + 2 * np.cos(3 * u + rng.uniform(0, 6)))


def straight(radius, length=120.0):
    """A lumen along z from the origin, as wide everywhere."""
    z = np.linspace(0, length, 61)
    return curve_from_points(np.outer(z, [0, 0, 1.0]), np.full(len(z), radius))


def bent(radius, length=120.0):
    """A lumen from the origin, as wide everywhere, which bends in space: unlike in a straight one, it matters how
    a robot in it is turned about its own axis."""
    z = np.linspace(0, length, 61)
    points = np.stack([8 * (1 - np.cos(z / 60)), 2e-6 * z**3, z], axis=-1)
    return curve_from_points(points, np.full(len(z), radius))


def brute(curve: Curve, points):
    """Distances (n,) from points (n, 3) to a curve and where along it, from a polyline of 0.01 mm steps."""
    s = np.linspace(0, curve.length, int(curve.length / 0.01))
    line, found = curve.point(s), []
    for point in points:
        i = np.clip(np.linalg.norm(line - point, axis=1).argmin() - np.arange(2), 0, len(s) - 2)
        span = line[i + 1] - line[i]
        part = np.clip(((point - line[i]) * span).sum(-1) / (span**2).sum(-1), 0, 1)
        away = np.linalg.norm(point - line[i] - part[:, None] * span, axis=1)
        found.append(min(zip(away, s[i] + part * s[1], strict=True)))
    return np.array(found).T


def away_from_tube_ends(plan):
    """Flags (T, 101) of points that have no end of an outer tube between them and the next one."""
    found = np.ones((len(plan.beta), len(SIGMA_GRID)), dtype=bool)
    before = (100 * plan.beta[:, :-1] / plan.beta[:, -1:] + 1e-9).astype(int).clip(max=99)
    found[np.arange(len(found))[:, None], before] = False
    return found
