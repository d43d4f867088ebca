"""Banded symmetric matrices over the unknowns of a chain."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ctr_nlp.chain import Chain

Array = npt.NDArray[np.float64]


class Band:
    """Symmetric matrices over x as LAPACK's lower bands, (width + 1, T n)."""

    def __init__(self, chain: Chain) -> None:
        n, size = chain.unknowns, chain.lower.size
        _, first, second, _ = _pairs(chain.difference)
        reach = np.abs(first - second)
        self.shape = (max(n - 1, int(reach.max(initial=0))) + 1, size)
        self._links = self._map(chain.difference)
        self._constant = self._links @ (2 * chain.weight)
        row, column = np.tril_indices(n)
        self._rows, self._columns = row, column
        self._place = ((row - column) * size + np.arange(0, size, n)[:, None] + column).ravel()
        free = chain.free
        self._both = np.array([np.append(free[k:], np.zeros(k)) * free for k in range(self.shape[0])])
        self._fixed = ~free

    def _map(self, matrix: sp.csr_array) -> sp.csr_array:
        """What turns weights w into the band of matrix.T diag(w) matrix: it is linear in w."""
        row, first, second, product = _pairs(matrix)
        size = self.shape[1]
        below = first >= second
        place = ((first - second) * size + second)[below]
        return sp.csr_array((product[below], (place, row[below])), shape=(self.shape[0] * size, matrix.shape[0]))

    def assemble(self, blocks: Array, diagonal: Array, links: Array) -> Array:
        """Blocks (T, n, n) + diag(diagonal) + links' weights and constant part; the identity where x is fixed."""
        band = self._constant + self._links @ links
        band[self._place] += blocks[:, self._rows, self._columns].ravel()
        band = band.reshape(self.shape)
        band[0] += diagonal
        band *= self._both
        band[0] += self._fixed
        return band


def _pairs(matrix: sp.csr_array) -> tuple[Any, Any, Any, Array]:
    """Row, both columns and product of every pair of entries in the same row."""
    starts, counts = matrix.indptr[:-1], np.diff(matrix.indptr)
    rows, firsts, seconds = [], [], []
    for count in np.unique(counts):
        same = np.flatnonzero(counts == count)
        a, b = (part.ravel() for part in np.meshgrid(np.arange(count), np.arange(count)))
        rows.append(np.repeat(same, len(a)))
        firsts.append((starts[same][:, None] + a).ravel())
        seconds.append((starts[same][:, None] + b).ravel())
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    product = matrix.data[first] * matrix.data[second]
    return np.concatenate(rows), matrix.indices[first], matrix.indices[second], product
