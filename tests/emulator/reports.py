"""What the firmware tells of itself: banner, identity, numbered settings, modes, offsets and status reports."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from emulator.gcode import BAD_NUMBER, EMULATED_AXIS_LETTERS, NEGATIVE, Modal, Refused
from emulator.planner import AxisLimits, Overrides

NO_SUCH_SETTING, NEEDS_HOMING = 53, 10

CONFIGURED_MACHINE_SETTINGS = (
    "0=5.0 1=255 2=0 3=0 4=63 5=0 6=0 9=1 10=511 11=0.100 12=0.002 13=0 14=0 15=0 17=0 18=0 19=0 20=0 21=0 22=0 "
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
"""A configured machine as `$$` shows it: 400 steps/mm and 100 steps/deg, 50 mm/s and 600 deg/s.

The junction deviation $11 is ten times that of a controller as it is delivered, as playing needs it.
"""
_SETTING_TEXTS = {
    int(key): value for key, _, value in (pair.partition("=") for pair in CONFIGURED_MACHINE_SETTINGS.split())
}
DEFAULT_CONTROLLER_SETTINGS = {number: float(text) for number, text in _SETTING_TEXTS.items()}
SETTING_DECIMALS = {number: len(text.partition(".")[2]) for number, text in _SETTING_TEXTS.items()}

BANNER = "\r\nGrblHAL 1.1f ['$' or '$HELP' for help]"
UNLOCK = "[MSG:'$H'|'$X' to unlock]"
FIRMWARE_IDENTITY_LINES = (
    "[VER:1.1f.20260709:]",
    "[OPT:VNML+,100,1024,6,0]",
    "[AXS:6:XYZABC]",
    "[NEWOPT:ENUMS,RT+,TC,SED]",
    "[FIRMWARE:grblHAL]",
    "[SIGNALS:D]",
    "[NVS STORAGE:*EEPROM]",
    "[DRIVER:Simulator]",
    "[DRIVER VERSION:260324]",
)
HELP = "[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H $B ~ ! ? ctrl-x]"
BUTTONS = {**{f"limit_{letter.lower()}": letter for letter in EMULATED_AXIS_LETTERS}, "estop": "L", "reset": "R"}
"""Button -> its letter in status reports, in the order of the letters there."""
OFFSETS = ("G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3", "G28", "G30", "G92")
ZERO_OFFSETS_TEXT = "0.000,0.000,0.000,0.000,0.000,0.000"

IDLE_REPORTS = 10
BUSY_OFFSET_REPORTS, BUSY_OVERRIDE_REPORTS = 30, 20
"""How many reports go from one WCO, and from one Ov, to the next; IDLE_REPORTS where nothing moves."""


class ControllerSettings(dict[int, float]):
    """Setting number -> value, in the firmware's units (mm/min, mm/s^2, steps/mm)."""

    def __init__(self, changed: Mapping[int, float] | None = None) -> None:
        super().__init__({**DEFAULT_CONTROLLER_SETTINGS, **(changed or {})})

    def format_setting(self, number: int) -> str:
        """The line that the firmware prints for a setting."""
        return f"${number}={self[number]:.{SETTING_DECIMALS.get(number, 3)}f}"

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

    def limits(self) -> AxisLimits:
        """Speeds, accelerations and junction deviation for the planner."""
        speed = tuple(rate / 60 for rate in self.axes(110))
        return AxisLimits(speed, self.axes(120), self[11])


def modes(modal: Modal) -> list[str]:
    """The answer to $G."""
    codes = (modal.motion, 54, 17, 20 + (not modal.inches), 91 - modal.absolute, 94 - modal.inverse_time)
    return [f"[GC:{' '.join(f'G{code}' for code in codes)} G49 G98 G50 M5 M9 T0 F{modal.feed:g} S0.]"]


def offsets(settings: ControllerSettings, homed: Collection[int]) -> list[str]:
    """The answer to $#; homed: axes by index."""
    home = ",".join(f"{-settings[27] if i in homed else 0.0:.3f}" for i in range(len(EMULATED_AXIS_LETTERS)))
    homes = [f"[HOME:{home}:{sum(1 << i for i in homed)}]"] if homed else []
    return [
        *(f"[{name}:{ZERO_OFFSETS_TEXT}]" for name in OFFSETS),
        *homes,
        f"[TLO:{ZERO_OFFSETS_TEXT}]",
        f"[PRB:{ZERO_OFFSETS_TEXT}:0]",
    ]


@dataclass
class Status:
    """Composes status reports, and knows which of the rarer fields are due.

    until_offset, until_overrides: how many reports come before the next with that field. changed: what the next
    one tells beside: "overrides", "accessories", "homed", "tool".
    """

    until_offset: int = 1
    until_overrides: int = 0
    changed: frozenset[str] = frozenset({"tool"})

    def tell(self, what: str) -> None:
        """Let the next report tell that something has changed."""
        self.changed |= {what}

    def report(
        self,
        state: str,
        position: Iterable[float],
        buffers: tuple[int, int],
        line: int | None,
        feed: float,
        overrides: Overrides,
        pressed: Collection[str],
        homed: bool,
    ) -> str:
        """A report. position: (6,) mm and deg. buffers: free blocks and bytes. feed: mm/min along the path."""
        busy = state not in ("Idle", "Alarm", "Check")
        parts = [state, "MPos:" + ",".join(f"{p + 0.0:.3f}" for p in position), f"Bf:{buffers[0]},{buffers[1]}"]
        if line is not None:
            parts.append(f"Ln:{line}")
        parts.append(f"FS:{feed:.0f},0")
        if pressed:
            parts.append("Pn:" + "".join(letter for name, letter in BUTTONS.items() if name in pressed))
        parts += self._rarer(busy, overrides, homed)
        return f"<{'|'.join(parts)}>"

    def _rarer(self, busy: bool, overrides: Overrides, homed: bool) -> list[str]:
        parts = []
        if not busy:
            self.until_offset = min(self.until_offset, IDLE_REPORTS)
            self.until_overrides = min(self.until_overrides, IDLE_REPORTS)
        changed, self.changed = self.changed, frozenset()
        if "overrides" in changed:
            self.until_overrides = 0
            self.until_offset = max(self.until_offset, 1)
        if self.until_offset > 0:
            self.until_offset -= 1
        else:
            self.until_offset = (BUSY_OFFSET_REPORTS if busy else IDLE_REPORTS) - 1
            self.until_overrides = max(self.until_overrides, 1)
            parts.append(f"WCO:{ZERO_OFFSETS_TEXT}")
        if self.until_overrides > 0:
            self.until_overrides -= 1
        else:
            self.until_overrides = (BUSY_OVERRIDE_REPORTS if busy else IDLE_REPORTS) - 1
            changed |= {"accessories"} if "tool" in changed else set()
            parts.append(f"Ov:{overrides.feed},{overrides.rapid},{overrides.spindle}")
        rare = {"accessories": "A:", "homed": f"H:{homed:d}", "tool": "TLR:0"}
        return parts + [field for name, field in rare.items() if name in changed]
