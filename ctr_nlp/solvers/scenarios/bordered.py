"""Linear systems of a shared motion: a band over all frames, bordered by the unknowns that they have in common.

With B the banded matrix over q (T n), E the border over q and p (P unknowns common to all frames) and C the corner
over p, the system is

    | B   E | | dq |   | r_q |                (C - E' B^-1 E) dp = r_p - E' B^-1 r_q,
    | E'  C | | dp | = | r_p |    solved as   dq = B^-1 r_q - B^-1 E dp.

B is factorised once (Cholesky), for r_q and all columns of E; the Schur complement in parentheses is dense and
small.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from ctr_nlp.typing import Array, Flags

FIXED_UNKNOWN_DIAGONAL = 1e10
"""Number on the diagonal of a fixed unknown, with a right-hand side of 0: its step is then 0."""


def solve_bordered_system(
    links: Array, blocks: Array, corner: Array, diagonal: Array, right: Array, free: Flags
) -> Array | None:
    """Return the solution (T n + P,) of the bordered symmetric system; None where it is not positive definite.

    links: a band over q, in scipy's lower form (width + 1, T n). blocks (T, n + P, n + P): each frame's part over
    q and p, added up over p. corner (P, P): more over p. diagonal, right, free (T n + P,): more on the diagonal,
    the right-hand side, and which unknowns are not fixed.
    """
    frames = len(blocks)
    size = len(corner)
    n = blocks.shape[1] - size
    band = links.copy()
    border = blocks[:, :n, n:].reshape(frames * n, size)
    # Row `below` of the band holds the entries that are so far below the diagonal: those of a frame's block
    # do not reach into the next frame.
    for below in range(n):
        along = np.arange(n - below)
        band[below].reshape(frames, n)[:, along] += blocks[:, along + below, along]
    held = np.where(free, diagonal, FIXED_UNKNOWN_DIAGONAL)
    band[0] += held[: frames * n]
    # Rows and columns of fixed unknowns are emptied, so that nothing but FIXED_UNKNOWN_DIAGONAL is left of them in
    # the border. In the band their entries stay: FIXED_UNKNOWN_DIAGONAL is larger by orders of magnitude.
    right = right * free
    border = border * free[: frames * n, None] * free[frames * n :]
    try:
        # LinAlgError: the matrix is not positive definite, and the caller has to add damping.
        factor = cholesky_banded(band, lower=True, check_finite=False)
        columns = np.column_stack([right[: frames * n], border])
        found = cho_solve_banded((factor, True), columns, check_finite=False)
        if not size:
            return np.asarray(found[:, 0] * free)
        of_p = free[frames * n :]
        whole = (corner + blocks[:, n:, n:].sum(axis=0)) * of_p * of_p[:, None] + np.diag(held[frames * n :])
        # The whole matrix is positive definite if and only if the band and this Schur complement are.
        schur = cho_factor(whole - border.T @ found[:, 1:], lower=True)
        step = cho_solve(schur, right[frames * n :] - border.T @ found[:, 0])
    except LinAlgError:
        return None
    return np.append(found[:, 0] - found[:, 1:] @ step, step) * free
