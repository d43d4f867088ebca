"""Who a Grbl controller is, and whether its settings go with the hardware file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import DeviceFault
from ctr_nlp.executor.hardware import Hardware


@dataclass(frozen=True)
class Identity:
    """letters of its axes; receive: bytes that it can keep; blocks: of its planner; settings: by number."""

    letters: str
    receive: int
    blocks: int
    settings: dict[int, str]

    def setting(self, number: int) -> float:
        """A setting as a number; raises DeviceFault."""
        try:
            return float(self.settings[number])
        except (KeyError, ValueError) as error:
            raise DeviceFault(f"the controller does not tell its setting ${number}") from error

    def columns(self, hardware: Hardware) -> list[int]:
        """Which of its axes the hardware's are; raises DeviceFault."""
        missing = [axis.letter for axis in hardware.axes if axis.letter not in self.letters]
        if missing:
            raise DeviceFault(f"the controller has axes {self.letters}; the hardware wants {missing[0]}")
        return [self.letters.index(axis.letter) for axis in hardware.axes]

    def check(self, hardware: Hardware) -> None:
        """Raise DeviceFault unless it is set so that the hardware's limits can be used and are kept."""
        if self.setting(13):
            raise DeviceFault("the controller reports in inches: set $13=0")
        for axis, column in zip(hardware.axes, self.columns(hardware), strict=True):
            for base, name, wanted in ((110, "speed", 60 * axis.speed), (120, "acceleration", axis.acceleration)):
                there = self.setting(base + column)
                if there < wanted * (1 - 1e-9):
                    raise DeviceFault(
                        f"the controller's ${base + column}={there:g} is less than the {name} of {axis.letter} in "
                        f"the hardware file ({wanted:g} here): it would be late; raise the one or lower the other"
                    )
        if hardware.connection.homing == "cycle" and not (self.setting(22) % 2 and self.setting(20)):
            raise DeviceFault("homing is a cycle: the controller must have $22=1 (homing) and $20=1 (soft limits)")

    def resolution(self, hardware: Hardware) -> npt.NDArray[np.float64]:
        """What the hardware's axes (m,) can tell apart, in their units: a step, and the last digit of reports."""
        return 1.0 / np.array([self.setting(100 + column) for column in self.columns(hardware)]) + 1e-3
