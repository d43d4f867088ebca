"""The controller's numbered settings: the configured machine's values and how each is shown."""

from __future__ import annotations

from collections.abc import Mapping

from ctr_nlp.hardware.emulator.mechanics.planner import AxisLimits
from ctr_nlp.hardware.emulator.protocol.gcode import BAD_NUMBER, NEGATIVE, Refused

NO_SUCH_SETTING, NEEDS_HOMING = 53, 10

SHOWN = (
    "0=5.0 1=255 2=0 3=0 4=63 5=0 6=0 9=1 10=511 11=0.010 12=0.002 13=0 14=0 15=0 17=0 18=0 19=0 20=0 21=0 22=0 "
    "23=0 24=25.0 25=500.0 26=250 27=1.000 28=0.100 29=0.0 30=1000.000 31=0.000 32=0 33=5000.0 34=0.0 35=0.0 "
    "36=100.0 37=0 39=1 40=0 41=0 42=2 43=1 44=4 45=3 46=0 47=0 48=0 49=0 56=5.0 57=100.0 58=-5.0 59=500.0 60=0 "
    "61=0 62=0 63=3 64=0 65=0 "
    "100=400.00000 101=400.00000 102=400.00000 103=100.00000 104=100.00000 105=100.00000 "
    "110=3000.000 111=3000.000 112=3000.000 113=36000.000 114=36000.000 115=36000.000 "
    "120=200.000 121=200.000 122=200.000 123=2000.000 124=2000.000 125=2000.000 "
    "130=150.000 131=150.000 132=150.000 133=720.000 134=720.000 135=720.000 "
    "341=0 342=30.0 343=25.0 344=200.0 345=200.0 346=1 376=7 384=0 392=4.0 393=1.0 394=0.0 398=100 481=0 485=0 "
    "486=0 538=0 539=0.0 673=0.0 676=15 680=0"
)
"""A configured machine as `$$` shows it: 400 steps/mm and 100 steps/deg, 50 mm/s and 600 deg/s."""
_TEXTS = {int(key): value for key, _, value in (pair.partition("=") for pair in SHOWN.split())}
DEFAULTS = {number: float(text) for number, text in _TEXTS.items()}
DECIMALS = {number: len(text.partition(".")[2]) for number, text in _TEXTS.items()}


class ControllerSettings(dict[int, float]):
    """Setting number -> value, in the firmware's units (mm/min, mm/s^2, steps/mm)."""

    def __init__(self, changed: Mapping[int, float] | None = None) -> None:
        super().__init__({**DEFAULTS, **(changed or {})})

    def shown(self, number: int) -> str:
        """The line that the firmware prints for a setting."""
        return f"${number}={self[number]:.{DECIMALS.get(number, 3)}f}"

    def change(self, text: str) -> int:
        """Apply `n=value`; returns n. Soft limits need homing. Raises Refused with the error number."""
        key, _, value = text.partition("=")
        number = int(key)
        if number not in self:
            raise Refused(NO_SUCH_SETTING)
        try:
            amount = float(value)
        except ValueError:
            raise Refused(BAD_NUMBER) from None
        if amount < 0 and self[number] >= 0 and number >= 100:
            raise Refused(NEGATIVE)
        if number == 20 and amount and not self[22]:
            raise Refused(NEEDS_HOMING)
        self[number] = amount
        if number == 22 and not amount:
            self[20] = 0
        return number

    def axes(self, first: int) -> tuple[float, ...]:
        """(6,) values of a setting that every axis has, X first."""
        return tuple(self[first + i] for i in range(6))

    def homing_axes(self) -> list[int]:
        """Axes, by index, in the order in which they are homed."""
        cycles = [int(self[44 + i]) for i in range(3)]
        return [axis for cycle in cycles for axis in range(6) if cycle >> axis & 1]

    @property
    def limits(self) -> AxisLimits:
        """Speeds, accelerations and junction deviation for the planner."""
        speed = tuple(rate / 60 for rate in self.axes(110))
        return AxisLimits(speed, self.axes(120), self[11])
