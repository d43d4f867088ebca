"""The schedule of a loaded robot: a load that grows, a motion through frames, and a load that is removed.

A real motion begins and ends without the load. It grows from zero while the robot stands in its first frame and is
removed in the last one, so that the equilibria under the load are those that a robot reaches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.models.protocol import MotionSubsteps
from ctr_nlp.typing import Array, Flags, Index

LOAD_RAMP_STEPS = 10
"""Number of steps in which the load is applied, and in which it is removed."""


class LoadSchedule(NamedTuple):
    """M places of a loaded robot's motion.

    at (M,): number of the motion's sub-step, from 0. load_fraction (M,): fraction of the load that acts. frames
    (M,): the frame, from 0, that a place belongs to or leads to. is_frame (M,): whether it is the frame itself,
    under the whole load. fresh (M,): where a robot without a load and a history settles.
    """

    at: Index
    load_fraction: Array
    frames: Index
    is_frame: Flags
    fresh: Flags


def schedule_load(motion: MotionSubsteps) -> LoadSchedule:
    """Return the schedule of a motion: the load grows where a robot settles, and is removed where a stretch
    ends.
    """
    rising = np.arange(LOAD_RAMP_STEPS) / LOAD_RAMP_STEPS
    found: list[tuple[int, float, bool, bool]] = []
    # A motion may have several fresh starts, after frames that are not known: each stretch ends before the next.
    ends = np.append(np.flatnonzero(motion.fresh)[1:] - 1, len(motion.q) - 1)
    last_of = np.append(np.diff(motion.frames) != 0, True) if len(motion.q) else np.zeros(0, dtype=bool)
    for at in range(len(motion.q)):
        if motion.fresh[at]:
            # Without a load (fraction 0) the robot settles; the steps after it raise the load at the same place.
            found += [(at, float(part), False, k == 0) for k, part in enumerate(rising)]
        found.append((at, 1.0, bool(last_of[at]), False))
        if at in ends:
            found += [(at, float(part), False, False) for part in rising[::-1]]
    places = np.array([place for place, *_ in found], dtype=int)
    part, own, fresh = (np.array([each[k] for each in found]) for k in (1, 2, 3))
    return LoadSchedule(places, part.astype(float), motion.frames[places], own.astype(bool), fresh.astype(bool))
