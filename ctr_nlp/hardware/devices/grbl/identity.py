"""Who a Grbl controller is: its axes, buffers and settings, and the steps in which it counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.description import Hardware


@dataclass(frozen=True)
class Identity:
    """letters of its axes; receive: bytes that it can keep; blocks: of its planner; settings: by name
    ("110"; startup lines are "N0", "N1"), as told.
    told: version, options and driver, as it answers $I; these tell it from another controller.
    """

    letters: str
    receive: int
    blocks: int
    settings: dict[str, str]
    told: str

    def setting(self, number: int) -> float:
        """A setting as a number; raises DeviceFault."""
        try:
            return float(self.settings[str(number)])
        except (KeyError, ValueError) as exception:
            raise DeviceFault(f"the controller does not tell its setting ${number}") from exception

    def columns(self, hardware: Hardware) -> list[int]:
        """Which of its axes the hardware's are; raises DeviceFault."""
        missing = [axis.letter for axis in hardware.axes if axis.letter not in self.letters]
        if missing:
            raise DeviceFault(f"the controller has axes {self.letters}; the hardware wants {missing[0]}")
        return [self.letters.index(axis.letter) for axis in hardware.axes]

    def resolution(self, hardware: Hardware) -> npt.NDArray[np.float64]:
        """What the hardware's axes (m,) can tell apart, in their units: a step, and the last digit of reports."""
        return 1.0 / np.array([self.setting(100 + column) for column in self.columns(hardware)]) + 1e-3

    def acceleration(self, hardware: Hardware) -> npt.NDArray[np.float64]:
        """With which the controller moves the hardware's axes (m,), in unit/s^2."""
        return np.array([self.setting(120 + column) for column in self.columns(hardware)])
