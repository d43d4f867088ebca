"""The links of a shared motion, as a band over q."""

from __future__ import annotations

import numpy as np

from ctr_nlp.nlp.scenarios import SharedMotion
from ctr_nlp.typing import Array


class LinkBand:
    """What links add to gradients and, as bands (width + 1, T n) of a symmetric matrix, to Newton systems."""

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare."""
        frames, _, n, _ = motion.sizes
        self._matrix, self._shape, self.weight = motion.linking, (frames, n), motion.of_links("weight")
        entries = self._matrix.tocoo()
        starts, columns, data = self._matrix.indptr, self._matrix.indices, self._matrix.data
        pairs = [
            (row, a, b)
            for row, (first, stop) in enumerate(zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True))
            for a in range(first, stop)
            for b in range(first, stop)
            if columns[a] >= columns[b]
        ]
        self._row, first, second = np.array(pairs, dtype=int).reshape(-1, 3).T
        below = columns[first] - columns[second]
        self._width = max(2 * n - 1, int(below.max(initial=0)))
        self._place = below * entries.shape[1] + columns[second]
        self._product = data[first] * data[second]

    def pulled(self, rows: Array) -> Array:
        """The transposed matrix times rows (l,), as (T, n)."""
        return np.asarray(self._matrix.T @ rows).reshape(self._shape)

    def moved(self, dq: Array) -> Array:
        """The matrix times dq (T n,), (l,)."""
        return np.asarray(self._matrix @ dq)

    def slope(self, rows: Array) -> Array:
        """The gradient (T, n) of the links' costs, where their values are rows (l,)."""
        return self.pulled(2 * self.weight * rows)

    def band(self, sigma: Array) -> Array:
        """The second derivatives of the links' costs and what sigma (l,) adds to them."""
        weights = self._product * (2 * self.weight + sigma)[self._row]
        size = self._matrix.shape[1]
        found: Array = np.bincount(self._place, weights, (self._width + 1) * size).astype(float)
        return found.reshape(self._width + 1, size)
