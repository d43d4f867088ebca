"""A problem: a robot, what it is to follow, and how long that may take."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from ctr_nlp.exceptions import ProblemError
from ctr_nlp.robot import Robot
from ctr_nlp.support.values import floats, instance, number
from ctr_nlp.target.curve import Curve
from ctr_nlp.target.target import Frame, Target
from ctr_nlp.typing import Array

OVERLONG = 1.005
"""A target up to this many times longer than the robot reaches is accepted; beta_d then stays at its bound."""


@dataclass(frozen=True)
class Problem:
    """A robot that is to follow a target of T frames within a duration in s.

    to_robot: transform (4, 4) from the target's file, in its own coordinates, to the robot's frame; None where the
    target was given in the robot's frame. truth: q (T, 2d + 2) where it is known. lumen: the path with the lumen's
    radius along it, in the robot's frame, longer than the target where more of it is known; by default the target
    where all frames share a curve with a radius, else None: no wall is known. Raises ProblemError.
    """

    name: str
    robot: Robot
    target: Target
    duration: float = 10.0
    to_robot: Array | None = None
    truth: Array | None = None
    lumen: Curve | None = None

    def __post_init__(self) -> None:
        for name, kind in (("name", str), ("robot", Robot), ("target", Target)):
            instance(ProblemError, f"{name} of a problem", getattr(self, name), kind)
        number(ProblemError, "duration", self.duration, lambda x: 0 < x < math.inf, "be a finite number > 0", " s")
        self._check_arrays()
        longest, reach = max(self.target.lengths), self.robot.reach
        if longest > reach * OVERLONG:
            raise ProblemError(
                f"the target of {self.name} is {longest:.2f} mm long and the robot reaches {reach:.2f} mm "
                f"(0.5 % more is accepted); say which end to drop, --trim start or --trim end"
            )
        if self.lumen is None:
            object.__setattr__(self, "lumen", self._walled())
        elif not isinstance(self.lumen, Curve) or self.lumen.radius is None:
            raise ProblemError("lumen is a curve without a radius; give one, or None where no wall is known")

    def _check_arrays(self) -> None:
        """Keep read-only copies of what was given as arrays."""
        for name, shape in (("to_robot", (4, 4)), ("truth", (self.frames, 2 * self.robot.d + 2))):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, floats(ProblemError, name, getattr(self, name), shape))

    def _walled(self) -> Curve | None:
        """The one curve of all frames, where it has a radius."""
        first = self.target.curves[0]
        alone = all(curve is first for curve in self.target.curves)
        return first if alone and first.radius is not None else None

    @property
    def frames(self) -> int:
        """T, the number of frames."""
        return len(self.target)

    @property
    def dt(self) -> float:
        """Time from frame to frame, s."""
        return self.duration / self.frames

    @property
    def deviation(self) -> float:
        """How far smoothing, where asked for, moved the target at most, mm."""
        return max(curve.deviation for curve in self.target.curves)

    @property
    def deviation_share(self) -> float:
        """How much of the lumen's radius that is at most; 0 where no radius is known."""
        return max(curve.deviation_share for curve in self.target.curves)

    def retraction(self) -> Problem:
        """The same frames in the opposite order: the robot's way back, named so."""
        target = Target(self.target.curves[::-1], self.target.lengths[::-1])
        truth = None if self.truth is None else self.truth[::-1]
        return replace(self, name=f"{self.name}-retraction", target=target, truth=truth)

    @cached_property
    def samples(self) -> tuple[Frame, ...]:
        """The target at 101 uniform sigma, frame by frame."""
        return self.target.sample()
