"""Linear links between the frames of a chain: differences of first or higher order, with bounds and costs."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from ctr_nlp.typing import Array, Index

KEPT = 16
"""Matrices of links that a process remembers."""


@dataclass(frozen=True)
class Link:
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
    """Differences of a given order along q, with known q before the first and after the last frame.

    Returns matrix and offset, and frame and axis of every row; rows in which nothing is unknown are left out.
    """
    known = [*before, *after]
    matrix, outer, frame, axis = _stencil(frames, order, len(before), len(after), n)
    return matrix, (outer @ np.array(known).reshape(len(known), n)).ravel(), frame, axis


@functools.lru_cache(maxsize=KEPT)
def _stencil(frames: int, order: int, before: int, after: int, n: int) -> tuple[sp.csr_array, Any, Index, Index]:
    """The matrix over what is unknown, that over frames that are known, and frame and axis of every row."""
    stencil = sp.identity(before + frames + after, format="csr")
    for _ in range(order):
        stencil = stencil[1:] - stencil[:-1]
    inner = slice(before, before + frames)
    some = np.flatnonzero(abs(stencil[:, inner]).sum(axis=1) > 0)
    stencil = stencil[some]
    outer = sp.hstack([stencil[:, :before], stencil[:, before + frames :]])
    matrix = sp.csr_array(sp.kron(stencil[:, inner], sp.identity(n)))
    frame = np.clip(some + order - before, 0, frames - 1)
    return matrix, outer, np.repeat(frame, n), np.tile(np.arange(n), len(some))
