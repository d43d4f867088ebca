"""Overrides: how much faster or slower than programmed the firmware moves, as a pendant or a client asks."""

from __future__ import annotations

from dataclasses import dataclass

FEED_RESET, SPINDLE_RESET = 0x90, 0x99
FEED_STEPS = {0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}
RAPIDS = {0x95: 100, 0x96: 50, 0x97: 25}
SPINDLE_STEPS = {0x9A: 10, 0x9B: -10, 0x9C: 1, 0x9D: -1}
LOWEST, HIGHEST = 10, 200


@dataclass(frozen=True)
class Overrides:
    """Percentages of what is programmed: of feeds (G1, timed lines among them), of rapids (G0), of the spindle."""

    feed: int = 100
    rapid: int = 100
    spindle: int = 100

    def after(self, byte: int) -> Overrides:
        """What a realtime character makes of them; the same where it is none of theirs."""
        if byte in RAPIDS:
            return Overrides(self.feed, RAPIDS[byte], self.spindle)
        feed = 100 if byte == FEED_RESET else self.feed + FEED_STEPS.get(byte, 0)
        spindle = 100 if byte == SPINDLE_RESET else self.spindle + SPINDLE_STEPS.get(byte, 0)
        return Overrides(_within(feed), self.rapid, _within(spindle))

    def speed(self, asked: float, fastest: float) -> float:
        """Speed of a block that asks for one and may go at another at most, mm/s; infinity asks for a rapid."""
        if asked == float("inf"):
            return fastest * self.rapid / 100
        return min(min(asked, fastest) * self.feed / 100, fastest)


def _within(percent: int) -> int:
    return min(max(percent, LOWEST), HIGHEST)
