"""The links of a shared motion as a band over q: their costs (eq. (9), mm^2) and their bounds' barrier terms.

With links A q + b, weights w and sigma from the barrier, they add A' diag(2 w + sigma) A to the Newton matrix. Its
pattern is that of A'A, which is precomputed: one product of entries of A for each pair in a row.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.ocp.scenarios import SharedMotion
from ctr_nlp.typing import Array


class LinkBand:
    """Gradients of the links, and their part of Newton systems as a band (width + 1, T n) of a symmetric
    matrix.
    """

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare."""
        frames, _, n, _ = motion.sizes
        self._matrix = motion.linking
        self._shape = (frames, n)
        self.weight = motion.of_links("weight")
        entries = self._matrix.tocoo()
        starts = self._matrix.indptr
        columns = self._matrix.indices
        data = self._matrix.data
        # Pairs of entries in one row of A, once each: only the lower half of the symmetric product is
        # stored.
        pairs = [
            (row, a, b)
            for row, (first, stop) in enumerate(zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True))
            for a in range(first, stop)
            for b in range(first, stop)
            if columns[a] >= columns[b]
        ]
        self._row, first, second = np.array(pairs, dtype=int).reshape(-1, 3).T
        below = columns[first] - columns[second]
        # Wide enough, too, for blocks of a frame and for rows over two neighbouring frames (twists.py).
        self._width = max(2 * n - 1, int(below.max(initial=0)))
        self._place = below * entries.shape[1] + columns[second]
        self._product = data[first] * data[second]

    def multiply_transposed_jacobian(self, rows: Array) -> Array:
        """Return the transposed matrix times a vector `rows` (l,) over the links, as (T, n)."""
        return np.asarray(self._matrix.T @ rows).reshape(self._shape)

    def multiply_jacobian(self, dq: Array) -> Array:
        """Return the matrix times a step dq (T n,), (l,)."""
        return np.asarray(self._matrix @ dq)

    def slope(self, rows: Array) -> Array:
        """Return the gradient (T, n) of the links' costs, with rows (l,) the links' values."""
        return self.multiply_transposed_jacobian(2 * self.weight * rows)

    def band(self, sigma: Array) -> Array:
        """Return the links' part of the Newton matrix as a band: A' diag(2 w + sigma) A, with sigma (l,)."""
        weights = self._product * (2 * self.weight + sigma)[self._row]
        size = self._matrix.shape[1]
        # bincount adds up pairs of different rows that meet at one place of the band.
        found: Array = np.bincount(self._place, weights, (self._width + 1) * size).astype(float)
        return found.reshape(self._width + 1, size)
