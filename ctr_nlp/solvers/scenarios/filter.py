"""Which trial points are taken: those that no earlier point beats in both objective and feasibility.

A penalty that adds the two up holds steps back as long as equations are curved; a filter does not. After Waechter
and Biegler, Math. Program. 106 (2006), section 2.3, with their constants.
"""

from __future__ import annotations

import math
from typing import NamedTuple

LITTLE = 1e-5
"""Part by which feasibility, or by as much of it the objective, must improve."""
ARMIJO = 1e-8
STEEP, SLANTED = 2.3, 1.1
"""Exponents of slope and infeasibility, by which one tells that the objective is what counts."""
FURTHEST, NEAREST = 1e4, 1e-4
"""Infeasibility that is never exceeded, and below which the objective may count, as parts of the first one."""
ROUNDING = 1e-11


class Merit(NamedTuple):
    """Of a point. missing: the sum of what equations and rows miss; objective: with the barrier."""

    missing: float
    objective: float


class Filter:
    """The points that trials must beat; one object a solve."""

    def __init__(self, first: float) -> None:
        """first: what the start misses."""
        self._unit, self._kept = max(1.0, first), list[Merit]()

    def clear(self) -> None:
        """Forget all points: another barrier makes another objective."""
        self._kept.clear()

    def keep(self, here: Merit) -> None:
        """Trials must beat this point from now on."""
        self._kept.append(Merit((1 - LITTLE) * here.missing, here.objective - LITTLE * here.missing))

    def counts(self, here: Merit, slope: float, part: float) -> bool:
        """Whether a part of a step, along which the objective falls by slope, must lower the objective."""
        steep = slope < 0 and part * (-slope) ** STEEP > here.missing**SLANTED
        return steep and here.missing <= NEAREST * self._unit

    def takes(self, here: Merit, trial: Merit, slope: float, part: float) -> bool:
        """Whether a trial, a part of a step from here, is a step forward."""
        if not all(map(math.isfinite, trial)) or trial.missing > FURTHEST * self._unit:
            return False
        if any(trial.missing >= kept.missing and trial.objective >= kept.objective for kept in self._kept):
            return False
        room = ROUNDING * (1 + abs(here.objective))
        if self.counts(here, slope, part):
            return trial.objective <= here.objective + ARMIJO * part * slope + room
        nearer = trial.missing <= (1 - LITTLE) * here.missing
        return nearer or trial.objective <= here.objective - LITTLE * here.missing + room
