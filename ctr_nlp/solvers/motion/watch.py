"""Observation of a running solver: its progress, its best feasible point so far, and whether it is to stop.

An interior-point method's last iterate need not be its best feasible one; a caller that stops early takes `best`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ctr_nlp.solvers.frame.adapter import FEASIBILITY_TOLERANCE
from ctr_nlp.typing import Array


class Iterate(NamedTuple):
    """One iteration of a solver. objective: mm^2; violation: rad or mm; error: KKT residual; x (n,)."""

    number: int
    objective: float
    violation: float
    error: float
    x: Array


class Watch:
    """Callback for every iterate; its answer says whether to stop.

    report: called with each. stop: asked whether to end. first: an iterate that is known before. most: number of
    iterations after which to stop, None for any. best: the feasible iterate of least objective, the first among
    equals, or None. Bounds may be exceeded by up to FEASIBILITY_TOLERANCE, which covers rounding.
    """

    def __init__(
        self,
        report: Callable[[Iterate], None] | None = None,
        stop: Callable[[], bool] = lambda: False,
        first: Iterate | None = None,
        most: int | None = None,
    ) -> None:
        self._report = report
        self._stop = stop
        self._most = most
        self.best: Iterate | None = None
        if first is not None:
            self._keep(first)

    @property
    def reports_every_iterate(self) -> bool:
        """Whether every iterate is reported, and not only the best of several."""
        return self._report is not None

    def _keep(self, iterate: Iterate) -> None:
        """Remember the iterate if it is feasible and better than the best."""
        least = np.inf if self.best is None else self.best.objective
        # NaN compares false: an iterate that could not be evaluated is never the best.
        if iterate.violation <= FEASIBILITY_TOLERANCE and iterate.objective < least:
            self.best = iterate

    def __call__(self, iterate: Iterate) -> bool:
        """Record and report an iterate; True ends the work."""
        self._keep(iterate)
        if self._report is not None:
            self._report(iterate)
        return self._stop() or (self._most is not None and iterate.number >= self._most)
