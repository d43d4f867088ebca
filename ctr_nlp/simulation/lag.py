"""Rotation lag as a state of a motion: play that grows with the overlap of tubes, viscous drag; a sensor's delay.

Tubes rub against those around them: a tube is held back while its motor turns against that of the next one
outwards, the outermost while it turns in its guide, and tubes that turn together do not lag. All three show the
same while motors turn one way at one speed: a tube that is behind. Play does not depend on the speed, drag is
proportional to it, and a delay holds back insertions and tilt as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import dragged
from ctr_nlp.support.equal import Kept
from ctr_nlp.support.values import floats
from ctr_nlp.typing import Array, Flags

TINY = 1e-12
"""What stands for 0 in a denominator."""


@dataclass(frozen=True, eq=False)
class Lag(Kept):
    """By how much tubes stay behind their motors; each (d,), or (n, d) for n robots at once, and at least 0.

    play: rad to either side. play_per_mm: by how much that grows for each mm of overlap, rad/mm. drag: the time
    within which a tube makes up for 1 - 1/e of what it is behind by more than its play, s: at a steady speed it is
    behind by drag times speed on top of the play. Raises RobotError.
    """

    play: Array
    play_per_mm: Array
    drag: Array

    def __post_init__(self) -> None:
        for name in ("play", "play_per_mm", "drag"):
            value = np.asarray(getattr(self, name), dtype=float)
            floats(RobotError, f"{name} of a lag", value, (None,) * value.ndim)
            if value.min(initial=0.0) < 0:
                raise RobotError(f"{name} of a lag is {value.min():g}; it must be at least 0")
        super().__post_init__()

    def turned(self, robot: Robot, q: Array, time: Array, fresh: Flags | None = None) -> Array:
        """The configurations (.., T, 2d + 2) of tubes whose motors move through q (T, 2d + 2) at time (T,) s.

        (n, T, 2d + 2) where the lags are those of n robots. At those of q that are fresh (T,), by default at the
        first alone, tubes stand where their motors do. From one to the next every motor turns at a steady speed,
        and the play is that of the next: of such a motion what is found is the exact solution.
        """
        q, time = np.asarray(q, dtype=float), np.asarray(time, dtype=float)
        starts = np.arange(len(q)) == 0 if fresh is None else fresh
        play, slope, drag = np.broadcast_arrays(self.play, self.play_per_mm, self.drag)
        found = np.broadcast_to(q, (*play.shape[:-1], *q.shape)).copy()
        passed, hidden = np.diff(time, prepend=time[:1]), overlaps(robot, q)
        turned = np.diff(q[:, : robot.d], prepend=0.0, axis=1)
        ahead = np.zeros(play.shape)
        for j in range(len(q)):
            width = play + slope * hidden[j]
            if starts[j]:
                ahead = np.zeros(play.shape)
            else:
                turn = turned[j] - turned[j - 1]
                at_once = dragged(dragged(ahead, np.zeros(robot.d), width), turn, width) - turn
                ahead = np.where(drag > 0, _behind(ahead, turn, width, drag, passed[j]), at_once)
            found[..., j, : robot.d] += ahead
        return found


def _behind(ahead: Array, turn: Array, play: Array, drag: Array, time: float) -> Array:
    """What tubes are ahead of motors that turn steadily by turn, against others, in time s; before that, ahead.

    One that is ahead by more than its play is left behind by drag until it is within it, stands still while the
    motor takes up the play, and then follows with drag. All (.., d).
    """
    to = np.where(turn < 0, -1.0, 1.0)
    e, speed, left = to * ahead, abs(turn) / max(time, TINY), np.full(ahead.shape, time)
    steady = np.maximum(drag * speed, TINY)
    excess = np.maximum(e - play, 0.0)
    within = np.minimum(drag * np.log1p(excess / steady), left)
    e = np.minimum(e, play) + np.maximum((excess + steady) * _decay(within, drag) - steady, 0.0)
    left = left - within
    still = np.minimum(np.maximum(e + play, 0.0) / np.maximum(speed, TINY), left)
    e, left = e - speed * still, left - still
    short = np.minimum(e + play, 0.0)
    follows = (short + drag * speed) * _decay(left, drag) - drag * speed
    return np.asarray(to * np.where(left > 0, np.maximum(e, -play) + follows, e))


def _decay(time: Array, drag: Array) -> Array:
    return np.asarray(np.exp(-time / np.maximum(drag, TINY)))


def overlaps(robot: Robot, q: Array) -> Array:
    """What of tubes' curved parts lies within the tubes around them, (.., d) mm, at q (.., 2d + 2).

    Of the outermost tube, what lies behind the insertion point. There the part presses against what holds it.
    """
    beta = robot.split(np.asarray(q, dtype=float))[1]
    ends = np.concatenate([np.zeros_like(beta[..., :1]), beta[..., :-1]], axis=-1)
    curved = np.array([tube.curved_length for tube in robot.tubes])
    return np.asarray(curved - np.clip(beta - ends, 0.0, curved))


def delayed(q: Array, time: Array, delay: float, fresh: Flags | None = None) -> Array:
    """Configurations (T, 2d + 2) as a sensor tells them that is late by delay s, at time (T,) s.

    Between those given they change linearly, and before a fresh one (T,) they stand still. A delay may be
    negative.
    """
    q, time = np.asarray(q, dtype=float), np.asarray(time, dtype=float)
    starts = np.arange(len(q)) == 0 if fresh is None else fresh
    runs = np.flatnonzero(starts)
    found = np.array(q)
    for first, last in zip(runs, [*runs[1:], len(q)], strict=True):
        own, at = q[first:last], time[first:last]
        for column in range(q.shape[1]):
            found[first:last, column] = np.interp(at - delay, at, own[:, column])
    return found
