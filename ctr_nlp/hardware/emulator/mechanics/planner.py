"""The planner of the firmware: straight blocks, and how fast each may be entered so that all others can be left.

A block is a straight line in all six axes; its length is the norm over all of them, degrees counted like
millimetres, as the firmware reports feed. Lengths in mm or deg, times in s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ctr_nlp.hardware.emulator.mechanics.overrides import Overrides

BLOCKS = 100
"""Blocks that the planner holds."""
LEAST_STEP_MM = 1e-9
SLOWEST = 1 / 60
"""A slower line is executed at this many mm/s."""

Vector = tuple[float, ...]


@dataclass(frozen=True)
class AxisLimits:
    """What the settings allow. speed: (6,) mm/s. acceleration: (6,) mm/s^2. deviation: of a junction, mm."""

    speed: Vector
    acceleration: Vector
    deviation: float


@dataclass
class Block:
    """One line in the planner, speeds in mm/s along the path.

    asked: as programmed. fastest: that its axes allow. speed: nominal, as overridden. corner: at which the corner
    before it may be passed, squared. entry: at its start, squared.
    """

    start: Vector
    target: Vector
    direction: Vector
    length: float
    asked: float
    fastest: float
    acceleration: float
    corner: float
    line: int | None
    jog: bool
    speed: float = 0.0
    highest_entry: float = 0.0
    entry: float = 0.0
    remaining: float = 0.0
    """Length not yet prepared."""

    def __post_init__(self) -> None:
        self.remaining = self.length

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


def straight(
    start: Vector,
    target: Vector,
    asked: float,
    limits: AxisLimits,
    before: Block | None,
    overrides: Overrides,
    line: int | None,
    jog: bool,
) -> Block | None:
    """A line between positions (6,), after another, at a speed in mm/s along the path; None if nothing moves."""
    delta = [b - a for a, b in zip(start, target, strict=True)]
    length = math.sqrt(sum(d * d for d in delta))
    if length < LEAST_STEP_MM:
        return None
    direction = tuple(d / length for d in delta)
    used = [i for i, d in enumerate(direction) if d]
    fastest = min(limits.speed[i] / abs(direction[i]) for i in used)
    acceleration = min(limits.acceleration[i] / abs(direction[i]) for i in used)
    corner = 0.0 if before is None else junction(before.direction, direction, limits)
    new = Block(start, target, direction, length, asked, fastest, acceleration, corner, line, jog)
    new.override(overrides, math.inf if before is None else before.speed)
    return new


def junction(before: Vector, after: Vector, limits: AxisLimits) -> float:
    """Squared speed through a corner: that of an arc which leaves the corner by the junction deviation."""
    cosine = -sum(a * b for a, b in zip(before, after, strict=True))
    if cosine > 0.999999:
        return 0.0
    if cosine < -0.999999:
        return math.inf
    change = [b - a for a, b in zip(before, after, strict=True)]
    size = math.sqrt(sum(c * c for c in change))
    limit = min(a * size / abs(c) for a, c in zip(limits.acceleration, change, strict=True) if c)
    sine = math.sqrt(0.5 * (1 - cosine))
    return limit * limits.deviation * sine / (1 - sine)


def look_ahead(blocks: Sequence[Block], speed: float, anew: bool = False) -> None:
    """Set the highest entry speeds from which every later block, and the end, can still be reached.

    speed: with which the first block is being left behind, mm/s. anew: all of them, not only those that the last
    block changes.
    """
    leaving = 0.0
    for later in reversed(blocks[1:]):
        entry = min(later.highest_entry, leaving + 2 * later.acceleration * later.remaining)
        if entry == later.entry and later is not blocks[-1] and not anew:
            break
        later.enter(entry)
        leaving = entry
    arriving = speed**2 + 2 * blocks[0].acceleration * blocks[0].remaining
    for later in blocks[1:]:
        later.enter(min(later.entry, arriving))
        arriving = later.entry + 2 * later.acceleration * later.remaining
