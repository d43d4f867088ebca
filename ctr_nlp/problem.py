"""A problem: a robot, what it is to follow, and how long that may take."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from ctr_nlp.centreline import placed, read_csv, trimmed
from ctr_nlp.errors import OptionError, ProblemError
from ctr_nlp.robot import Robot, seed_robot
from ctr_nlp.target import Frame, Target, check_frames, growing

Array = npt.NDArray[np.float64]

OVERLONG = 1.005
"""A target up to this many times longer than the robot reaches is accepted; beta_d then stays at its bound."""


@dataclass(frozen=True)
class Problem:
    """A robot that is to follow a target of T frames within a duration in s.

    to_robot: rigid transform (4, 4) from the target's file to the robot's frame; the identity where the
    target was given in the robot's frame. truth: q (T, 2d + 2) where it is known. deviation: mm, how far
    smoothing, where asked for, moved the target. Raises ProblemError.
    """

    name: str
    robot: Robot
    target: Target
    duration: float = 10.0
    to_robot: Array | None = None
    truth: Array | None = None
    deviation: float = 0.0

    def __post_init__(self) -> None:
        if not (isinstance(self.duration, (int, float)) and math.isfinite(self.duration) and self.duration > 0):
            raise ProblemError(f"duration is {self.duration!r} s; it must be a finite number > 0")
        longest, reach = max(self.target.lengths), self.robot.reach
        if longest > reach * OVERLONG:
            raise ProblemError(
                f"the target of {self.name} is {longest:.2f} mm long and the robot reaches {reach:.2f} mm "
                f"(0.5 % more is accepted); say which end to drop, --trim start or --trim end"
            )

    @property
    def frames(self) -> int:
        """T, the number of frames."""
        return len(self.target)

    @property
    def dt(self) -> float:
        """Time from frame to frame, s."""
        return self.duration / self.frames

    def retraction(self) -> Problem:
        """The same frames in the opposite order: the robot's way back, named so."""
        target = Target(self.target.curves[::-1], self.target.lengths[::-1])
        truth = None if self.truth is None else self.truth[::-1]
        return replace(self, name=f"{self.name}-retraction", target=target, truth=truth)

    @cached_property
    def samples(self) -> tuple[Frame, ...]:
        """The target at 101 uniform sigma, frame by frame."""
        return self.target.sample()


def problem_from_file(
    path: str | Path,
    robot: Robot | None = None,
    frames: int = 100,
    duration: float = 10.0,
    reverse: bool = False,
    trim: Literal["start", "end"] | None = None,
    smoothing: float = 0.0,
) -> Problem:
    """The problem of advancing along a centreline file (CSV: x_mm, y_mm, z_mm and optionally radius_mm).

    reverse: follow it from its last point. trim: which end to drop where the path is longer than the robot
    reaches. smoothing: mm that the followed curve may keep from the points. Raises CurveError, ProblemError,
    OptionError.
    """
    check_frames(frames)
    if trim not in (None, "start", "end"):
        raise OptionError(f"trim is {trim!r}; it must be 'start' or 'end'")
    robot = robot or seed_robot()
    curve = read_csv(path, smoothing)
    if reverse:
        curve = curve.reversed()
    if trim is not None:
        curve = trimmed(curve, robot.reach, trim)
    curve, to_robot = placed(curve)
    return Problem(
        Path(path).stem, robot, growing(curve, frames), duration, to_robot=to_robot, deviation=curve.deviation
    )
