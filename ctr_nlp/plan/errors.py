"""Errors of a plan, section IV of the paper, always against the target itself."""

from __future__ import annotations

import numpy as np

from ctr_nlp.plan.record import Record
from ctr_nlp.target.target import QUADRATURE
from ctr_nlp.typing import Array


def rms_over_sigma(distance: Array) -> Array:
    """Root mean square over sigma of (.., 101) distances in mm, with trapezoidal weights."""
    return np.sqrt(distance**2 @ QUADRATURE)


def e1(plan: Record) -> Array:
    """Distance (T, 101) in mm between shape and target at the same sigma."""
    return np.linalg.norm(plan.shape - plan.target, axis=-1)


def nearest(plan: Record) -> Array:
    """Distance (T, 101) in mm from each point of the shape to the nearest point of its frame's target."""
    return np.array([_to_polyline(shape, target) for shape, target in zip(plan.shape, plan.target, strict=True)])


def _to_polyline(points: Array, line: Array) -> Array:
    """Distance (n,) from points (n, 3) to the polyline through line (m, 3)."""
    start, span = line[:-1], np.diff(line, axis=0)
    offset = points[:, None] - start
    along = np.clip((offset * span).sum(-1) / np.maximum((span**2).sum(-1), 1e-30), 0.0, 1.0)
    return np.linalg.norm(offset - along[..., None] * span, axis=-1).min(axis=1)


def e3(plan: Record) -> float | None:
    """Root mean square over frames of e2, mm, of those whose shape is known; None without any."""
    return root_mean_square(rms_over_sigma(e1(plan)))


def root_mean_square(values: Array) -> float | None:
    """That of those among (T,) values that are known; None without any."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else None


def tip_angle(plan: Record) -> Array:
    """Angle (T,) in rad between the tip's direction and the target's."""
    cross = np.linalg.norm(np.cross(plan.tip_direction, plan.target_direction), axis=-1)
    return np.arctan2(cross, (plan.tip_direction * plan.target_direction).sum(-1))
