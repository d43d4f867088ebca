"""Tips of loaded robots: angles of tubes relative to a frame, and the unknowns that a model tells of them."""

from __future__ import annotations

import numpy as np

from ctr_nlp.typing import Array, Vector


def axes_of(vectors: tuple[Vector, Vector, Vector]) -> Array:
    """Frames (T, 3, 3), row by row d_1, d_2 and t, of their columns (T,)."""
    return np.stack(
        [np.stack(np.broadcast_arrays(*vector, vectors[2][2])[:3], axis=-1) for vector in vectors], axis=1
    )


def turned(angles: Array, axes: Array, step: Array) -> tuple[Array, Array]:
    """Tips (T, d), (T, 3, 3) after changes (T, d + 2): turns about d_1 and d_2, and of the angles."""
    turns = np.concatenate([step[:, :2], np.zeros((len(step), 1))], axis=1)
    return angles + step[:, 2:], np.swapaxes(rotations(turns), 1, 2) @ axes


def rotations(vectors: Array) -> Array:
    """The matrices (T, 3, 3) of rotation vectors (T, 3), by Rodrigues' formula."""
    square = (vectors**2).sum(axis=1)[:, None, None]
    angle = np.sqrt(square)
    x, y, z = vectors.T
    none = np.zeros_like(x)
    cross = np.array([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * cross @ cross


def unknowns(angles: Array, axes: Array, q: Array) -> Array:
    """The x (T, 2d + 2) of tips: psi_i less psi_d, psi_d, beta, and w; (w_1, w_2, 0) is the tip's rotation vector.

    psi is relative to the frame that this rotation makes of the base's directions, and psi_d within half a turn of
    the alpha_d of q (T, 2d + 2). The half turn has no such w.
    """
    t = axes[:, 2]
    sine = np.hypot(t[:, 0], t[:, 1])
    factor = np.arctan2(sine, t[:, 2]) / np.maximum(sine, 1e-300)
    w = np.where(sine[:, None] > 0, factor[:, None] * np.stack([-t[:, 1], t[:, 0]], axis=1), 0.0)
    made = _frames(w)
    cos, sin = (axes[:, 0] * made[:, 0]).sum(axis=1), (axes[:, 0] * made[:, 1]).sum(axis=1)
    d = angles.shape[1]
    spun = angles[:, -1] + np.arctan2(sin, cos)
    spun -= 2 * np.pi * np.round((spun - q[:, d - 1]) / (2 * np.pi))
    return np.hstack([angles[:, :-1] - angles[:, -1:], spun[:, None], q[:, d : 2 * d], w])


def tips(x: Array, d: int) -> tuple[Array, Array]:
    """Angles (T, d) and axes (T, 3, 3) of unknowns x (T, 2d + 2)."""
    return tip_angles(x, d), _frames(x[:, 2 * d :])


def tip_angles(x: Array, d: int) -> Array:
    """The angles (T, d) of tips in one frame, of unknowns x (T, 2d + 2), with a load or without."""
    angles = x[:, :d].copy()
    angles[:, : d - 1] += angles[:, d - 1 :]
    return angles


def _frames(w: Array) -> Array:
    return np.swapaxes(rotations(np.hstack([w, np.zeros((len(w), 1))])), 1, 2)
