"""Fault detection for sensors, from the readings of the last half second.

Innovations of a correct filter are white with their expected covariance. Tested are: silence, stuck values, most
groups rejected by the gate, a delay (a regression of innovations on the predicted rates), and a mean square size
that is too large: the mean of n squared standard normal values has the deviation sqrt(2 / n).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from ctr_nlp.identify.closed_loop.observer import Innovation
from ctr_nlp.identify.closed_loop.sensors import Reading
from ctr_nlp.typing import Array

MAX_SENSOR_SILENCE_S = 0.25
"""Time without a reading, s, after which sensors count as silent; the operator knows after twice that at most."""
SENSOR_WINDOW_S = 0.45
"""Length of the window of readings, s."""
STUCK_READING_COUNT = 3
"""Number of equal readings at which values count as stuck: with noise they never repeat to the last digit."""
REPORTED_REJECTED_SHARE, MAX_REJECTED_SHARE = 0.1, 0.5
"""Share of rejected groups of values that is reported, and share at which a reading counts as wrong."""
MIN_REJECTED_GROUPS = 2
"""Least number of rejected groups that is reported, unless one is far off: chance rejects one in a thousand."""
CERTAIN_DEVIATIONS = 6.0
"""Standard deviations beyond which chance is excluded."""
REPORTED_SENSOR_DELAY_S = 0.05
"""Least delay that is reported, s."""


class SensorMonitor:
    """Checks every reading before it is used, and the time without readings."""

    def __init__(self) -> None:
        self._last: tuple[float, Reading] | None = None
        self._equal = 0
        self._wrong = 0
        self._seen = deque[tuple[Innovation, Array, float]]()

    def silence_reason(self, time: float, start: float) -> str:
        """Return why sensors count as silent at a time, s, or ""; start: time at which the loop began, s."""
        since = time - (start if self._last is None else self._last[0])
        return f"no measurement for {since:.2g} s" if since > MAX_SENSOR_SILENCE_S + 1e-9 else ""

    def check_reading(
        self, time: float, reading: Reading, innovation: Innovation, rates: Array
    ) -> tuple[str, str]:
        """Return why a reading is rejected, and a further message; each "" for none.

        time: of its arrival, s. reading: the values. innovation: of these. rates: (m,), predicted rates of the
        values, per s.
        """
        same = self._last is not None and np.array_equal(reading.values, self._last[1].values, equal_nan=True)
        self._equal = self._equal + 1 if same else 1
        self._last = (time, reading)
        self._seen.append((innovation, rates, time))
        while self._seen[0][2] < time - SENSOR_WINDOW_S:
            self._seen.popleft()
        self._wrong = self._wrong + 1 if innovation.rejected > MAX_REJECTED_SHARE * innovation.groups else 0
        return self._why(), self._outliers()

    def _why(self) -> str:
        if self._equal >= STUCK_READING_COUNT:
            return f"the same values have been measured {self._equal} times"
        if self._wrong >= 2:
            return "measurements contradict what is known of the robot: another registration, axes, or a snap"
        late, deviation = self._late()
        if abs(late) > max(REPORTED_SENSOR_DELAY_S, CERTAIN_DEVIATIONS * deviation):
            return f"measurements seem to be late by {late:.2g} s"
        size, count = self._size()
        if count and size > 1 + CERTAIN_DEVIATIONS * np.sqrt(2 / count):
            return f"measurements are {np.sqrt(size):.2g} times as far from what is expected as their noise"
        return ""

    def _outliers(self) -> str:
        groups = sum(each.groups for each, *_ in self._seen)
        rejected = sum(each.rejected for each, *_ in self._seen)
        farthest = max(
            float(np.nanmax(abs(e.excess / e.expected_deviations), initial=0.0)) for e, *_ in self._seen
        )
        if rejected > REPORTED_REJECTED_SHARE * groups and (
            rejected >= MIN_REJECTED_GROUPS or farthest > CERTAIN_DEVIATIONS
        ):
            return f"{rejected / groups:.0%} of what is measured is far from what is expected, and is not used"
        return ""

    def _late(self) -> tuple[float, float]:
        """Return the estimated delay of readings, s, and its standard deviation."""
        # Late by t, values are off by -t times their rate r: least squares of e = -t r over accepted values, both
        # in expected deviations, t = -r.e / r.r with the deviation 1 / |r|.
        along = across = 0.0
        for each, rates, _ in self._seen:
            at = each.accepted
            scaled = rates[at] / each.expected_deviations[at]
            along = along - float(scaled @ (each.excess[at] / each.expected_deviations[at]))
            across = across + float(scaled @ scaled)
        return (along / across, across**-0.5) if across > 0 else (0.0, np.inf)

    def _size(self) -> tuple[float, int]:
        """Return the mean square of accepted innovations in expected deviations, and the number of values."""
        found = [(each.size, int(each.accepted.sum())) for each, *_ in self._seen if each.accepted.any()]
        count = sum(n for _, n in found)
        return (sum(size * n for size, n in found) / count if count else 0.0), count

    @property
    def sound(self) -> bool:
        """Whether all readings of the window pass the checks."""
        return not self._why() and not self._outliers()
