"""Where a plan's robot leaves its lumen, and by how much."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.plan.record import Record
from ctr_nlp.support.runs import runs
from ctr_nlp.target.lumen import Lumen, outermost
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array


class Contact(NamedTuple):
    """Frames first to last, from 1, all of them, in which the robot touches the wall, and where it is worst.

    depth: by how much it is there beyond the wall, mm, in which frame; of which tube, from 1; arc_length: mm along
    the robot; path: mm along the lumen's path; both from the insertion point.
    """

    first: int
    last: int
    depth: float
    frame: int
    tube: int
    arc_length: float
    path: float


def depth(plan: Record) -> Array:
    """By how much the robot is beyond the wall at most, (T,) mm; 0 where nothing touches, NaN where unknown."""
    if plan.clearance is None:
        return np.full(len(plan.time), np.nan)
    return np.maximum(0.0, -plan.clearance.min(axis=1))


def contacts(plan: Record) -> list[Contact]:
    """All of a plan's, in order of time; none where no wall is known."""
    if plan.clearance is None or plan.lumen is None:
        return []
    deep, lumen, found = depth(plan), Lumen(plan.lumen), []
    for first, stop in runs(deep > 0):
        frame = first + int(deep[first:stop].argmax())
        sample = int(plan.clearance[frame].argmin())
        tube = outermost(plan.beta[frame][None], SIGMA)[0, sample]
        start, place = lumen.near(np.stack([np.zeros(3), plan.shape[frame, sample]])).behind
        s = SIGMA[sample] * plan.beta[frame, -1]
        numbers = float(deep[frame]), frame + 1, int(tube) + 1, float(s), float(place - start)
        found.append(Contact(first + 1, stop, *numbers))
    return found
