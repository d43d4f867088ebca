"""Linear systems of a shared motion: a band over all frames, bordered by the unknowns that they have in common."""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from ctr_nlp.typing import Array, Flags

HELD = 1e10
"""What stands on the diagonal where an unknown is fixed."""


def solved(links: Array, blocks: Array, corner: Array, diagonal: Array, right: Array, free: Flags) -> Array | None:
    """The solution (T n + P,) of a symmetric system; None where it is not positive definite.

    links: a band over q; blocks (T, n + P, n + P): of every frame over q and p, added up over p; corner (P, P):
    more over p; diagonal, right, free (T n + P,): more on the diagonal, the right-hand side, and which unknowns
    are not fixed. The band is factorised once, and p has a dense system of its own: the Schur complement.
    """
    frames, size = len(blocks), len(corner)
    n = blocks.shape[1] - size
    band, border = links.copy(), blocks[:, :n, n:].reshape(frames * n, size)
    for below in range(n):
        along = np.arange(n - below)
        band[below].reshape(frames, n)[:, along] += blocks[:, along + below, along]
    held = np.where(free, diagonal, HELD)
    band[0] += held[: frames * n]
    right, border = right * free, border * free[: frames * n, None] * free[frames * n :]
    try:
        factor = cholesky_banded(band, lower=True, check_finite=False)
        columns = np.column_stack([right[: frames * n], border])
        found = cho_solve_banded((factor, True), columns, check_finite=False)
        if not size:
            return np.asarray(found[:, 0] * free)
        of_p = free[frames * n :]
        whole = (corner + blocks[:, n:, n:].sum(axis=0)) * of_p * of_p[:, None] + np.diag(held[frames * n :])
        schur = cho_factor(whole - border.T @ found[:, 1:], lower=True)
        step = cho_solve(schur, right[frames * n :] - border.T @ found[:, 0])
    except LinAlgError:
        return None
    return np.append(found[:, 0] - found[:, 1:] @ step, step) * free
