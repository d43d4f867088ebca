"""Runs of flags that are set, one after the other."""

from __future__ import annotations

import numpy as np

from ctr_nlp.typing import Flags


def find_flag_runs(flags: Flags) -> list[tuple[int, int]]:
    """The first index of each run of flags that are set, and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(first, stop) for first, stop in edges.reshape(-1, 2).tolist()]
