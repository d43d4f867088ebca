"""What goes wrong between a host and a controller: each fault strikes a line once, at a moment or a byte count."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from ctr_nlp.exceptions import OptionError
from ctr_nlp.hardware.emulator.lies import LIES
from ctr_nlp.hardware.emulator.wire import Line

Strike = Callable[[Line, "Fault"], None]
Change = Callable[[bytes, random.Random, "Fault"], list[tuple[float, bytes]]]

THIRD_PARTIES = (
    *(b"~", b"!", b"\x18", b"\x19", b"\x85", 5 * b"\x91", 5 * b"\x92", b"\x97"),
    *(b"$J=G91 X-1 F600\n", b"$1=25\n", b"$110=300\n", b"G94 G1 X-1 F600\n", b"G4 P0.3\n", b"G999\n"),
)
"""What pendants and other clients have been seen to send; one is drawn where a fault names none."""


@dataclass(frozen=True)
class Fault:
    """A fault that strikes once either moment has come.

    name: its entry in FAULTS. at: s since the firmware was switched on. after_bytes: sent by the host on this
    connection. seconds: how long it lasts or delays, inf for good. seed: of what is drawn at random.
    choice: what varies from kind to kind; see FAULTS. data: what is sent or said, drawn where it is empty.
    """

    name: str
    strike_line: Strike
    at: float = math.inf
    after_bytes: float = math.inf
    seconds: float = math.inf
    seed: int = 0
    choice: float = 0.3
    data: bytes = b""

    def due(self, time: float, sent_bytes: int) -> bool:
        """Whether its moment has come."""
        return time >= self.at or sent_bytes >= self.after_bytes

    def strike(self, line: Line) -> None:
        """Do what it does to a line or the firmware at its end."""
        self.strike_line(line, self)


def _lasting(line: Line, fault: Fault) -> Callable[[], bool]:
    until = line.firmware.time + fault.seconds
    return lambda: line.firmware.time < until


def _cut(line: Line, fault: Fault) -> None:
    line.drop()


def _half_open(line: Line, fault: Fault) -> None:
    lasting = _lasting(line, fault)
    line.outward.append(lambda data: bytes(b for b in data if b == ord("?")) if lasting() else data)


def _silent(line: Line, fault: Fault) -> None:
    line.firmware.silence(fault.seconds)


def _busy(line: Line, fault: Fault) -> None:
    line.firmware.stall(fault.seconds)


def _replies(change: Change, line: Line, fault: Fault) -> None:
    lasting, draw = _lasting(line, fault), random.Random(fault.seed)

    def alter(reply: bytes) -> list[tuple[float, bytes]]:
        if not lasting() or draw.random() >= fault.choice:
            return [(0.0, reply)]
        return change(reply, draw, fault)

    line.inward.append(alter)


def _garbled(reply: bytes, draw: random.Random, fault: Fault) -> list[tuple[float, bytes]]:
    broken = bytearray(reply)
    for _ in range(draw.randint(1, 3)):
        broken[draw.randrange(len(broken))] = draw.randrange(256)
    return [(0.0, bytes(broken))]


def _last_ok(line: Line, fault: Fault) -> None:
    """An ok is dropped where the firmware has nothing left to answer."""

    def alter(reply: bytes) -> list[tuple[float, bytes]]:
        last = reply.strip() == b"ok" and not line.firmware.backlog and not line.outbound
        return [] if last else [(0.0, reply)]

    line.inward.append(alter)


def _outbound(line: Line, fault: Fault) -> None:
    lasting, draw = _lasting(line, fault), random.Random(fault.seed)
    line.outward.append(
        lambda data: bytes(b for b in data if draw.random() >= fault.choice) if lasting() else data
    )


def _third_party(line: Line, fault: Fault) -> None:
    line.firmware.receive(fault.data or random.Random(fault.seed).choice(THIRD_PARTIES))


def _lie(line: Line, fault: Fault) -> None:
    said = fault.data or LIES[fault.name](line.firmware, random.Random(fault.seed)).encode()
    line.insert(said + b"\r\n")


def _flipped(data: bytes, draw: random.Random, share: float) -> bytes:
    """Bytes of which a share has one bit inverted."""
    return bytes(byte ^ (1 << draw.randrange(8)) if draw.random() < share else byte for byte in data)


def _flips_to_host(line: Line, fault: Fault) -> None:
    lasting, draw = _lasting(line, fault), random.Random(fault.seed)
    line.inward.append(lambda reply: [(0.0, _flipped(reply, draw, fault.choice) if lasting() else reply)])


def _flips_to_device(line: Line, fault: Fault) -> None:
    lasting, draw = _lasting(line, fault), random.Random(fault.seed)
    line.outward.append(lambda data: _flipped(data, draw, fault.choice) if lasting() else data)


def _power_cycle_unseen(line: Line, fault: Fault) -> None:
    line.drop()
    line.firmware.reboot(loses_position=True)


def _reboot(line: Line, fault: Fault) -> None:
    line.firmware.reboot(loses_position=bool(fault.choice))


def _refusal(line: Line, fault: Fault) -> None:
    line.firmware.refuse(int(fault.choice))


def _estop(line: Line, fault: Fault) -> None:
    line.firmware.press("estop", alarms=True)


def _lost(reply: bytes, draw: random.Random, fault: Fault) -> list[tuple[float, bytes]]:
    return []


def _doubled(reply: bytes, draw: random.Random, fault: Fault) -> list[tuple[float, bytes]]:
    return [(0.0, reply), (0.0, reply)]


def _late(line: Line, fault: Fault) -> None:
    line.inward.append(lambda reply: [(fault.seconds, reply)])


def _kind(name: str, strike: Strike, **defaults: Any) -> Callable[..., Fault]:
    return lambda **options: Fault(name, strike, **{**defaults, **options})


FAULTS: dict[str, Callable[..., Fault]] = {
    "cut": _kind("cut", _cut),
    "half_open": _kind("half_open", _half_open),
    "silent": _kind("silent", _silent),
    "busy": _kind("busy", _busy, seconds=3.0),
    "garbled": _kind("garbled", partial(_replies, _garbled)),
    "lost": _kind("lost", partial(_replies, _lost)),
    "doubled": _kind("doubled", partial(_replies, _doubled)),
    "late": _kind("late", _late, seconds=0.5),
    "last_ok": _kind("last_ok", _last_ok),
    "bytes_lost": _kind("bytes_lost", _outbound, choice=0.02),
    "banner": _kind("banner", _reboot, choice=1.0),
    "hard_limit": _kind("hard_limit", lambda line, fault: line.firmware.hard_limit()),
    "soft_limit": _kind("soft_limit", lambda line, fault: line.firmware.soft_limit()),
    "error_latch": _kind("error_latch", _refusal, choice=20),
    "estop": _kind("estop", _estop),
    "power_cycle": _kind("power_cycle", lambda line, fault: line.firmware.reboot(loses_position=True)),
    "power_cycle_unseen": _kind("power_cycle_unseen", _power_cycle_unseen),
    "third_party": _kind("third_party", _third_party),
    **{name: _kind(name, _lie) for name in LIES},
    "flips_to_host": _kind("flips_to_host", _flips_to_host, choice=0.01),
    "flips_to_device": _kind("flips_to_device", _flips_to_device, choice=0.01),
}
"""Name -> constructor, whose keywords are the fields of Fault.

