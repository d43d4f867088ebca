"""The planner of the firmware: straight blocks, and how fast each may be entered so that all others can be left.

A block is a straight line in all six axes; its length is the norm over all of them, degrees counted like
millimetres, as the firmware reports feed. Lengths in mm or deg, times in s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

BLOCKS = 100
"""Blocks that the planner holds."""
LEAST_STEP_MM = 1e-9
SLOWEST = 1 / 60
"""A slower line is executed at this many mm/s."""

Vector = tuple[float, ...]


@dataclass(frozen=True)
class Limits:
    """What the settings allow. speed: (6,) mm/s. acceleration: (6,) mm/s^2. deviation: of a junction, mm."""

    speed: Vector
    acceleration: Vector
    deviation: float


@dataclass
class Block:
    """One line in the planner. speed: nominal, mm/s along the path; entry: speed at its start, squared."""

    start: Vector
    target: Vector
    direction: Vector
    length: float
    speed: float
    acceleration: float
    highest_entry: float
    line: int | None
    jog: bool
    entry: float = 0.0
    remaining: float = 0.0
    """Length not yet prepared."""

    def at(self, covered: float) -> Vector:
        """Position (6,) where a length has been covered."""
        if covered >= self.length:
            return self.target
        return tuple(p + covered * d for p, d in zip(self.start, self.direction, strict=True))


def straight(
    start: Vector, target: Vector, speed: float, limits: Limits, before: Block | None, line: int | None, jog: bool
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
    nominal = min(max(speed, SLOWEST), fastest)
    highest = 0.0
    if before is not None:
        highest = min(junction(before.direction, direction, limits), nominal**2, before.speed**2)
    return Block(start, target, direction, length, nominal, acceleration, highest, line, jog, remaining=length)


def junction(before: Vector, after: Vector, limits: Limits) -> float:
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


def look_ahead(blocks: Sequence[Block], speed: float) -> None:
    """Set the highest entry speeds from which every later block, and the end, can still be reached.

    speed: with which the first block is being left behind, mm/s.
    """
    leaving = 0.0
    for later in reversed(blocks[1:]):
        entry = min(later.highest_entry, leaving + 2 * later.acceleration * later.remaining)
        if entry == later.entry and later is not blocks[-1]:
            break
        later.entry = leaving = entry
    arriving = speed**2 + 2 * blocks[0].acceleration * blocks[0].remaining
    for later in blocks[1:]:
        later.entry = min(later.entry, arriving)
        arriving = later.entry + 2 * later.acceleration * later.remaining
