"""The arm beside a motion of the axes: it is led by the device's progress, and must keep in step with it."""

from __future__ import annotations

import numpy as np

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.devices import Progress
from ctr_nlp.hardware.devices.arms import ArmFollower
from ctr_nlp.hardware.motion.trajectory import Trajectory

AHEAD = 0.1
"""s for which the arm goes on without news from the device."""

IN_STEP = 0.005
"""rad by which the arm may be off where the device's progress, within the skew tolerance, puts it."""

LEVEL = 1e-3
"""rad by which the arm may be off the last frame, SETTLING s after the axes are there."""

SETTLING = 0.5

TICK = 0.005
"""s between two looks at the arm while it settles."""


class Leading:
    """Leads an arm through the tilts of a trajectory."""

    def __init__(self, arm: ArmFollower, trajectory: Trajectory, clock: Clock) -> None:
        self._arm, self._trajectory, self._clock = arm, trajectory, clock
        self._tolerance = trajectory.hardware.arm.skew_tolerance if trajectory.hardware.arm else 0.0

    def follow(self, progress: Progress) -> None:
        """Let the arm follow the device's progress; raises DeviceFault where it does not."""
        late = self._clock.now() - progress.stamp
        now = progress.time + (min(late, AHEAD) if progress.state == "running" else 0.0)
        self._arm.follow(self._trajectory.tilt(now))
        around = self._trajectory.tilt(now + np.linspace(-1.0, 1.0, 21) * self._tolerance)
        away = np.linalg.norm(around - self._arm.tilt(), axis=1).min()
        if away > IN_STEP:
            raise DeviceFault(
                f"the arm is not in step: {np.degrees(away):.2g} deg from every tilt within {self._tolerance:g} s"
            )

    def arrive(self) -> float:
        """Let the arm come to the last tilt and rest; by how much it stays off, rad."""
        end, theta = self._clock.now() + SETTLING, self._trajectory.tilt(self._trajectory.duration)
        self._arm.follow(theta)
        while (off := float(np.linalg.norm(self._arm.tilt() - theta))) > 0.1 * LEVEL and self._clock.now() < end:
            self._clock.sleep(TICK)
            self._arm.follow(theta)
        self._arm.hold()
        return off

    def hold(self) -> None:
        """Let the arm stand still."""
        self._arm.hold()
