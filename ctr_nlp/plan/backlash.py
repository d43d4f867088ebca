"""Rotation lag as a state of a motion: play that grows with the overlap of tubes, viscous drag, and a sensor's
delay.

Tubes rub against those around them: a tube is held back while its motor turns against that of the next one
outwards, the outermost while it turns in its guide, and tubes that turn together do not lag. With gamma_i, rad, by
which motor i has turned against motor i - 1, the tube is at alpha_i = motor_i + c_i - gamma_i, where

    tau_i c_i' = min(max(c_i, gamma_i - w_i), gamma_i + w_i) - c_i,   w_i = w0_i + w1_i overlap_i

with the play w_i, rad, to either side and the time constant tau_i, s, of drag. While motors turn one way at one
speed, play, drag and delay look the same: a tube that is behind. Play does not depend on the speed, drag is
proportional to it, and a delay holds back insertions and tilt as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import apply_backlash
from ctr_nlp.support.value_checks import floats
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags

BACKLASH_DENOMINATOR_FLOOR = 1e-12
"""Replaces 0 in denominators."""
MIN_REVERSING_TURN_RAD = 1e-4
"""Turn from frame to frame, rad, below which a tube counts as not having turned back."""
BACKLASH_PARAMETER_NAMES = "play", "play_per_mm", "drag"
"""Parts of a lag."""


@dataclass(frozen=True, eq=False)
class BacklashAndDrag(ReadOnlyValue):
    """By how much tubes stay behind their motors: of each (d,), of n robots (n, d), or one number for all.

    play: rad to either side. play_per_mm: by how much that grows for each mm of overlap, rad/mm. drag: the time
    within which a tube makes up for 1 - 1/e of what it is behind by more than its play, s: at a steady speed it is
    behind by drag times speed on top of the play. None is negative. Raises RobotError.
    """

    play: Any
    play_per_mm: Any = 0.0
    drag: Any = 0.0

    def __post_init__(self) -> None:
        for name in BACKLASH_PARAMETER_NAMES:
            given = np.ndim(getattr(self, name))
            value = floats(RobotError, f"{name} of a lag", getattr(self, name), (None,) * given)
            object.__setattr__(self, name, value)
            if value.min(initial=0.0) < 0:
                raise RobotError(f"{name} of a lag is {value.min():g}; it must be at least 0")
        super().__post_init__()

    def check(self, robot: Robot) -> None:
        """Raise RobotError unless these are the lags of as many tubes as a robot has."""
        for name in BACKLASH_PARAMETER_NAMES:
            value = getattr(self, name)
            if value.ndim and value.shape[-1] != robot.d:
                raise RobotError(
                    f"{name} of a lag has {value.shape[-1]} numbers, and the robot {robot.d} tubes: give as many, "
                    "or one number for all"
                )

    def apply_to_motion(self, robot: Robot, q: Array, time: Array, fresh: Flags | None = None) -> Array:
        """Return the configurations (.., T, 2d + 2) of tubes whose motors move through q (T, 2d + 2) at time (T,)
        s.

        (n, T, 2d + 2) where the lags are those of n robots. fresh (T,): at which of q tubes stand where their
        motors do; by default at the first alone. From one q to the next every motor turns at a steady speed, and
        the play is that of the next: for such motors the result is the exact solution.
        """
        q = np.asarray(q, dtype=float)
        time = np.asarray(time, dtype=float)
        starts = np.arange(len(q)) == 0 if fresh is None else fresh
        shape = np.broadcast_shapes(self.play.shape, self.play_per_mm.shape, self.drag.shape, (robot.d,))
        found = np.broadcast_to(q, (*shape[:-1], *q.shape)).copy()
        play = self.play_at(robot, q)
        passed = np.diff(time, prepend=time[:1])
        # Turns against the next tube outwards: tubes that are turned together do not rub.
        turn = np.diff(against_outer(robot, q), axis=0, prepend=0.0)
        ahead = np.zeros(shape)
        for j in range(len(q)):
            ahead = (
                np.zeros(shape) if starts[j] else self.advance_offset(ahead, turn[j], play[..., j, :], passed[j])
            )
            found[..., j, : robot.d] += ahead
        return found

    def play_at(self, robot: Robot, q: Array) -> Array:
        """The play (.., T, d) rad to either side at motors q (T, 2d + 2)."""
        play, slope = (each[..., None, :] if each.ndim else each for each in (self.play, self.play_per_mm))
        return np.asarray(play + slope * overlaps(robot, q))

    def advance_offset(self, ahead: Array, turn: Array, play: Array, time: float) -> Array:
        """Return by how much tubes (.., d) are ahead of their motors, rad, after motors have turned.

        ahead (.., d): before that. turn (d,): of each motor against the next one outwards, rad, at a steady
        speed. play (.., d): to either side, rad, at the end. time: that the turn takes, s. Behind is negative.
        """
        # Without drag: first the play may have shrunk around a tube at rest, then the motor turns and takes it
        # along at the end of the play.
        at_once = apply_backlash(apply_backlash(ahead, np.zeros_like(turn), play), turn, play) - turn
        return np.where(self.drag > 0, _offset_with_drag(ahead, turn, play, self.drag, time), at_once)

    def compensate_motion(self, robot: Robot, q: Array, time: Array) -> Array:
        """Return where motors must go (T, 2d + 2) so that tubes come through q (T, 2d + 2) at time (T,) s with
        this lag.

        Motors go past where tubes are to be by the play, which is the inverse of `turned`, and by what drag holds
        back at the speed at which tubes turn against each other. At the first of q tubes stand where motors do. A
        tube that is to stay where it is against the motor around it is left as it is.
        """
        found = np.array(q, dtype=float)
        d = robot.d
        rate = np.diff(against_outer(robot, found), axis=0, prepend=0.0) / np.diff(time, prepend=-1.0)[:, None]
        play = self.play_at(robot, found)
        behind = self.drag * rate
        side = np.zeros(d)
        for j in range(1, len(q)):
            carried = 0.0
            for i in range(d):
                # From the outermost tube on: what counts is the turn against the motor around it, which has its
                # own correction already.
                turn = q[j, i] - q[j - 1, i] - carried
                # A tube at rest stays at the end of the play that it came to.
                side[i] = np.sign(turn) if abs(turn) > MIN_REVERSING_TURN_RAD else side[i]
                found[j, i] += side[i] * play[j, i] + behind[j, i]
                carried = found[j, i] - found[j - 1, i]
        return found


def against_outer(robot: Robot, q: Array) -> Array:
    """By what motors are turned against those of the tubes around them, (.., d) rad, at q (.., 2d + 2).

    The outermost tube turns against what stands still.
    """
    return np.diff(np.asarray(q, dtype=float)[..., : robot.d], prepend=0.0, axis=-1)


def _offset_with_drag(ahead: Array, turn: Array, play: Array, drag: Array, time: float) -> Array:
    """Return by how much tubes are ahead of their motors after these turned by `turn` in `time`, with drag.

    ahead (.., d): before that, rad. turn (d,): rad, against the next tube outwards, at a steady speed. play (..,
    d): rad. drag: time constant, s. time: s. The motion has three phases: a tube that is ahead by more than its
    play comes back by drag until it is within it; it stands still while the motor takes up the play; and then it
    follows with drag.
    """
    # Mirrored, so that every motor turns forwards.
    to = np.where(turn < 0, -1.0, 1.0)
    e = to * ahead
    speed = abs(turn) / max(time, BACKLASH_DENOMINATOR_FLOOR)
    left = np.full(ahead.shape, time)
    steady = np.maximum(drag * speed, BACKLASH_DENOMINATOR_FLOOR)
    excess = np.maximum(e - play, 0.0)
    # Phase 1: e' = -(e - play) / drag - speed, and the time until e = play.
    within = np.minimum(drag * np.log1p(excess / steady), left)
    e = np.minimum(e, play) + np.maximum((excess + steady) * _decay(within, drag) - steady, 0.0)
    left = left - within
    # Phase 2: e falls with the motor from play to -play.
    still = np.minimum(np.maximum(e + play, 0.0) / np.maximum(speed, BACKLASH_DENOMINATOR_FLOOR), left)
    e = e - speed * still
    left = left - still
    # Phase 3: e + play decays towards -drag speed, the steady lag.
    short = np.minimum(e + play, 0.0)
    follows = (short + drag * speed) * _decay(left, drag) - drag * speed
    return np.asarray(to * np.where(left > 0, np.maximum(e, -play) + follows, e))


def _decay(time: Array, drag: Array) -> Array:
    return np.asarray(np.exp(-time / np.maximum(drag, BACKLASH_DENOMINATOR_FLOOR)))


def overlaps(robot: Robot, q: Array) -> Array:
    """Return the lengths of tubes' curved parts that lie within the tubes around them, (.., d) mm, at q (.., 2d +
    2).

    For the outermost tube, the length behind the insertion point, where the part presses against what holds it.
    """
    beta = robot.split(np.asarray(q, dtype=float))[1]
    ends = np.concatenate([np.zeros_like(beta[..., :1]), beta[..., :-1]], axis=-1)
    curved = np.array([tube.curved_length for tube in robot.tubes])
    # What is out beyond the next tube outwards, at most the curved part, does not overlap.
    return np.asarray(curved - np.clip(beta - ends, 0.0, curved))


def delay_configurations(q: Array, time: Array, delay: float, fresh: Flags | None = None) -> Array:
    """Configurations (T, 2d + 2) as a sensor tells them that is late by delay s, at time (T,) s.

    Between those given they change linearly, and before a fresh one (T,) they stand still. A delay may be
    negative.
    """
    q = np.asarray(q, dtype=float)
    time = np.asarray(time, dtype=float)
    starts = np.arange(len(q)) == 0 if fresh is None else fresh
    runs = np.flatnonzero(starts)
    found = np.array(q)
    for first, last in zip(runs, [*runs[1:], len(q)], strict=True):
        own = q[first:last]
        at = time[first:last]
        for column in range(q.shape[1]):
            found[first:last, column] = np.interp(at - delay, at, own[:, column])
    return found
