"""Stability of equilibria, from the second variation of the energy.

    E = sum_i int GJ_i psi_i'^2 / 2 ds - int |sum_i EI_i k_i e_i|^2 / (2 sum_i EI_i) ds

with the transmissions in the first term, K. The stability margin mu is the smallest eigenvalue of
(K + V'') x = mu K x, where V'' belongs to the second term: 1 for uncoupled tubes, 0 where a robot snaps.

Variations of psi are made of modes that are orthonormal in K, so that K is the identity. Of tube i they are: its
base turns (the transmission twists), and on every piece that it reaches, psi_i' is a polynomial of Legendre.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import legvander

from ctr_nlp.check.shapes import GAUSS
from ctr_nlp.check.tubes import Array, Twist

MODE_DEGREE = 6
"""Highest degree of the polynomials, on each piece of the body, that variations of psi' are made of."""


def compute_stability_margins(twist: Twist) -> Array:
    """Stability margins mu (n,) of equilibria.

    A mode of tube i at the Q points of Gauss is shape (n, Q, M), which all tubes share, times scale (n, d, M).
    """
    lengths = np.diff(twist.bounds, axis=0)
    s = np.concatenate([twist.s[:-1] + z * twist.h for z in GAUSS])
    part = np.clip((s[:, None] - twist.bounds[:-1]) / np.maximum(lengths, 1e-12), 0.0, 1.0)
    p = legvander(2 * part - 1, MODE_DEGREE + 1)
    # The integral of P_m from -1 on is (P_m+1 - P_m-1) / (2m + 1), and that of P_0 is P_1 + 1. The square of
    # P_m over a piece of length h has the integral h / (2m + 1), so that roots of it make the energy 1.
    whole = p[..., 1:] - np.concatenate([-p[..., :1], p[..., :-2]], axis=-1)
    whole *= np.sqrt(lengths[..., None] / (2 * np.arange(MODE_DEGREE + 1) + 1)) / 2
    rows = np.moveaxis(whole, 2, 0).reshape(s.shape[1], len(s), -1)
    shape = np.concatenate([np.ones_like(rows[..., :1]), rows], axis=2)[:, None, None]
    present = (twist.bounds[:-1] + lengths / 2)[:, None] < twist.beta
    base = (twist.tubes.length - twist.beta)[None]
    scale = np.concatenate([base, np.repeat(present, MODE_DEGREE + 1, axis=0)]) / twist.tubes.torsional
    scale = np.sqrt(scale).transpose(2, 1, 0)
    pull = np.concatenate([twist.pulls(z) for z in GAUSS]).transpose(2, 1, 0)
    # -d^2 / dpsi_i dpsi_j of |sum EI k e|^2 / (2 sum EI), at every point of Gauss
    density = -(np.conj(pull)[:, :, None] * pull[:, None]).real
    own = np.arange(pull.shape[1])
    density[:, own, own] += (np.conj(pull) * pull.sum(axis=1, keepdims=True)).real
    density *= np.tile(twist.h / (2 * twist.total), (2, 1)).T[:, None, None]
    found = np.swapaxes(shape, -1, -2) @ (density[..., None] * shape)
    found = found * scale[:, :, None, :, None] * scale[:, None, :, None]
    n, d, _, count, _ = found.shape
    return np.asarray(1 + np.linalg.eigvalsh(found.swapaxes(2, 3).reshape(n, d * count, d * count))[:, 0])
