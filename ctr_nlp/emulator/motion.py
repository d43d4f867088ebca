"""The planner and the stepper of the firmware: straight blocks, look-ahead, and speed in segments of 10 ms.

A block is a straight line in all six axes; its length is the norm over all of them, degrees counted like
millimetres, as the firmware reports feed. Speed is worked out segment by segment and PREPARED segments
ahead of what the motors execute, which is why a feed hold takes effect some 0.09 s late and reported
speed runs ahead of reported position. Lengths in mm or deg, times in s.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

BLOCKS = 100
"""Blocks that the planner holds."""
PREPARED = 9
"""Segments prepared, the one being executed among them."""
SEGMENT_S = 0.01
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


@dataclass(frozen=True)
class Segment:
    """A piece of a block between two covered lengths, executed at constant speed."""

    block: Block
    begin: float
    end: float
    seconds: float
    last: bool


def ramp(speed: float, rest: float, block: Block, leaving: float, seconds: float) -> tuple[float, float, float]:
    """(length, speed at the end, time taken) of one segment: a trapezoid's next seconds, not beyond rest."""
    acceleration, nominal = block.acceleration, block.speed
    covered, left = 0.0, seconds
    while left > 0 and rest - covered > LEAST_STEP_MM:
        ahead = rest - covered
        braking = (speed * speed - leaving * leaving) / (2 * acceleration)
        if braking >= ahead - LEAST_STEP_MM:
            end = math.sqrt(max(speed * speed - 2 * acceleration * ahead, leaving * leaving))
            whole = 2 * ahead / (speed + end) if speed + end > 0 else 0.0
            if whole <= left:
                return rest, end, seconds - left + whole
            return covered + left * (speed - acceleration * left / 2), speed - acceleration * left, seconds
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
                    ahead = rest - covered
                    whole = 2 * ahead / (speed + leaving) if speed + leaving > 0 else 0.0
                    if whole <= left:
                        return rest, leaving, seconds - left + whole
                    return covered + left * (speed - acceleration * left / 2), speed - acceleration * left, seconds
                continue
        cruise = ahead - max(braking, 0.0)
        time = min(cruise / speed, left)
        covered += time * speed
        left -= time
        if time == 0:
            break
    return covered, speed, seconds - left


