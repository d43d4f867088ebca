"""The path that a joint_trajectory_controller is to follow, and the pace at which it does, as trajectories.

A trajectory without points is no stop: newer controllers refuse it, older ones leave the last command standing, a
jump in speed. So a hold is a trajectory that goes on along the path and comes to rest, and the first point of
every trajectory lies ahead, for the controller to go to from its own place and speed.

With the path p(t), t the time of the trajectory and v = dt/d(clock) the pace, axes move at p' v and accelerate by
p'' v^2 + p' dv/d(clock).
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
"""s in which the pace may go to 0, or back to 1; the first that the axes' accelerations allow is taken."""

MAX_STOP_DURATION_S = 0.25
"""s that a stop takes at most, whatever the axes' accelerations are."""


class Ramp(NamedTuple):
    """A pace that changes linearly in time.

    begun: s of the clock at which it starts. start: time of the trajectory then, s. before, after: the pace.
    length: s of the clock from one pace to the other.
    """

    begun: float
    start: float
    before: float
    after: float
    length: float

    def at(self, passed: Array) -> tuple[Array, Array]:
        """Return times of the trajectory, s, and the pace, (N,) each.

        passed: (N,) s since the ramp began.
        """
        part = np.clip(passed / self.length, 0.0, 1.0)
        change = self.after - self.before
        time = self.start + self.length * part * (self.before + 0.5 * change * part)
        time += self.after * np.maximum(passed - self.length, 0.0)
        return time, self.before + change * part

    def when(self, time: Array) -> Array:
        """Return after how many s (N,) times of the trajectory are reached; 0 for past ones, inf for never.

        time: (N,) s.
        """
        slope = (self.after - self.before) / self.length
        ahead = np.maximum(time - self.start, 0.0)
        # Solves before x + slope x^2 / 2 = ahead in the form x = 2 ahead / (before + root), which has no
        # cancellation and no division by a slope of 0. Without a real root the pace is 0 before the time is
        # reached.
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
    start: position (m,) of the axes, in their units. ramp: of the track that it replaces, None for one at rest.
    """

    def __init__(self, start: Array, commands: Commands, ramp: Ramp | None = None) -> None:
        self.ends = np.append(0.0, commands.time)
        points = np.vstack([start, commands.positions])
        chord = np.diff(points, axis=0) / np.diff(self.ends)[:, None]
        most = np.zeros_like(points)
        # A cubic is monotone between two points where its slopes have the chord's sign and at most three times its
        # size (Fritsch and Carlson, 1980).
        most[1:-1] = 3.0 * np.minimum(abs(chord[1:]), abs(chord[:-1])) * (chord[1:] * chord[:-1] > 0)
        slope = np.clip(CubicSpline(self.ends, points, bc_type="clamped")(self.ends, 1), -most, most)
        self._path = CubicHermiteSpline(self.ends, points, slope)
        self.end = float(self.ends[-1])
        self.ramp = Ramp(-np.inf, 0.0, 0.0, 0.0, 1.0) if ramp is None else ramp

    def now(self, clock: float) -> tuple[float, float]:
        """Return the time of the trajectory, s, and the pace that the controller should have; clock: now, s."""
        time, pace = self.ramp.at(np.array([clock - self.ramp.begun]))
        return min(float(time[0]), self.end), float(pace[0])

    def rests(self, clock: float) -> bool:
        """Return whether the controller has nothing left to do; clock: now, s."""
        time, pace = self.now(clock)
        return time >= self.end or (pace == 0.0 and self.ramp.after == 0.0)

    def position(self, time: float) -> Array:
        """Return the position (m,) of the axes at a time of the trajectory, s."""
        return np.asarray(self._path(time))

    def turn(self, clock: float, pace: float, acceleration: Array) -> None:
        """Change the pace from now on, as fast as the axes allow.

        clock: now, s. pace: the new one, 0 or 1. acceleration: largest of the axes (m,), in unit/s^2.
        """
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
        """Play from the start, where the commands are at rest; clock: now, s."""
        self.ramp = Ramp(clock, 0.0, 1.0, 1.0, 1.0)

    def begin_ramp(self, clock: float) -> None:
        """Start the ramp now, since the controller begins when its trajectory has been sent.

        clock: now, s.
        """
        self.ramp = self.ramp._replace(begun=clock)

    def points(self) -> Points:
        """Return the points ahead of the start of the ramp, at rest at the end; time in s since then."""
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
        # Newer controllers refuse a trajectory that ends in motion.
        velocity[-1] = 0.0
        return Points(passed, self._path(time), velocity)


def stop_there(position: Array, speed: Array, acceleration: Array) -> Points:
    """Return a trajectory of one point, at which the axes come to rest straight ahead.

    position, speed: (m,) of the axes now. acceleration: largest (m,), in unit/s^2.
    """
    length = max(RAMPS[0], min(MAX_STOP_DURATION_S, float((abs(speed) / acceleration).max())))
    goal = position + 0.5 * length * speed
    return Points(np.array([length]), goal[None], np.zeros((1, len(goal))))
