"""Backlash of tubes as a state of a motion: play that grows with the overlap, viscous drag, and a sensor's delay.

Neighbouring tubes rub against each other. Let gamma_i, rad, be the angle by which motor i has turned against motor
i - 1, the outermost one against its guide. Tube i is then at alpha_i = motor_i + c_i - gamma_i, with

    tau_i c_i' = min(max(c_i, gamma_i - w_i), gamma_i + w_i) - c_i,   w_i = w0_i + w1_i overlap_i

with the play w_i, rad, to either side and the time constant tau_i, s, of drag. Without drag this is the play
operator (Brokate and Sprekels, Hysteresis and Phase Transitions, 1996). Tubes that turn together do not rub. While
motors turn one way at one speed, play, drag and delay look the same: the tube is behind its motor. Play does not
depend on the speed, drag is proportional to it, and a delay also concerns insertion and tilt.
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
"""Fields of a BacklashAndDrag."""


@dataclass(frozen=True, eq=False)
class BacklashAndDrag(ReadOnlyValue):
    """Play and viscous drag of tubes: for each tube (d,), for n robots (n, d), or one number for all.

    play: rad to either side. play_per_mm: growth of the play with the overlap, rad/mm. drag: time constant with
    which a tube approaches the range of its play, s; at a steady speed the tube is behind its motor by drag times
    speed on top of the play. None is negative. Raises RobotError.
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
        """Raise RobotError unless there is one number for all tubes of `robot`, or as many as it has tubes."""
        for name in BACKLASH_PARAMETER_NAMES:
            value = getattr(self, name)
            if value.ndim and value.shape[-1] != robot.d:
                raise RobotError(
                    f"{name} of a lag has {value.shape[-1]} numbers, and the robot {robot.d} tubes: give as many, "
                    "or one number for all"
                )

    def apply_to_motion(self, robot: Robot, q: Array, time: Array, fresh: Flags | None = None) -> Array:
        """Return the configurations (T, 2d + 2) of the tubes, rad and mm, while their motors move through q.

        robot: whose curved lengths and extensions give the overlaps. q: (T, 2d + 2) of the motors. time: (T,) in
        s. fresh: (T,) of bool, where tubes stand at their motors' angles; by default the first one alone. The
        result is (n, T, 2d + 2) where these are the lags of n robots. It is exact for motors that turn at a steady
        speed from one q to the next, with the play of the next.
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
        """Return the play (.., T, d), rad to either side, of the tubes of `robot` at motors q (T, 2d + 2)."""
        play, slope = (each[..., None, :] if each.ndim else each for each in (self.play, self.play_per_mm))
        return np.asarray(play + slope * overlaps(robot, q))

    def advance_offset(self, ahead: Array, turn: Array, play: Array, time: float) -> Array:
        """Return the angles (.., d), rad, by which tubes are ahead of their motors after a turn of these.

        ahead: (.., d) in rad, before the turn; negative where a tube is behind. turn: (d,) in rad, of each motor
        against the next one outwards, at a steady speed. play: (.., d) in rad to either side, after the turn.
        time: duration of the turn, s.
        """
        # Without drag: first the play may have shrunk around a tube at rest, then the motor turns and takes it
        # along at the end of the play.
        at_once = apply_backlash(apply_backlash(ahead, np.zeros_like(turn), play), turn, play) - turn
        return np.where(self.drag > 0, _offset_with_drag(ahead, turn, play, self.drag, time), at_once)

    def compensate_motion(self, robot: Robot, q: Array, time: Array) -> Array:
        """Return the motors' configurations (T, 2d + 2) with which tubes pass through q (T, 2d + 2) with this lag.

        robot: whose curved lengths and extensions give the overlaps. time: (T,) in s. Motors overshoot by the
        play, which inverts `apply_to_motion`, and by drag times the speed at which tubes turn against each other.
        At the first of q tubes stand at their motors' angles.
        """
        found = np.array(q, dtype=float)
        d = robot.d
        # The rate of the first row has no meaning and is not used; -1 s only keeps its divisor from being 0.
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
    """Return the motors' angles (.., d), rad, relative to the next motor outwards, at q (.., 2d + 2) of `robot`.

    The outermost tube turns against its guide, which stands still.
    """
    return np.diff(np.asarray(q, dtype=float)[..., : robot.d], prepend=0.0, axis=-1)


def _offset_with_drag(ahead: Array, turn: Array, play: Array, drag: Array, time: float) -> Array:
    """Return the angles (.., d), rad, by which tubes are ahead of their motors after a turn of these, with drag.

    ahead: (.., d) in rad, before the turn. turn: (d,) in rad, against the next tube outwards, at a steady speed.
    play: (.., d) in rad. drag: time constant, s. time: duration of the turn, s. The motion has three phases: a
    tube that is ahead by more than its play is dragged back into it; it stands still while the motor takes up the
    play; and then it follows the motor with drag.
    """
    # The law is odd: e -> -e with turn -> -turn. Mirrored, every motor turns forwards, and one case is enough.
    to = np.where(turn < 0, -1.0, 1.0)
    e = to * ahead
    speed = abs(turn) / max(time, BACKLASH_DENOMINATOR_FLOOR)
    left = np.full(ahead.shape, time)
    steady = np.maximum(drag * speed, BACKLASH_DENOMINATOR_FLOOR)
    excess = np.maximum(e - play, 0.0)
    # Phase 1: e' = -(e - play) / drag - speed, whose solution e - play = (excess + steady) exp(-t / drag) - steady
    # reaches 0 after drag log(1 + excess / steady).
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
    """Return the lengths (.., d), mm, of curved parts within the tube around them, at q (.., 2d + 2) of `robot`.

    For the outermost tube it is the length behind the insertion point, where the guide straightens it.
    """
    beta = robot.split(np.asarray(q, dtype=float))[1]
    ends = np.concatenate([np.zeros_like(beta[..., :1]), beta[..., :-1]], axis=-1)
    curved = np.array([tube.curved_length for tube in robot.tubes])
    # The length beyond the end of the next tube outwards, at most the curved part, does not overlap.
    return np.asarray(curved - np.clip(beta - ends, 0.0, curved))


def delay_configurations(q: Array, time: Array, delay: float, fresh: Flags | None = None) -> Array:
    """Return the configurations (T, 2d + 2) that a sensor with a delay sees.

    q: (T, 2d + 2), the actual ones, linear in between. time: (T,) in s. delay: s, may be negative. fresh: (T,) of
    bool, where a recording begins, before which the robot stood still; by default the first one alone.
    """
    q = np.asarray(q, dtype=float)
    time = np.asarray(time, dtype=float)
    starts = np.arange(len(q)) == 0 if fresh is None else fresh
    runs = np.flatnonzero(starts)
    found = np.array(q)
    for first, last in zip(runs, [*runs[1:], len(q)], strict=True):
        own = q[first:last]
        at = time[first:last]
        # np.interp holds the end values outside its range: the robot stands still before and after a recording.
        for column in range(q.shape[1]):
            found[first:last, column] = np.interp(at - delay, at, own[:, column])
    return found
