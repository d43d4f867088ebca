"""One motor: the joint that it moves, how far and how fast."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ctr_nlp.exceptions import HardwareError, RobotError
from ctr_nlp.support.values import numbers
from ctr_nlp.typing import Array

UNITS = {"beta": {"mm": 1.0}, "alpha": {"deg": math.degrees(1.0), "rad": 1.0}}
"""What an axis may count in, by what it moves, and how much of that a mm or a rad is."""


@dataclass(frozen=True)
class Axis:
    """One motor and the joint that it moves: position = zero + sign * (joint in the axis' unit).

    joint: "alpha_i" or "beta_i". letter: in G-code. unit: "mm" for beta, "deg" or "rad" for alpha. range: (lower,
    upper) position; speed, acceleration: largest, in unit/s and unit/s^2. backlash: play of the drive, made up for
    on every reversal; tolerance: how far from its command the axis may be found. Raises HardwareError.
    """

    joint: str
    letter: str
    unit: str
    range: tuple[float, float]
    speed: float
    acceleration: float
    sign: int = 1
    zero: float = 0.0
    backlash: float = 0.0
    tolerance: float = 0.5

    def __post_init__(self) -> None:
        kind, _, number = str(self.joint).partition("_")
        if kind not in UNITS or not number.isdecimal() or int(number) < 1:
            raise HardwareError(f"joint of an axis is {self.joint!r}; it must be alpha_i or beta_i, with i from 1")
        if self.unit not in UNITS[kind]:
            raise HardwareError(f"unit of {self.joint} is {self.unit!r}; it must be {' or '.join(UNITS[kind])}")
        if not (isinstance(self.letter, str) and len(self.letter) == 1 and self.letter in "XYZABCUVW"):
            raise HardwareError(f"letter of {self.joint} is {self.letter!r}; it must be one of X Y Z A B C U V W")
        if isinstance(self.sign, bool) or self.sign not in (-1, 1):
            raise HardwareError(f"sign of {self.joint} is {self.sign!r}; it must be 1 or -1")
        for name in ("speed", "acceleration", "zero", "backlash", "tolerance"):
            value = self._numbers(name, 1)[0]
            if name != "zero" and (value < 0 or (value == 0 and name != "backlash")):
                raise HardwareError(
                    f"{name} of {self.joint} is {value:g}; it must be positive{' or 0' * (name == 'backlash')}"
                )
            object.__setattr__(self, name, float(value))
        lower, upper = self._numbers("range", 2)
        if lower >= upper:
            raise HardwareError(f"range of {self.joint} is [{lower:g}, {upper:g}]; the lower must be less")
        object.__setattr__(self, "range", (float(lower), float(upper)))

    def _numbers(self, name: str, size: int) -> Array:
        value = getattr(self, name)
        if size > 1 and np.shape(value) != (size,):
            raise HardwareError(f"{name} of {self.joint} is {value!r}; give {size} numbers")
        try:
            return numbers(f"{name} of {self.joint}", value, size)
        except RobotError as exception:
            raise HardwareError(str(exception)) from exception

    @property
    def scale(self) -> float:
        """Position per mm or rad of the joint."""
        return self.sign * UNITS[self.joint.partition("_")[0]][self.unit]
