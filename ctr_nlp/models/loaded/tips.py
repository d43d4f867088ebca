"""Tips of loaded robots: angles of tubes relative to a frame there, and the unknowns x that stand for them.

    x = (psi_1 - psi_d, .., psi_(d-1) - psi_d, psi_d, beta_1, .., beta_d, w_1, w_2)        (2d + 2,)

The frame of a tip may be spun about its tangent if all angles are spun back. x has the frame whose rotation vector
(w_1, w_2, 0), rad, has no part along z: two numbers for the tangent's direction.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.typing import Array, Vector


def axes_of(vectors: tuple[Vector, Vector, Vector]) -> Array:
    """Return frames (T, 3, 3), row by row d_1, d_2 and t, from vectors whose components are columns (T,)."""
    return np.stack(
        [np.stack(np.broadcast_arrays(*vector, vectors[2][2])[:3], axis=-1) for vector in vectors], axis=1
    )


def turn_tips(angles: Array, axes: Array, step: Array) -> tuple[Array, Array]:
    """Return tips after changes step (T, d + 2): turns about d_1 and d_2, and changes of the angles, rad.

    angles (T, d), rad, and axes (T, 3, 3): of the tips, which turn about their own axes.
    """
    turns = np.concatenate([step[:, :2], np.zeros((len(step), 1))], axis=1)
    # Axes are rows here: the turn in the tip's own axes is applied from the left, transposed.
    return angles + step[:, 2:], np.swapaxes(rotations(turns), 1, 2) @ axes


def rotations(vectors: Array) -> Array:
    """Return the matrices (T, 3, 3) of rotation vectors (T, 3), rad, by Rodrigues' formula."""
    square = (vectors**2).sum(axis=1)[:, None, None]
    angle = np.sqrt(square)
    x, y, z = vectors.T
    none = np.zeros_like(x)
    cross = np.array([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)
    # numpy's sinc(x) is sin(pi x) / (pi x), so that these are sin(a) / a and (1 - cos a) / a^2 = (sin(a/2) /
    # (a/2))^2 / 2, smooth at 0.
    return np.eye(3) + np.sinc(angle / np.pi) * cross + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * cross @ cross


def unknowns(angles: Array, axes: Array, q: Array) -> Array:
    """Return the unknowns x (T, 2d + 2) of tips with angles (T, d) relative to axes (T, 3, 3), at q (T, 2d + 2).

    psi_d is within half a turn of alpha_d. A tip that points along -z has no such w.
    """
    t = axes[:, 2]
    sine = np.hypot(t[:, 0], t[:, 1])
    # The rotation from z to t is about z x t = (-t_y, t_x, 0), by the angle between both.
    factor = np.arctan2(sine, t[:, 2]) / np.maximum(sine, 1e-300)
    w = np.where(sine[:, None] > 0, factor[:, None] * np.stack([-t[:, 1], t[:, 0]], axis=1), 0.0)
    made = _frames(w)
    cos = (axes[:, 0] * made[:, 0]).sum(axis=1)
    sin = (axes[:, 0] * made[:, 1]).sum(axis=1)
    d = angles.shape[1]
    # The angle by which the given frame is spun from the one that w makes is added to the innermost angle; the
    # others are relative to it.
    spun = angles[:, -1] + np.arctan2(sin, cos)
    # Whole turns of all tubes together do not change the shape; the one nearest to alpha_d is taken here, and
    # follower.py makes it continuous along a motion.
    spun -= 2 * np.pi * np.round((spun - q[:, d - 1]) / (2 * np.pi))
    return np.hstack([angles[:, :-1] - angles[:, -1:], spun[:, None], q[:, d : 2 * d], w])


def tips(x: Array, d: int) -> tuple[Array, Array]:
    """Return angles (T, d), rad, and axes (T, 3, 3) of the tips of unknowns x (T, 2d + 2)."""
    return tip_angles(x, d), _frames(x[:, 2 * d :])


def tip_angles(x: Array, d: int) -> Array:
    """Return the angles (T, d) of tips in one frame, rad, of unknowns x (T, 2d + 2) with a load or without."""
    angles = x[:, :d].copy()
    angles[:, : d - 1] += angles[:, d - 1 :]
    return angles


def _frames(w: Array) -> Array:
    """Return the frames (T, 3, 3) of rotation vectors (w_1, w_2, 0), w (T, 2) in rad, row by row d_1, d_2
    and t.
    """
    # Transposed, since the axes are the columns of a rotation matrix and rows here.
    return np.swapaxes(rotations(np.hstack([w, np.zeros((len(w), 1))])), 1, 2)
