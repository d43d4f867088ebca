"""Runs of consecutive flags that are set."""

from __future__ import annotations

import numpy as np

from ctr_nlp.typing import Flags


def find_flag_runs(flags: Flags) -> list[tuple[int, int]]:
    """Return the first index of each run of set flags (n,), and the index after its last."""
    # False at both ends, so that runs at the borders have two edges as well and edges come in pairs.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(first, stop) for first, stop in edges.reshape(-1, 2).tolist()]
