"""The path that a joint_trajectory_controller is to follow, and the pace at which it does, as trajectories.

A trajectory without points is no stop: newer controllers refuse it, older ones leave the last command standing,
a jump in speed. So a hold is a trajectory that goes on along the path and comes to rest, and the first point of
every trajectory lies ahead, for the controller to go to from its own place and speed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from ctr_nlp.hardware.devices.ros2.messages import Points
from ctr_nlp.hardware.motion.lookahead import Commands
from ctr_nlp.typing import Array

FIRST_POINT_DELAY_IN_MOTION_S = 0.1
"""s until the first point of a trajectory that is begun in motion: when it arrives, the controller is not quite
where it was thought to be."""

FIRST_POINT_DELAY_AT_REST_S = 0.02
"""s until the first point of one that is begun at rest, on the path."""

LAST_POINT_SPACING_S = 0.005
"""s by which the last point comes after the one before it."""

RAMPS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.6, 1.0)
"""s in which the pace may go to nothing, or come back; the first that the axes' accelerations allow is taken."""

MAX_STOP_DURATION_S = 0.25
"""s that a stop takes at most, whatever the axes' accelerations are."""


class Ramp(NamedTuple):
    """A pace that changes steadily from one to another, begun (s of the clock) at a time of the trajectory."""

    begun: float
    start: float
    before: float
    after: float
    length: float

    def at(self, passed: Array) -> tuple[Array, Array]:
        """Times of the trajectory, and the pace (N,), so many s (N,) after it was begun."""
        part = np.clip(passed / self.length, 0.0, 1.0)
        change = self.after - self.before
        time = self.start + self.length * part * (self.before + 0.5 * change * part)
        time += self.after * np.maximum(passed - self.length, 0.0)
        return time, self.before + change * part

    def when(self, time: Array) -> Array:
        """After how many s times (N,) of the trajectory are reached; 0 for those before, inf for those never."""
        slope = (self.after - self.before) / self.length
        ahead = np.maximum(time - self.start, 0.0)
        root = np.sqrt(np.maximum(self.before**2 + 2.0 * slope * ahead, 0.0))
        total = np.where(self.before**2 + 2.0 * slope * ahead >= 0, self.before + root, 0.0)
        within = np.where(total > 0, 2.0 * ahead / np.where(total > 0, total, 1.0), np.inf)
        within = np.where(ahead > 0, within, 0.0)
        left = time - self.at(np.array([self.length]))[0]
        beyond = self.length + (left / self.after if self.after > 0 else np.full_like(left, np.inf))
        return np.where(within <= self.length, within, beyond)


class ControllerTrack:
    """The path that a controller is to follow, from a position (m,) along commands, and its pace.

    It is at rest at both ends, overshoots no command, and is a cubic between commands, as the controller's is.
    ramp: of the track whose place it takes, None for one that is at rest.
    """

    def __init__(self, start: Array, commands: Commands, ramp: Ramp | None = None) -> None:
        self.ends = np.append(0.0, commands.time)
        points = np.vstack([start, commands.positions])
        chord = np.diff(points, axis=0) / np.diff(self.ends)[:, None]
        most = np.zeros_like(points)
        most[1:-1] = 3.0 * np.minimum(abs(chord[1:]), abs(chord[:-1])) * (chord[1:] * chord[:-1] > 0)
        slope = np.clip(CubicSpline(self.ends, points, bc_type="clamped")(self.ends, 1), -most, most)
        self._path = CubicHermiteSpline(self.ends, points, slope)
        self.end = float(self.ends[-1])
        self.ramp = Ramp(-np.inf, 0.0, 0.0, 0.0, 1.0) if ramp is None else ramp

    def now(self, clock: float) -> tuple[float, float]:
        """The time of the trajectory and the pace at which the controller should be now (s of the clock)."""
        time, pace = self.ramp.at(np.array([clock - self.ramp.begun]))
        return min(float(time[0]), self.end), float(pace[0])

    def rests(self, clock: float) -> bool:
        """Whether the controller has nothing left to do."""
        time, pace = self.now(clock)
        return time >= self.end or (pace == 0.0 and self.ramp.after == 0.0)

    def position(self, time: float) -> Array:
        """Of the axes (m,), at a time of the trajectory."""
        return np.asarray(self._path(time))

    def turn(self, clock: float, pace: float, acceleration: Array) -> None:
        """Let the pace go to another from now on, as fast as accelerations (m,) of the axes allow."""
        time, before = self.now(clock)
        for length in RAMPS:
            self.ramp = Ramp(clock, time, before, pace, length)
            at, running = self.ramp.at(np.linspace(0.0, length, 21))
            at = np.minimum(at, self.end)[:, None]
            needed = (
                self._path(at[:, 0], 2) * running[:, None] ** 2
                + self._path(at[:, 0], 1) * (pace - before) / length
            )
            if (abs(needed) <= acceleration).all() or (pace == 0.0 and length >= MAX_STOP_DURATION_S):
                return

    def begin(self, clock: float) -> None:
        """Play from the start; the commands begin at rest."""
        self.ramp = Ramp(clock, 0.0, 1.0, 1.0, 1.0)

    def begin_ramp(self, clock: float) -> None:
        """Count the pace from now on: the controller begins when its trajectory has been sent."""
        self.ramp = self.ramp._replace(begun=clock)

    def points(self) -> Points:
        """What is ahead from where the ramp begins, at rest at its end; time in s since then."""
        ramp = self.ramp
        passed = ramp.when(self.ends)
        if ramp.before < 1.0 or ramp.after < 1.0 or ramp.start > 0.0:
            passed = passed[
                passed > (FIRST_POINT_DELAY_IN_MOTION_S if ramp.before > 0 else FIRST_POINT_DELAY_AT_REST_S)
            ]
        passed = passed[np.isfinite(passed) & (passed > 0)]
        if np.isinf(ramp.when(self.ends[-1:])[0]):
            passed = np.append(passed[passed < ramp.length - LAST_POINT_SPACING_S], ramp.length)
        elif not len(passed):
            passed = ramp.when(self.ends[-1:])
        time, pace = self.ramp.at(passed)
        time = np.minimum(time, self.end)
        velocity = self._path(time, 1) * pace[:, None]
        velocity[-1] = 0.0
        return Points(passed, self._path(time), velocity)


def stop_there(position: Array, speed: Array, acceleration: Array) -> Points:
    """One point, to come to rest at from a position (m,) at a speed (m,), as fast as accelerations (m,) allow."""
    length = max(RAMPS[0], min(MAX_STOP_DURATION_S, float((abs(speed) / acceleration).max())))
    goal = position + 0.5 * length * speed
    return Points(np.array([length]), goal[None], np.zeros((1, len(goal))))
