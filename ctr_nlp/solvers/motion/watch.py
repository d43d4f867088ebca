"""Following a solver at work: its progress, its best feasible point so far, and whether it is to stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ctr_nlp.solvers.frame.adapter import FEASIBLE
from ctr_nlp.typing import Array


class Iterate(NamedTuple):
    """One iteration. objective: mm^2; violation: units of x; error: KKT residual; x (n,)."""

    number: int
    objective: float
    violation: float
    error: float
    x: Array


class Watch:
    """Called with every iterate; answers whether to stop.

    best: the feasible iterate of least objective, first among them, or None. The last bits of a bound may be
    exceeded by up to FEASIBLE.
    """

    def __init__(
        self,
        report: Callable[[Iterate], None] | None = None,
        stop: Callable[[], bool] = lambda: False,
        first: Iterate | None = None,
    ) -> None:
        self._report = report
        self._stop = stop
        self.best: Iterate | None = None
        if first is not None:
            self._keep(first)

    @property
    def each(self) -> bool:
        """Whether every iterate is wanted, and not just the best of some."""
        return self._report is not None

    def _keep(self, iterate: Iterate) -> None:
        least = np.inf if self.best is None else self.best.objective
        if iterate.violation <= FEASIBLE and iterate.objective < least:
            self.best = iterate

    def __call__(self, iterate: Iterate) -> bool:
        """Take note of an iterate; True ends the work."""
        self._keep(iterate)
        if self._report is not None:
            self._report(iterate)
        return self._stop()
