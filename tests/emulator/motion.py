"""Motors that execute what is planned, segment by segment.

PREPARED_SEGMENTS segments are worked out ahead of what the motors execute, which is why a feed hold takes effect
some 0.09 s late and reported speed runs ahead of reported position. Lengths in mm or deg, times in s.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from emulator.planner import BLOCKS, LEAST_STEP_MM, AxisLimits, Block, Overrides, Segment, Vector, ramp

PREPARED_SEGMENTS = 9
"""Segments prepared, the one being executed among them."""


class EmulatedMotors:
    """Plans blocks, prepares segments and executes them. position: (6,), where the motors are.

    limits: those that hold now; what is planned keeps its own.
    """

    def __init__(self, limits: Callable[[], AxisLimits]) -> None:
        self._limits = limits
        self.position: Vector = (0.0,) * len(limits().speed)
        self.blocks: deque[Block] = deque()
        self.segments: deque[Segment] = deque()
        self.finished: list[tuple[int | None, Vector]] = []
        self.lowest = list(self.position)
        self.highest = list(self.position)
        self.overrides = Overrides()
        self._read: int | None = None
        """Number of the line that was read last."""
        self.running = False
        self.holding = False
        self._elapsed = 0.0
        self.speed = 0.0
        """Speed in mm/s at the end of what has been prepared, which is what the firmware reports."""
        self._stopped = False

    @property
    def target(self) -> Vector:
        """Where the last planned block ends."""
        if self.blocks:
            return self.blocks[-1].target
        return self.segments[-1].block.target if self.segments else self.position

    @property
    def line(self) -> int | None:
        """The line number that is reported: of the block in preparation, else of the line that was read last."""
        return self.blocks[0].line if self.blocks else self._read

    @property
    def free(self) -> int:
        """Blocks that still fit into the planner."""
        return BLOCKS - len(self.blocks)

    @property
    def is_halted(self) -> bool:
        """Whether a hold has come to a standstill."""
        return self.holding and not self.running

    def begin_line(self, number: int | None) -> None:
        """Say which line has been read; None or 0 for one without a number."""
        self._read = number or None

    def place(self, position: Vector) -> None:
        """Say where the motors are, without motion."""
        self.position = position

    def plan(self, target: Vector, speed: float, line: int | None = None, jog: bool = False) -> None:
        """Append a line to target (6,) at a speed in mm/s along the path, unless there is nothing to move."""
        if math.dist(self.target, target) < LEAST_STEP_MM:
            return
        before = self.blocks[-1] if self.blocks else None
        block = Block(self.target, target, speed, self._limits(), before, line, jog)
        block.override(self.overrides, math.inf if before is None else before.speed)
        self.blocks.append(block)
        self._look_ahead()

    def override(self, overrides: Overrides) -> None:
        """Scale the speeds of what is planned and of what will be; what is prepared goes on as it is."""
        self.overrides = overrides
        before = math.inf
        for block in self.blocks:
            block.override(overrides, before)
            before = block.speed
        self._look_ahead(recompute_all=True)

    def _look_ahead(self, recompute_all: bool = False) -> None:
        """Set the highest entry speeds from which every later block, and the end, can still be reached.

        recompute_all: all of them, not only those that the last block changes.
        """
        if not self.blocks:
            return
        first, *later_blocks = self.blocks
        leaving = 0.0
        for later in reversed(later_blocks):
            entry = min(later.highest_entry, leaving + 2 * later.acceleration * later.remaining)
            if entry == later.entry and later is not self.blocks[-1] and not recompute_all:
                break
            later.enter(entry)
            leaving = entry
        arriving = self.speed**2 + 2 * first.acceleration * first.remaining
        for later in later_blocks:
            later.enter(min(later.entry, arriving))
            arriving = later.entry + 2 * later.acceleration * later.remaining

    def _prepare(self) -> None:
        """Fill the segment buffer from the blocks."""
        while self.blocks and len(self.segments) < PREPARED_SEGMENTS and not self._stopped:
            block = self.blocks[0]
            covered = block.length - block.remaining
            if self.holding and self.running:
                leaving = math.sqrt(max(self.speed**2 - 2 * block.acceleration * block.remaining, 0.0))
                stop = min(block.remaining, self.speed**2 / (2 * block.acceleration))
                length, speed, seconds = ramp(self.speed, stop, block, leaving)
                if speed < 1e-9 or stop < LEAST_STEP_MM:
                    self._stopped = True
                if stop < LEAST_STEP_MM:
                    self.speed = 0.0
                    return
            else:
                leaving = math.sqrt(self.blocks[1].entry) if len(self.blocks) > 1 else 0.0
                length, speed, seconds = ramp(self.speed, block.remaining, block, leaving)
            if seconds <= 0:
                length, seconds = block.remaining, 1e-6
            self.speed = speed
            block.cover(covered + length)
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

    def brake(self) -> None:
        """Come to a standstill along the path at once; what has been prepared is worked out anew."""
        if self.holding or not self.running or not self.segments:
            self.hold()
            return
        present = self.segments[0]
        self._return_segments()
        self.holding, self._elapsed, self.speed = True, 0.0, (present.end - present.begin) / present.seconds
        self._prepare()

    def resume(self) -> None:
        """Go on after a hold."""
        self.holding = False
        self.start()

    def flush(self) -> None:
        """Stop dead and forget everything planned; the position stays."""
        self.blocks.clear()
        self.segments.clear()
        self.running = self.holding = self._stopped = False
        self._elapsed = self.speed = 0.0

    def freeze(self) -> None:
        """Stop dead but keep the blocks, so that start() carries on with them."""
        if self.segments:
            self._return_segments()
        self.running = self.holding = self._stopped = False
        self._elapsed = self.speed = 0.0

    def _return_segments(self) -> None:
        """Give what was prepared but not executed back to the blocks."""
        for segment in reversed(self.segments):
            block = segment.block
            if not self.blocks or self.blocks[0] is not block:
                self.blocks.appendleft(block)
            share = self._elapsed / segment.seconds if segment is self.segments[0] else 0.0
            block.cover(segment.begin + share * (segment.end - segment.begin))
        self.segments.clear()
        self.blocks[0].begin_at(self.position)
        self.speed = 0.0
        self._look_ahead()

    def _settle(self) -> None:
        """At a standstill: a hold has its segments ready for going on."""
        self.running = self._stopped = False
        self.speed = 0.0
        if self.holding:
            self._look_ahead()
            self._prepare()

    def advance(self, seconds: float) -> None:
        """Let time pass."""
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
                self._reach(segment.block.at(segment.begin + share * (segment.end - segment.begin)))
                return
            seconds -= rest
            self._elapsed = 0.0
            self.segments.popleft()
            self._reach(segment.block.at(segment.end))
            if segment.last:
                self.finished.append((segment.block.line, segment.block.target))
            self._prepare()
            if not self.segments:
                self._settle()

    def _reach(self, position: Vector) -> None:
        self.position = position
        for i, value in enumerate(position):
            if value < self.lowest[i]:
                self.lowest[i] = value
            elif value > self.highest[i]:
                self.highest[i] = value
