"""Positions of a robot's joints, from ROS joint states that come at irregular times."""

from __future__ import annotations

from collections import deque

import numpy as np

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices.ros2.messages import JointStates, Points
from ctr_nlp.typing import Array

MAX_JOINT_STATE_SILENCE_S = 0.5
"""s without new joint states after which the controller counts as gone, and by which states may be late."""

DRIFT = 1e-3
"""Largest relative difference in speed between the controller's clock and ours."""

REST = 0.05
"""s over which positions must agree for the joints to be at rest."""

AGREEING = 3
"""States that must agree for the joints to be at rest, however rarely they come."""


class Joints:
    """The joints of some hardware: their last states, and conversion to ROS units.

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
        """Position (m,) of the newest state, in the axes' units."""
        return self._seen[-1][1]

    def in_ros(self, points: Points) -> Points:
        """Convert points of the axes, in their units, to joints in rad and m."""
        position = (points.position - self._zero) * self._per_unit
        return Points(points.time, position, points.velocity * self._per_unit)

    def take(self, states: list[JointStates], now: float) -> None:
        """Take joint states that have come by now, s of the clock; raises DeviceFault for impossible ones."""
        ours = [state for state in states if set(state.name) & set(self.names)]
        if states and not ours:
            self.strangers = ", ".join(states[-1].name[:6])
        fresh = [self._add(state) for state in ours]
        if any(fresh):
            late = now - self._seen[-1][0]
            # The two clocks have an unknown offset. The least of now - stamp is this offset and the quickest
            # delay; what is above it is how much later a state comes. It may grow as fast as the clocks drift
            # apart.
            self._lag = min(late, self._lag + DRIFT * max(now - self.stamp, 0.0))
            if late - self._lag > MAX_JOINT_STATE_SILENCE_S:
                raise DeviceFault(f"joint states come {late - self._lag:.2g} s later than they did at first")
            self.stamp = now

    def _add(self, state: JointStates) -> bool:
        """Append a state and return True, unless it is not newer than the last one."""
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
        """Raise DeviceFault where no state has come for MAX_JOINT_STATE_SILENCE_S s.

        now: s of the clock.
        """
        if now - self.stamp > MAX_JOINT_STATE_SILENCE_S:
            raise DeviceFault(
                f"no fresh joint states have come for {MAX_JOINT_STATE_SILENCE_S:g} s: nobody knows where the "
                f"joints are"
            )

    def still(self) -> bool:
        """Return whether the last positions agree: at least AGREEING of them, over at least REST s."""
        if len(self._seen) < AGREEING or self._seen[-1][0] - self._seen[0][0] < REST:
            return False
        return bool((np.ptp([position for _, position in self._seen], axis=0) <= self._resolution).all())


def _columns(state: JointStates, names: list[str]) -> list[int]:
    """Return where in a state the joints of these names are; raises DeviceFault unless each is there once."""
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