class Motion:
    """Plans blocks, prepares segments and executes them. position: (6,), where the motors are."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.position: Vector = (0.0,) * len(limits.speed)
        self.blocks: deque[Block] = deque()
        self.segments: deque[Segment] = deque()
        self.finished: list[tuple[int | None, Vector]] = []
        self.lowest = list(self.position)
        self.highest = list(self.position)
        self.line: int | None = None
        """Line number of the block last executed."""
        self.running = False
        self.holding = False
        self._elapsed = 0.0
        self._speed = 0.0
        self._stopped = False

    @property
    def target(self) -> Vector:
        """Where the last planned block ends."""
        if self.blocks:
            return self.blocks[-1].target
        return self.segments[-1].block.target if self.segments else self.position

    @property
    def free(self) -> int:
        """Blocks that still fit into the planner."""
        return BLOCKS - len(self.blocks)

    @property
    def speed(self) -> float:
        """Speed in mm/s at the end of what has been prepared, which is what the firmware reports."""
        return self._speed

    @property
    def halted(self) -> bool:
        """Whether a hold has come to a standstill."""
        return self.holding and not self.running

    def place(self, position: Vector) -> None:
        """Say where the motors are, without motion."""
        self.position = position

    def plan(self, target: Vector, speed: float, line: int | None = None, jog: bool = False) -> bool:
        """Append a line to target (6,) at a speed in mm/s along the path; False where there is nothing to move."""
        start = self.target
        delta = [b - a for a, b in zip(start, target, strict=True)]
        length = math.sqrt(sum(d * d for d in delta))
        if length < LEAST_STEP_MM:
            return False
        direction = tuple(d / length for d in delta)
        used = [i for i, d in enumerate(direction) if d]
        fastest = min(self.limits.speed[i] / abs(direction[i]) for i in used)
        acceleration = min(self.limits.acceleration[i] / abs(direction[i]) for i in used)
        nominal = min(max(speed, SLOWEST), fastest)
        highest = 0.0
        if self.blocks:
            before = self.blocks[-1]
            highest = min(self._junction(before.direction, direction), nominal**2, before.speed**2)
        block = Block(start, target, direction, length, nominal, acceleration, highest, line, jog)
        block.remaining = length
        self.blocks.append(block)
        self._look_ahead()
        return True

    def _junction(self, before: Vector, after: Vector) -> float:
        """Squared speed through a corner: that of an arc which leaves the corner by the junction deviation."""
        cosine = -sum(a * b for a, b in zip(before, after, strict=True))
        if cosine > 0.999999:
            return 0.0
        if cosine < -0.999999:
            return math.inf
        change = [b - a for a, b in zip(before, after, strict=True)]
        size = math.sqrt(sum(c * c for c in change))
        limit = min(a * size / abs(c) for a, c in zip(self.limits.acceleration, change, strict=True) if c)
        sine = math.sqrt(0.5 * (1 - cosine))
        return limit * self.limits.deviation * sine / (1 - sine)

    def _look_ahead(self) -> None:
        """Highest entry speeds from which every later block, and the end, can still be reached."""
        blocks = list(self.blocks)
        leaving = 0.0
        for block in reversed(blocks[1:]):
            entry = min(block.highest_entry, leaving + 2 * block.acceleration * block.remaining)
            if entry == block.entry and block is not blocks[-1]:
                break
            block.entry = leaving = entry
        first = blocks[0]
        arriving = self._speed**2 + 2 * first.acceleration * first.remaining
        for block in blocks[1:]:
            block.entry = min(block.entry, arriving)
            arriving = block.entry + 2 * block.acceleration * block.remaining

    def _prepare(self) -> None:
        """Fill the segment buffer from the blocks."""
        while self.blocks and len(self.segments) < PREPARED and not self._stopped:
            block = self.blocks[0]
            covered = block.length - block.remaining
            if self.holding and self.running:
                leaving = math.sqrt(max(self._speed**2 - 2 * block.acceleration * block.remaining, 0.0))
                stop = min(block.remaining, self._speed**2 / (2 * block.acceleration))
                length, speed, seconds = ramp(self._speed, stop, block, leaving, SEGMENT_S)
                if speed < 1e-9 or stop < LEAST_STEP_MM:
                    self._stopped = True
                if stop < LEAST_STEP_MM:
                    self._speed = 0.0
                    return
            else:
                leaving = math.sqrt(self.blocks[1].entry) if len(self.blocks) > 1 else 0.0
                length, speed, seconds = ramp(self._speed, block.remaining, block, leaving, SEGMENT_S)
            if seconds <= 0:
                length, seconds = block.remaining, 1e-6
            self._speed = speed
            block.remaining -= length
            done = block.remaining <= LEAST_STEP_MM
            end = block.length if done else covered + length
            self.segments.append(Segment(block, covered, end, seconds, done))
            if done:
                self.blocks.popleft()

    def start(self) -> None:
        """Execute what is planned, unless held."""
        if (self.blocks or self.segments) and not self.holding:
            self.running = True
            self._prepare()

    def hold(self) -> None:
        """Come to a standstill along the path, after what has been prepared."""
        self.holding = True
        if not self.segments:
            self._settle()

    def resume(self) -> None:
        """Go on after a hold."""
        self.holding = False
        self.start()

    def flush(self) -> None:
        """Stop dead and forget everything planned; the position stays."""
        self.blocks.clear()
        self.segments.clear()
        self.running = self.holding = self._stopped = False
        self._elapsed = self._speed = 0.0

    def freeze(self) -> None:
        """Stop dead but keep the blocks, so that start() carries on with them."""
        if self.segments:
            self._return_segments()
        self.running = self.holding = self._stopped = False
        self._elapsed = self._speed = 0.0

    def _return_segments(self) -> None:
        """Give what was prepared but not executed back to the blocks."""
        for segment in reversed(self.segments):
            block = segment.block
            if not self.blocks or self.blocks[0] is not block:
                self.blocks.appendleft(block)
            share = self._elapsed / segment.seconds if segment is self.segments[0] else 0.0
            block.remaining = block.length - (segment.begin + share * (segment.end - segment.begin))
        self.segments.clear()
        first = self.blocks[0]
        first.start, first.length = self.position, first.remaining
        self._speed = 0.0
        self._look_ahead()

    def _settle(self) -> None:
        """At a standstill: a hold has its segments ready for the way on."""
        self.running = self._stopped = False
        self._speed = 0.0
        if self.holding:
            if self.blocks:
                self._look_ahead()
            self._prepare()

    def advance(self, seconds: float) -> float:
        """Let time pass; returns the time left over because a standstill came first."""
        while self.running and seconds > 0:
            if not self.segments:
                self._prepare()
                if not self.segments:
                    self._settle()
                    break
            segment = self.segments[0]
            rest = segment.seconds - self._elapsed
            if seconds < rest:
                self._elapsed += seconds
                share = self._elapsed / segment.seconds
                self._reach(segment.block.at(segment.begin + share * (segment.end - segment.begin)), segment)
                return 0.0
            seconds -= rest
            self._elapsed = 0.0
            self.segments.popleft()
            self._reach(segment.block.at(segment.end), segment)
            if segment.last:
                self.finished.append((segment.block.line, segment.block.target))
            self._prepare()
            if not self.segments:
                self._settle()
        return seconds

    def _reach(self, position: Vector, segment: Segment) -> None:
        self.position = position
        self.line = segment.block.line
        for i, value in enumerate(position):
            if value < self.lowest[i]:
                self.lowest[i] = value
            elif value > self.highest[i]:
                self.highest[i] = value