The link. cut: the host's next read or write raises. half_open: `?` is answered, lines are not. silent: the
controller goes on but says nothing more, reconnects included. garbled, lost, doubled: a share `choice` of the
reply lines. late: every reply by `seconds`. last_ok: the ok after which nothing is left to answer is lost.
bytes_lost: a share `choice` of the host's bytes. flips_to_host, flips_to_device: a share `choice` of the bytes
that go there have one bit flipped.

The controller. busy: for `seconds` it neither moves, reads nor replies. banner: it restarts, without its
position where `choice` is 1 and with it where it is 0. power_cycle: it is switched off and on, its position
counts begin at zero while the mechanics stay where they are, and the banner is sent. power_cycle_unseen: the
same while the link is cut, so that nobody sees the banner. hard_limit, soft_limit: ALARM:1, ALARM:2.
error_latch: one line is refused with error number `choice`, and so is G-code after it until a blank line.
estop: ALARM:10, motion stops dead.

Others. third_party: a pendant or another client sends `data`, and the replies go to our host.

Text that lies, a line put between the controller's own although nothing of the kind has happened; `data` says
it word for word. false_alarm, false_banner, false_ok, false_error: of that kind. false_past, false_future: a
status report, idle where an earlier line ended or where the plan will end. false_state: a report with another
state. noise: printable characters without sense.
"""


def fault(name: str, **options: Any) -> Fault:
    """The fault of that name; raises OptionError for a name that there is not."""
    if name not in FAULTS:
        raise OptionError(f"no fault {name!r}; there are {', '.join(FAULTS)}")
    return FAULTS[name](**options)
