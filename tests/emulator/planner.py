"""What the firmware plans: straight blocks, overrides of their speeds, and segments of 10 ms at constant speed.

A block is a straight line in all six axes; its length is the norm over all of them, degrees counted like
millimetres, as the firmware reports feed. Lengths in mm or deg, times in s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

FEED_RESET, SPINDLE_RESET = 0x90, 0x99
FEED_STEPS = {0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}
RAPIDS = {0x95: 100, 0x96: 50, 0x97: 25}
SPINDLE_STEPS = {0x9A: 10, 0x9B: -10, 0x9C: 1, 0x9D: -1}
LOWEST, HIGHEST = 10, 200

BLOCKS = 100
"""Blocks that the planner holds."""
LEAST_STEP_MM = 1e-9
SLOWEST = 1 / 60
"""A slower line is executed at this many mm/s."""

Vector = tuple[float, ...]

SEGMENT_S = 0.01


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


@dataclass(frozen=True)
class AxisLimits:
    """What the settings allow. speed: (6,) mm/s. acceleration: (6,) mm/s^2. deviation: of a junction, mm."""

    speed: Vector
    acceleration: Vector
    deviation: float


class Block:
    """A line in the planner from start to target (6,), after the one before; speeds in mm/s along the path.

    asked: as programmed. fastest: that its axes allow. speed: nominal, as overridden. corner: at which the corner
    before it may be passed, squared. entry: at its start, squared. remaining: length not yet prepared.
    """

    def __init__(
        self,
        start: Vector,
        target: Vector,
        asked: float,
        limits: AxisLimits,
        before: Block | None,
        line: int | None,
        jog: bool,
    ) -> None:
        self.start, self.target, self.asked, self.line, self.jog = start, target, asked, line, jog
        self.length = self.remaining = math.dist(start, target)
        self.direction = tuple((b - a) / self.length for a, b in zip(start, target, strict=True))
        used = [(i, abs(d)) for i, d in enumerate(self.direction) if d]
        self.fastest = min(limits.speed[i] / share for i, share in used)
        self.acceleration = min(limits.acceleration[i] / share for i, share in used)
        self.corner = 0.0 if before is None else junction(before.direction, self.direction, limits)
        self.speed = self.highest_entry = self.entry = 0.0

    def override(self, overrides: Overrides, before: float) -> None:
        """Scale its speed; before: the nominal speed of the block before it."""
        asked = self.asked if self.jog else overrides.speed(self.asked, self.fastest)
        self.speed = max(min(asked, self.fastest), SLOWEST)
        self.highest_entry = min(self.corner, self.speed**2, before**2)

    def enter(self, speed_squared: float) -> None:
        """Begin it at a speed, squared."""
        self.entry = speed_squared

    def cover(self, covered: float) -> None:
        """So much of its length has been prepared."""
        self.remaining = self.length - covered

    def begin_at(self, position: Vector) -> None:
        """What remains of it begins at a position (6,)."""
        self.start, self.length = position, self.remaining

    def at(self, covered: float) -> Vector:
        """Position (6,) where a length has been covered."""
        if covered >= self.length:
            return self.target
        return tuple(p + covered * d for p, d in zip(self.start, self.direction, strict=True))


def junction(before: Vector, after: Vector, limits: AxisLimits) -> float:
    """Squared speed through a corner: that of an arc which leaves the corner by the junction deviation."""
    cosine = -sum(a * b for a, b in zip(before, after, strict=True))
    if cosine > 0.999999:
        return 0.0
    if cosine < -0.999999:
        return math.inf
    change = [b - a for a, b in zip(before, after, strict=True)]
    limit = min(a * math.hypot(*change) / abs(c) for a, c in zip(limits.acceleration, change, strict=True) if c)
    sine = math.sqrt(0.5 * (1 - cosine))
    return limit * limits.deviation * sine / (1 - sine)


@dataclass(frozen=True)
class Segment:
    """A piece of a block between two covered lengths, executed at constant speed."""

    block: Block
    begin: float
    end: float
    seconds: float
    last: bool


def ramp(speed: float, rest: float, block: Block, leaving: float) -> tuple[float, float, float]:
    """(length, speed at the end, time taken) of the next segment: a trapezoid's next 10 ms, not beyond rest.

    speed: now. rest: length left, at whose end the speed is to be leaving. Lengths in mm, speeds in mm/s.
    """
    acceleration, nominal = block.acceleration, block.speed
    covered, left = 0.0, SEGMENT_S
    while left > 0 and rest - covered > LEAST_STEP_MM:
        ahead = rest - covered
        braking = (speed * speed - leaving * leaving) / (2 * acceleration)
        if braking >= ahead - LEAST_STEP_MM:
            end = math.sqrt(max(speed * speed - 2 * acceleration * ahead, leaving * leaving))
            length, speed, time = _brake_to_speed(speed, end, ahead, acceleration, left)
            return covered + length, speed, SEGMENT_S - left + time
        if speed > nominal:
            time = min((speed - nominal) / acceleration, left)
            covered += time * (speed - acceleration * time / 2)
            left -= time
            speed = nominal if left > 0 else speed - acceleration * time
            continue
        if speed < nominal:
            peak = min(nominal, math.sqrt(acceleration * ahead + (speed * speed + leaving * leaving) / 2))
            if peak > speed:
                whole = (peak - speed) / acceleration
                time = min(whole, left)
                covered += time * (speed + acceleration * time / 2)
                speed = peak if time == whole else speed + acceleration * time
                left -= time
                if peak < nominal and left > 0:
                    # At the top of a triangle only rounding is between rising and falling.
                    length, speed, time = _brake_to_speed(speed, leaving, rest - covered, acceleration, left)
                    return covered + length, speed, SEGMENT_S - left + time
                continue
        time = min((ahead - max(braking, 0.0)) / speed, left)
        covered += time * speed
        left -= time
        if time == 0:
            break
    return covered, speed, SEGMENT_S - left


def _brake_to_speed(
    speed: float, end: float, ahead: float, acceleration: float, left: float
) -> tuple[float, float, float]:
    """(length, speed, time taken) of slowing down to a speed over a length ahead, for the time left at most."""
    whole = 2 * ahead / (speed + end) if speed + end > 0 else 0.0
    if whole <= left:
        return ahead, end, whole
    return left * (speed - acceleration * left / 2), speed - acceleration * left, left
