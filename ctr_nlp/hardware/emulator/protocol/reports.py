"""What the firmware prints about itself: banner, identity, modes, offsets and status reports."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from ctr_nlp.hardware.emulator.mechanics.overrides import Overrides
from ctr_nlp.hardware.emulator.protocol.gcode import AXES, Modal
from ctr_nlp.hardware.emulator.protocol.settings import ControllerSettings

BANNER = "\r\nGrblHAL 1.1f ['$' or '$HELP' for help]"
UNLOCK = "[MSG:'$H'|'$X' to unlock]"
VERSION = (
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
BUTTONS = {**{f"limit_{letter.lower()}": letter for letter in AXES}, "estop": "L", "reset": "R"}
"""Button -> its letter in status reports, in the order of the letters there."""
OFFSETS = ("G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3", "G28", "G30", "G92")
ZERO = "0.000,0.000,0.000,0.000,0.000,0.000"

IDLE_REPORTS = 10
BUSY_OFFSET_REPORTS, BUSY_OVERRIDE_REPORTS = 30, 20
"""How many reports go from one WCO, and from one Ov, to the next; IDLE_REPORTS where nothing moves."""


def modes(modal: Modal) -> list[str]:
    """The answer to $G."""
    codes = (modal.motion, 54, 17, 20 + (not modal.inches), 91 - modal.absolute, 94 - modal.inverse_time)
    return [f"[GC:{' '.join(f'G{code}' for code in codes)} G49 G98 G50 M5 M9 T0 F{modal.feed:g} S0.]"]


def offsets(settings: ControllerSettings, homed: Collection[int]) -> list[str]:
    """The answer to $#; homed: axes by index."""
    home = ",".join(f"{-settings[27] if i in homed else 0.0:.3f}" for i in range(len(AXES)))
    homes = [f"[HOME:{home}:{sum(1 << i for i in homed)}]"] if homed else []
    return [*(f"[{name}:{ZERO}]" for name in OFFSETS), *homes, f"[TLO:{ZERO}]", f"[PRB:{ZERO}:0]"]


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
            parts.append(f"WCO:{ZERO}")
        if self.until_overrides > 0:
            self.until_overrides -= 1
        else:
            self.until_overrides = (BUSY_OVERRIDE_REPORTS if busy else IDLE_REPORTS) - 1
            changed |= {"accessories"} if "tool" in changed else set()
            parts.append(f"Ov:{overrides.feed},{overrides.rapid},{overrides.spindle}")
        rare = {"accessories": "A:", "homed": f"H:{homed:d}", "tool": "TLR:0"}
        return parts + [field for name, field in rare.items() if name in changed]
