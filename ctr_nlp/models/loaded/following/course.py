"""The course of a loaded robot: its way through frames, and before and after it the load that comes and goes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.models.protocol import Passage
from ctr_nlp.typing import Array, Flags, Index

RISES = 10
"""Steps in which the load comes, and in which it is taken away."""


class Course(NamedTuple):
    """Places of a robot: at (M,), which of its way's that is, from 0, and which part of the load acts, (M,).

    frames (M,): to which frame a place belongs, or on the way to which it is, from 0. own (M,): whether it is the
    frame itself, under the whole load. fresh (M,): where a robot without a load and a history comes to rest.
    """

    at: Index
    part: Array
    frames: Index
    own: Flags
    fresh: Flags


def course(way: Passage) -> Course:
    """The course of a way: wherever a robot comes to rest the load comes, and where it ends the load goes."""
    rising = np.arange(RISES) / RISES
    found: list[tuple[int, float, bool, bool]] = []
    ends = np.append(np.flatnonzero(way.fresh)[1:] - 1, len(way.q) - 1)
    last_of = np.append(np.diff(way.frames) != 0, True) if len(way.q) else np.zeros(0, dtype=bool)
    for at in range(len(way.q)):
        if way.fresh[at]:
            found += [(at, float(part), False, k == 0) for k, part in enumerate(rising)]
        found.append((at, 1.0, bool(last_of[at]), False))
        if at in ends:
            found += [(at, float(part), False, False) for part in rising[::-1]]
    places = np.array([place for place, *_ in found], dtype=int)
    part, own, fresh = (np.array([each[k] for each in found]) for k in (1, 2, 3))
    return Course(places, part.astype(float), way.frames[places], own.astype(bool), fresh.astype(bool))
