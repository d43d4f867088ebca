"""The course of a loaded robot: its way through frames, and before and after it the load that comes and goes.

A real motion begins and ends without the load. It grows from zero while the robot stands in its first frame and is
taken away in the last one, so that the equilibria under the load are those that a robot comes to.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.models.protocol import MotionSubsteps
from ctr_nlp.typing import Array, Flags, Index

LOAD_RAMP_STEPS = 10
"""Number of steps in which the load comes, and in which it is taken away."""


class LoadSchedule(NamedTuple):
    """M places of a robot's course.

    at (M,): number of the way's place, from 0. part (M,): part of the load that acts. frames (M,): the frame, from
    0, that a place belongs to or is on the way to. own (M,): whether it is the frame itself, under the whole load.
    fresh (M,): where a robot without a load and a history comes to rest.
    """

    at: Index
    load_fraction: Array
    frames: Index
    is_frame: Flags
    fresh: Flags


def schedule_load(motion: MotionSubsteps) -> LoadSchedule:
    """Return the course of a motion: the load comes wherever a robot comes to rest, and goes where a way ends."""
    rising = np.arange(LOAD_RAMP_STEPS) / LOAD_RAMP_STEPS
    found: list[tuple[int, float, bool, bool]] = []
    # A way may have several beginnings, after frames that are not known: each stretch ends before the next.
    ends = np.append(np.flatnonzero(motion.fresh)[1:] - 1, len(motion.q) - 1)
    last_of = np.append(np.diff(motion.frames) != 0, True) if len(motion.q) else np.zeros(0, dtype=bool)
    for at in range(len(motion.q)):
        if motion.fresh[at]:
            # Without a load (part 0) the robot comes to rest; the steps after it raise the load at the same place.
            found += [(at, float(part), False, k == 0) for k, part in enumerate(rising)]
        found.append((at, 1.0, bool(last_of[at]), False))
        if at in ends:
            found += [(at, float(part), False, False) for part in rising[::-1]]
    places = np.array([place for place, *_ in found], dtype=int)
    part, own, fresh = (np.array([each[k] for each in found]) for k in (1, 2, 3))
    return LoadSchedule(places, part.astype(float), motion.frames[places], own.astype(bool), fresh.astype(bool))
