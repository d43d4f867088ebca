"""Speed along a block, worked out in segments of 10 ms, each executed at constant speed."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ctr_nlp.hardware.emulator.mechanics.planner import LEAST_STEP_MM, Block

SEGMENT_S = 0.01


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
            length, speed, time = _braked(speed, end, ahead, acceleration, left)
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
                    length, speed, time = _braked(speed, leaving, rest - covered, acceleration, left)
                    return covered + length, speed, SEGMENT_S - left + time
                continue
        time = min((ahead - max(braking, 0.0)) / speed, left)
        covered += time * speed
        left -= time
        if time == 0:
            break
    return covered, speed, SEGMENT_S - left


def _braked(
    speed: float, end: float, ahead: float, acceleration: float, left: float
) -> tuple[float, float, float]:
    """(length, speed, time taken) of slowing down to a speed over a length ahead, for the time left at most."""
    whole = 2 * ahead / (speed + end) if speed + end > 0 else 0.0
    if whole <= left:
        return ahead, end, whole
    return left * (speed - acceleration * left / 2), speed - acceleration * left, left
