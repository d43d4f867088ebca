"""What goes wrong between a host and a controller: each fault strikes a line once, at a moment or a byte count."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from typing import Any

from ctr_nlp.exceptions import OptionError
from emulator.controller.stops import ALARM_ESTOP
from emulator.firmware import Firmware
from emulator.planner import Vector
from emulator.reports import BANNER, Status
from emulator.wire import SerialLine, WireFault

Lie = Callable[[Firmware, random.Random], str]

ALARMS = (1, 2, 3, 10)
ERRORS = (1, 9, 20, 79)
CONTROLLER_STATES = ("Idle", "Run", "Hold:0", "Hold:1", "Jog", "Alarm", "Home", "Check")
PRINTABLE = "".join(chr(code) for code in range(32, 127))

Strike = Callable[[SerialLine, WireFault], None]
Change = Callable[[bytes, random.Random, WireFault], list[tuple[float, bytes]]]

THIRD_PARTIES = (
    *(b"~", b"!", b"\x18", b"\x19", b"\x85", 5 * b"\x91", 5 * b"\x92", b"\x97"),
    *(b"$J=G91 X-1 F600\n", b"$1=25\n", b"$110=300\n", b"G94 G1 X-1 F600\n", b"G4 P0.3\n", b"G999\n"),
)
"""What pendants and other clients have been seen to send; one is drawn where a fault names none."""


def _report(firmware: Firmware, state: str, position: Vector, line: int | None) -> str:
    """A status report without any of the rarer fields."""
    status, speed = Status(until_offset=9, until_overrides=9, changed=frozenset()), firmware.motion.speed * 60
    buffers, overrides = (firmware.motion.free, firmware.lines.free), firmware.motion.overrides
    return status.report(state, position, buffers, line, speed, overrides, (), bool(firmware.homed))


def _past(firmware: Firmware, draw: random.Random) -> str:
    """Idle where a line that is done with ended, or at zero."""
    line, position = draw.choice(firmware.executed_blocks or [(None, (0.0,) * 6)])
    return _report(firmware, "Idle", position, line)


def _future(firmware: Firmware, draw: random.Random) -> str:
    """Idle where all that is planned will end."""
    return _report(firmware, "Idle", firmware.motion.target, firmware.motion.line)


def _wrong_state(firmware: Firmware, draw: random.Random) -> str:
    """Where it is, in a state in which it is not."""
    states = [state for state in CONTROLLER_STATES if not state.startswith(firmware.state)]
    return _report(firmware, draw.choice(states), firmware.motion.position, firmware.motion.line)


def _noise(firmware: Firmware, draw: random.Random) -> str:
    """Printable characters without sense."""
    return "".join(draw.choice(PRINTABLE) for _ in range(draw.randint(1, 40)))


LIES: dict[str, Lie] = {
    "false_alarm": lambda firmware, draw: f"ALARM:{draw.choice(ALARMS)}",
    "false_banner": lambda firmware, draw: BANNER,
    "false_ok": lambda firmware, draw: "ok",
    "false_error": lambda firmware, draw: f"error:{draw.choice(ERRORS)}",
    "false_past": _past,
    "false_future": _future,
    "false_state": _wrong_state,
    "noise": _noise,
}
"""Name of a fault -> the line that is inserted."""


def _lasting(line: SerialLine, fault: WireFault) -> Callable[[], bool]:
    until = line.firmware.time + fault.seconds
    return lambda: line.firmware.time < until


def _outward(
    alter: Callable[[bytes, random.Random, WireFault], bytes], line: SerialLine, fault: WireFault
) -> None:
    """Alter what the host sends."""
    lasting, draw = _lasting(line, fault), random.Random(fault.seed)
    line.outward.append(lambda data: alter(data, draw, fault) if lasting() else data)


def _inward(alter: Change, line: SerialLine, fault: WireFault) -> None:
    """Alter every reply line."""
    lasting, draw = _lasting(line, fault), random.Random(fault.seed)
    line.inward.append(lambda reply: alter(reply, draw, fault) if lasting() else [(0.0, reply)])


def _some(alter: Change) -> Change:
    """A change of a share of the reply lines."""
    return lambda reply, draw, fault: (
        [(0.0, reply)] if draw.random() >= fault.choice else alter(reply, draw, fault)
    )


def _garble_reply(reply: bytes, draw: random.Random, fault: WireFault) -> list[tuple[float, bytes]]:
    broken = bytearray(reply)
    for _ in range(draw.randint(1, 3)):
        broken[draw.randrange(len(broken))] = draw.randrange(256)
    return [(0.0, bytes(broken))]


def _last_ok(line: SerialLine, fault: WireFault) -> None:
    """An ok is dropped where the firmware has nothing left to answer."""

    def alter(reply: bytes) -> list[tuple[float, bytes]]:
        last = reply.strip() == b"ok" and not line.firmware.backlog and not line.outbound
        return [] if last else [(0.0, reply)]

    line.inward.append(alter)


def _lie(line: SerialLine, fault: WireFault) -> None:
    said = fault.data or LIES[fault.name](line.firmware, random.Random(fault.seed)).encode()
    line.insert(said + b"\r\n")


def _flip_bits(data: bytes, draw: random.Random, fault: WireFault) -> bytes:
    """Bytes of which a share has one bit inverted."""
    return bytes(byte ^ (1 << draw.randrange(8)) if draw.random() < fault.choice else byte for byte in data)


def _estop(line: SerialLine, fault: WireFault) -> None:
    """The button with the alarm that it raises on a board; the recorded controller only shows its pin."""
    line.firmware.press("estop")
    line.firmware.alarm(ALARM_ESTOP)


def _power_cycle_unseen(line: SerialLine, fault: WireFault) -> None:
    line.drop()
    line.firmware.reboot(loses_position=True)


_FAULT_KINDS: dict[str, tuple[Strike, dict[str, Any]]] = {
    "cut": (lambda line, fault: line.drop(), {}),
    "half_open": (partial(_outward, lambda data, draw, fault: bytes(b for b in data if b == ord("?"))), {}),
    "silent": (lambda line, fault: line.firmware.silence(fault.seconds), {}),
    "busy": (lambda line, fault: line.firmware.stall(fault.seconds), {"seconds": 3.0}),
    "garbled": (partial(_inward, _some(_garble_reply)), {}),
    "lost": (partial(_inward, _some(lambda reply, draw, fault: [])), {}),
    "doubled": (partial(_inward, _some(lambda reply, draw, fault: 2 * [(0.0, reply)])), {}),
    "late": (lambda line, fault: line.inward.append(lambda reply: [(fault.seconds, reply)]), {"seconds": 0.5}),
    "last_ok": (_last_ok, {}),
    "bytes_lost": (
        partial(_outward, lambda data, draw, fault: bytes(b for b in data if draw.random() >= fault.choice)),
        {"choice": 0.02},
    ),
    "banner": (lambda line, fault: line.firmware.reboot(loses_position=bool(fault.choice)), {"choice": 1.0}),
    "hard_limit": (lambda line, fault: line.firmware.hard_limit(), {}),
    "soft_limit": (lambda line, fault: line.firmware.soft_limit(), {}),
    "error_latch": (lambda line, fault: line.firmware.refuse(int(fault.choice)), {"choice": 20}),
    "estop": (_estop, {}),
    "power_cycle": (lambda line, fault: line.firmware.reboot(loses_position=True), {}),
    "power_cycle_unseen": (_power_cycle_unseen, {}),
    "third_party": (
        lambda line, fault: line.firmware.receive(fault.data or random.Random(fault.seed).choice(THIRD_PARTIES)),
        {},
    ),
    **dict.fromkeys(LIES, (_lie, {})),
    "flips_to_host": (
        partial(_inward, lambda reply, draw, fault: [(0.0, _flip_bits(reply, draw, fault))]),
        {"choice": 0.01},
    ),
    "flips_to_device": (partial(_outward, _flip_bits), {"choice": 0.01}),
}
"""Name -> how it strikes, and the fields that are not as in Fault."""

FAULTS: dict[str, Callable[..., WireFault]] = {
    name: partial(WireFault, name, strike, **fields) for name, (strike, fields) in _FAULT_KINDS.items()
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


def fault(name: str, **options: Any) -> WireFault:
    """The fault of that name; raises OptionError for a name that there is not."""
    if name not in FAULTS:
        raise OptionError(f"no fault is called {name!r}; there are {', '.join(FAULTS)}")
    return FAULTS[name](**options)
