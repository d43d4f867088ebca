"""Acceptance of trial points by a filter: a trial must beat every earlier point in objective or in feasibility.

A penalty that adds the two up shortens steps as long as equations are curved; a filter does not. After Waechter
and Biegler, Math. Program. 106 (2006), section 2.3, with their constants: theta is `infeasibility` (sum of the
residuals of equations and rows, rad and mm), phi the `objective` with the barrier (mm^2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

FILTER_IMPROVEMENT_FRACTION = 1e-5
"""gamma_theta, gamma_phi: part of theta by which theta, or phi in mm^2, must improve."""
FILTER_ARMIJO_FRACTION = 1e-8
"""eta_phi: part of the predicted decrease of the objective that a step must reach."""
FILTER_SLOPE_EXPONENT, FILTER_INFEASIBILITY_EXPONENT = 2.3, 1.1
"""Exponents s_phi and s_theta in the switching condition, which decides whether the objective has to decrease."""
FILTER_MAX_INFEASIBILITY_RATIO, FILTER_SWITCHING_INFEASIBILITY_RATIO = 1e4, 1e-4
"""theta_max and theta_min as parts of the first theta: never exceeded, and below which the objective may count."""
FILTER_OBJECTIVE_ROUNDING = 1e-11
"""Part of the objective that is rounding: near a solution it may rise by as much."""


class Merit(NamedTuple):
    """Merit of a point.

    infeasibility: sum of the residuals of equations and rows; objective: with the barrier, mm^2.
    """

    infeasibility: float
    objective: float


class Filter:
    """The points that trials must beat; one object a solve."""

    def __init__(self, first: float) -> None:
        """Start an empty filter; first: infeasibility of the start, the unit of infeasibilities."""
        self._unit = max(1.0, first)
        self._kept = list[Merit]()

    def clear(self) -> None:
        """Forget all points, as their objectives are those of another barrier."""
        self._kept.clear()

    def add_point(self, here: Merit) -> None:
        """Add the point `here`, with a margin; trials must beat it from now on."""
        self._kept.append(
            Merit(
                (1 - FILTER_IMPROVEMENT_FRACTION) * here.infeasibility,
                here.objective - FILTER_IMPROVEMENT_FRACTION * here.infeasibility,
            )
        )

    def requires_decrease(self, here: Merit, slope: float, part: float) -> bool:
        """Return whether a trial must lower the objective.

        here: merit of the point. slope: rate at which the objective changes along the step. part: of the step.
        """
        # Switching condition: the predicted decrease outweighs the infeasibility, and this is small
        # already.
        steep = (
            slope < 0
            and part * (-slope) ** FILTER_SLOPE_EXPONENT > here.infeasibility**FILTER_INFEASIBILITY_EXPONENT
        )
        return steep and here.infeasibility <= FILTER_SWITCHING_INFEASIBILITY_RATIO * self._unit

    def accepts(self, here: Merit, trial: Merit, slope: float, part: float) -> bool:
        """Return whether a trial is accepted.

        here, trial: merits of the point and of the trial, a part of a step from it. slope: rate at which the
        objective changes along the step.
        """
        if not all(map(math.isfinite, trial)) or trial.infeasibility > FILTER_MAX_INFEASIBILITY_RATIO * self._unit:
            return False
        if any(
            trial.infeasibility >= kept.infeasibility and trial.objective >= kept.objective for kept in self._kept
        ):
            return False
        # Where the objective counts it must decrease enough (Armijo); elsewhere one of the two measures
        # must improve.
        room = FILTER_OBJECTIVE_ROUNDING * (1 + abs(here.objective))
        if self.requires_decrease(here, slope, part):
            return trial.objective <= here.objective + FILTER_ARMIJO_FRACTION * part * slope + room
        nearer = trial.infeasibility <= (1 - FILTER_IMPROVEMENT_FRACTION) * here.infeasibility
        return (
            nearer or trial.objective <= here.objective - FILTER_IMPROVEMENT_FRACTION * here.infeasibility + room
        )
