"""How far a solver is, told from how its KKT residual falls."""

from __future__ import annotations

import math

from ctr_nlp.solvers import Iterate
from ctr_nlp.solvers.motion.banded import MOST_ITERATIONS, TOLERANCE
from ctr_nlp.steer.passes import Progress

WINDOW = 12
"""Iterations over which the fall of the KKT residual is looked at."""


class Forecast:
    """Tells progress how far a solver is: iterations done, and how many its KKT residual's fall lets expect."""

    def __init__(self, progress: Progress, frames: int, number: int, count: int) -> None:
        self._progress = progress
        self._frames = frames
        self._which = f"start {number} of {count}, " if count > 1 else ""
        self._best: list[float] = []

    def __call__(self, iterate: Iterate) -> None:
        """Tell of one more iterate."""
        error = math.log(max(iterate.error, TOLERANCE))
        self._best.append(min([error, *self._best[-1:]]))
        recent = self._best[-WINDOW:]
        fall = (recent[0] - recent[-1]) / max(len(recent) - 1, 1)
        left = (recent[-1] - math.log(TOLERANCE)) / fall if fall > 0 else WINDOW
        total = iterate.number + max(1, min(math.ceil(left), MOST_ITERATIONS - iterate.number))
        objective, violation = iterate.objective / self._frames, max(iterate.violation, 0.0)
        note = f"{self._which}objective {objective:.4g} mm², violation {violation:.0e}"
        self._progress(iterate.number, total, note)
