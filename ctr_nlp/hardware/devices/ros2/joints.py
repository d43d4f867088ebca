"""Where a robot's joints are, from joint states that come when they come."""

from __future__ import annotations

from collections import deque

import numpy as np

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices.ros2.messages import JointStates, Points
from ctr_nlp.typing import Array

MAX_JOINT_STATE_SILENCE_S = 0.5
"""s without fresh joint states after which the controller counts as gone, or by which they may come late."""

DRIFT = 1e-3
"""By which part the controller's clock may run faster or slower than ours."""

REST = 0.05
"""s over which positions must agree for the joints to be at rest."""

AGREEING = 3
"""States that must agree for the joints to be at rest, however rarely they come."""


class Joints:
    """The joints of some hardware: their last states, and their units in ROS.

    stamp: s of the clock when the newest state came, -inf before any. Everything else is in the axes' units.
    """

    def __init__(self, hardware: Hardware, resolution: Array) -> None:
        self.names = [axis.joint for axis in hardware.axes]
        self._zero = hardware.each("zero")
        metres = [1e-3 if name.startswith("beta") else 1.0 for name in self.names]
        self._per_unit = np.array(metres) / hardware.each("scale")
        self._resolution = resolution
        self._seen: deque[tuple[float, Array]] = deque()
        self._lag = np.inf
        self.stamp = -np.inf
        self.speed = np.zeros(len(self.names))
        """(m,) per s, of the newest state."""
        self.strangers = ""
        """Some names of the last state that was of other joints alone."""

    @property
    def has_state(self) -> bool:
        """Whether any state has come."""
        return bool(self._seen)

    @property
    def position(self) -> Array:
        """(m,) of the newest state."""
        return self._seen[-1][1]

    def in_ros(self, points: Points) -> Points:
        """Points of the axes, in rad and m."""
        position = (points.position - self._zero) * self._per_unit
        return Points(points.time, position, points.velocity * self._per_unit)

    def take(self, states: list[JointStates], now: float) -> None:
        """Take states that have come by now (s of the clock); raises DeviceFault where they cannot be true."""
        ours = [state for state in states if set(state.name) & set(self.names)]
        if states and not ours:
            self.strangers = ", ".join(states[-1].name[:6])
        fresh = [self._add(state) for state in ours]
        if any(fresh):
            late = now - self._seen[-1][0]
            self._lag = min(late, self._lag + DRIFT * max(now - self.stamp, 0.0))
            if late - self._lag > MAX_JOINT_STATE_SILENCE_S:
                raise DeviceFault(f"joint states come {late - self._lag:.2g} s later than they did at first")
            self.stamp = now

    def _add(self, state: JointStates) -> bool:
        """Keep a state, unless it is not newer than the last and tells nothing."""
        columns = _columns(state, self.names)
        position = np.array(state.position)[columns]
        if not np.isfinite(position).all():
            raise DeviceFault(
                f"{self.names[int(np.isfinite(position).argmin())]} is not a number in a joint state"
            )
        position = self._zero + position / self._per_unit
        if self._seen and state.stamp <= self._seen[-1][0]:
            return False
        if state.velocity and np.isfinite(state.velocity).all():
            self.speed = np.array(state.velocity)[columns] / self._per_unit
        elif self._seen:
            self.speed = (position - self._seen[-1][1]) / (state.stamp - self._seen[-1][0])
        self._seen.append((state.stamp, position))
        while len(self._seen) > AGREEING and state.stamp - self._seen[1][0] >= REST:
            self._seen.popleft()
        return True

    def check_fresh(self, now: float) -> None:
        """Raise DeviceFault where no state has come for MAX_JOINT_STATE_SILENCE_S s."""
        if now - self.stamp > MAX_JOINT_STATE_SILENCE_S:
            raise DeviceFault(
                f"no fresh joint states have come for {MAX_JOINT_STATE_SILENCE_S:g} s: nobody knows where the "
                f"joints are"
            )

    def still(self) -> bool:
        """Whether the last positions agree: AGREEING of them at least, and all of REST s."""
        if len(self._seen) < AGREEING or self._seen[-1][0] - self._seen[0][0] < REST:
            return False
        return bool((np.ptp([position for _, position in self._seen], axis=0) <= self._resolution).all())


def _columns(state: JointStates, names: list[str]) -> list[int]:
    """Where in a state joints are; raises DeviceFault unless each is there once and everything is told of it."""
    if len(state.position) != len(state.name) or len(state.velocity) not in (0, len(state.name)):
        raise DeviceFault(
            f"a joint state has {len(state.name)} names, {len(state.position)} positions and "
            f"{len(state.velocity)} velocities"
        )
    for name in names:
        if state.name.count(name) != 1:
            raise DeviceFault(
                f"a joint state of {', '.join(state.name)} has {name} {state.name.count(name)} times"
            )
    return [state.name.index(name) for name in names]
