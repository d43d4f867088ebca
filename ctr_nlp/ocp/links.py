"""Linear links between the frames of a chain: differences of first or higher order, with bounds and costs.

With q_j the configuration in frame j (rad, mm), a first difference q_{j+1} - q_j is bounded by v dt (speed) and
costs lambda |W (q_{j+1} - q_j)|^2 / dt^2, eq. (9); a second difference q_{j+1} - 2 q_j + q_{j-1} is bounded by a
dt^2 (acceleration). Known configurations before the first and after the last frame become constant offsets.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from ctr_nlp.typing import Array, Index

LINK_MATRIX_CACHE_SIZE = 16
"""Matrices of links that a process remembers."""


@dataclass(frozen=True)
class FrameLink:
    """Rows over neighbouring frames: lower <= value <= upper, where value = matrix @ q + offset.

    The objective gains sum weight value^2. matrix (m, T k), over the k entries of q frame by frame; offset, lower,
    upper, weight (m,). frame, axis (m,): the frame (from 0) whose value a row is, and the entry of its q.
    """

    name: str
    matrix: sp.csr_array
    offset: Array
    lower: Array
    upper: Array
    weight: Array
    frame: Index
    axis: Index


def differences(
    frames: int, order: int, before: Sequence[Array], after: Sequence[Array], n: int
) -> tuple[sp.csr_array, Array, Index, Index]:
    """Return the differences of a given order along q (frames, n), as a matrix and an offset.

    before, after: known configurations (n,) before the first and after the last frame, in order. Returns matrix
    and offset, and frame and axis of every row; rows in which nothing is unknown are left out.
    """
    known = [*before, *after]
    matrix, outer, frame, axis = _stencil(frames, order, len(before), len(after), n)
    return matrix, (outer @ np.array(known).reshape(len(known), n)).ravel(), frame, axis


@functools.lru_cache(maxsize=LINK_MATRIX_CACHE_SIZE)
def _stencil(frames: int, order: int, before: int, after: int, n: int) -> tuple[sp.csr_array, Any, Index, Index]:
    """Return the difference matrices over the unknown and the known frames, and frame and axis of every row."""
    # Order k is k times a first difference, of known and unknown frames alike.
    stencil = sp.identity(before + frames + after, format="csr")
    for _ in range(order):
        stencil = stencil[1:] - stencil[:-1]
    inner = slice(before, before + frames)
    # Rows among known frames alone would be constants: no unknown could satisfy their bounds.
    some = np.flatnonzero(abs(stencil[:, inner]).sum(axis=1) > 0)
    stencil = stencil[some]
    outer = sp.hstack([stencil[:, :before], stencil[:, before + frames :]])
    # The same stencil for each of the n entries of q, which follow each other within a frame.
    matrix = sp.csr_array(sp.kron(stencil[:, inner], sp.identity(n)))
    # A difference of order k spans k + 1 frames and belongs to its last one; to the last unknown frame
    # where it ends among the known ones.
    frame = np.clip(some + order - before, 0, frames - 1)
    return matrix, outer, np.repeat(frame, n), np.tile(np.arange(n), len(some))
