"""Questions and answers with a Grbl controller: who it is, how it is set, where it stands.

What Grbl and grblHAL say, one line at a time: github.com/gnea/grbl/wiki/Grbl-v1.1-Interface.
"""

from __future__ import annotations

import re
import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.devices import Asked
from ctr_nlp.hardware.devices.grbl.identity import Identity
from ctr_nlp.hardware.link import ByteLink
from ctr_nlp.typing import Array

GRBL_STATUS_QUERY, GRBL_HOLD, GRBL_RESUME, GRBL_RESET, GRBL_JOG_CANCEL = b"?", b"!", b"~", b"\x18", b"\x85"

GREETING = 6.0
"""s for a controller that restarts when its port is opened."""

ANSWER = 3.0
"""s within which a line is answered while nothing moves."""

RARELY = 32
"""Reports among which one tells the overrides."""

QUIET = 0.15
"""s without a byte: nothing else is under way."""

LINK_POLL_PERIOD_S = 0.005
"""s between two looks at the link while waiting."""

_PATTERNS = (
    ("ok", re.compile(r"ok")),
    ("error", re.compile(r"error:(\d+)")),
    ("alarm", re.compile(r"ALARM:(\d+)")),
    ("banner", re.compile(r"Grbl(HAL)? \d.*", re.IGNORECASE)),
    ("message", re.compile(r"\[[A-Z0-9. ]+:?.*\]|")),
    ("setting", re.compile(r"\$\d+=.*")),
    ("report", re.compile(r"<[A-Z][a-z]+(:\d+)?\|.*>")),
)

REPORT = re.compile(r"<(?P<state>[A-Z][a-z]+)(:(?P<part>\d+))?\|(?P<fields>[^<>]*)>")
DECIMAL_LIST_PATTERN = re.compile(r"-?\d+\.\d+(,-?\d+\.\d+)*", re.ASCII)
WHOLE_NUMBER_PATTERN = re.compile(r"\d+", re.ASCII)
"""Noise has digits of other kinds, as ¹, which are no numbers."""


class Reply(NamedTuple):
    """kind: ok, error, alarm, banner, message, setting, report or unreadable; number: of an error or alarm."""

    kind: str
    text: str
    number: int = 0


@dataclass(frozen=True)
class Report:
    """A status report. position (m,): MPos, in the order of the controller's axes, mm and deg.

    state: Idle, Run, Hold, Jog, Alarm, Home, Check, ...; stopped: whether a Hold has come to rest. line: number
    of the line that is being played, 0 where that is not told. free: empty blocks of the planner; feed: the speed
    at which the last steps that are prepared end, in the controller's units; override: of the feed, in %; None
    where that is not told, as an override is for many reports after the one that told it.
    """

    state: str
    stopped: bool
    position: Array
    line: int
    free: int | None
    feed: float | None
    override: float | None


def reply_of(text: str) -> Reply:
    """The reply that a line is."""
    for kind, pattern in _PATTERNS:
        found = pattern.fullmatch(text)
        if found:
            return Reply(kind, text, int(found[1]) if kind in ("error", "alarm") else 0)
    return Reply("unreadable", text)


def report_of(text: str, axes: int) -> Report | None:
    """The report that a line of this many axes is, or None where it is damaged."""
    found = REPORT.fullmatch(text)
    if not found:
        return None
    fields = dict(field.partition(":")[::2] for field in found["fields"].split("|"))
    place = fields.get("MPos", "")
    line = fields.get("Ln", "0")
    free, feed, override = (fields.get(name, "").partition(",")[0] for name in ("Bf", "FS", "Ov"))
    if not (
        DECIMAL_LIST_PATTERN.fullmatch(place)
        and place.count(",") == axes - 1
        and WHOLE_NUMBER_PATTERN.fullmatch(line)
    ):
        return None
    return Report(
        found["state"],
        found["state"] == "Hold" and found["part"] == "0",
        np.array([float(value) for value in place.split(",")]),
        int(line),
        int(free) if WHOLE_NUMBER_PATTERN.fullmatch(free) else None,
        float(feed) if WHOLE_NUMBER_PATTERN.fullmatch(feed) or DECIMAL_LIST_PATTERN.fullmatch(feed) else None,
        float(override) if WHOLE_NUMBER_PATTERN.fullmatch(override) else None,
    )


def never() -> bool:
    """No stop is asked for."""
    return False


class Talk:
    """Replies as they come, and answers that are waited for."""

    def __init__(self, link: ByteLink, clock: Clock) -> None:
        self.link = link
        self._clock = clock
        self._rest = b""
        self.axes = 6
        self.lost = ""
        """What it said when it last restarted or stopped by itself: what it was told before is gone."""

    def replies(self) -> Iterator[Reply]:
        """Every whole line that has come."""
        self._rest += self.link.read()
        while b"\n" in self._rest:  # what is not asked for stays for the next time
            line, _, self._rest = self._rest.partition(b"\n")
            reply = reply_of(line.rstrip(b"\r").decode("latin-1"))
            if reply.kind in ("alarm", "banner"):
                self.lost = reply.text
            yield reply

    def wait_for_replies(self, seconds: float, stop: Asked = never) -> Iterator[Reply]:
        """Replies of so many s, or until a stop is asked for."""
        end = self._clock.now() + seconds
        while self._clock.now() < end and not stop():
            yield from self.replies()
            self._clock.sleep(LINK_POLL_PERIOD_S)

    def replies_until(self, kind: str, seconds: float) -> list[Reply]:
        """Replies up to the first of a kind, or of so many s."""
        heard: list[Reply] = []
        for reply in self.wait_for_replies(seconds):
            heard.append(reply)
            if reply.kind == kind:
                break
        return heard

    def request_report(self, seconds: float) -> Report | None:
        """The status report that a question brings, None where none that can be read comes in so many s."""
        self.link.write(GRBL_STATUS_QUERY)
        reports = (
            report_of(reply.text, self.axes) for reply in self.wait_for_replies(seconds) if reply.kind == "report"
        )
        return next((report for report in reports if report is not None), None)

    def ask(self, line: str, seconds: float = ANSWER, stop: Asked = never) -> list[str]:
        """Send a line and wait for its ok; what was said before it. Raises DeviceFault, also where it is stopped.

        An empty line ends an error's latch, and errors of lines before it are none of its own.
        """
        self.link.write(line.encode("ascii") + b"\n")
        said: list[str] = []
        for reply in self.wait_for_replies(seconds, stop):
            if reply.kind == "ok":
                return said
            if reply.kind == "error" and line:
                raise DeviceFault(f"the controller answers {reply.text!r} to {line!r}")
            self.check()
            said.append(reply.text)
        if stop():
            raise DeviceFault(f"a stop was asked for while the controller was to answer {line!r}")
        raise DeviceFault(f"the controller does not answer {line!r} within {seconds:g} s, but for {said}")

    def greet(self, stop: Asked = never) -> tuple[Report, str]:
        """The status of a controller that may restart when its port is opened, and what it said if it did."""
        report = self.report(GREETING, greeting=True, stop=stop)
        self.quiet()
        return report, self.take_restart_message()

    def take_restart_message(self) -> str:
        """What it said when it last restarted or stopped by itself, which does not count from now on."""
        said = self.lost
        self.lost = ""
        return said

    def check(self) -> None:
        """Raise DeviceFault where it restarted or stopped by itself."""
        if self.lost:
            raise DeviceFault(f"the controller said {self.lost!r}: its position is not to be trusted")

    def report(self, seconds: float = ANSWER, greeting: bool = False, stop: Asked = never) -> Report:
        """Its status; greeting: it may restart meanwhile. Raises DeviceFault."""
        end = self._clock.now() + seconds
        while self._clock.now() < end and not stop():
            self.link.write(GRBL_STATUS_QUERY)
            for reply in self.wait_for_replies(0.25, stop):
                if not greeting:
                    self.check()
                if "|WPos:" in reply.text:
                    raise DeviceFault("the controller reports work positions; it must report MPos: set $10=511")
                found = report_of(reply.text, self.axes) if reply.kind == "report" else None
                if found is not None:
                    return found
        if stop():
            raise DeviceFault("a stop was asked for while the controller was to tell its status")
        raise DeviceFault(f"the controller sends no status within {seconds:g} s")

    def round_trip(self) -> float:
        """The median of five times from a status question to its answer, s; raises DeviceFault."""
        taken = []
        for _ in range(5):
            asked = self._clock.now()
            self.report()
            taken.append(self._clock.now() - asked)
        return float(statistics.median(taken))

    def override(self) -> float:
        """By what the feed is scaled, in %, which only some reports tell; raises DeviceFault."""
        for _ in range(RARELY):
            override = self.report().override
            if override is not None:
                return override
        raise DeviceFault("the controller does not tell its feed override: set $10=511")

    def offsets(self) -> dict[str, tuple[float, ...]]:
        """Offsets between G-code and machine, and what has been homed, by name ($#); raises DeviceFault."""
        pairs = [text.strip("[]").partition(":") for text in self.ask("$#") if text.startswith("[")]
        try:
            return {name: tuple(float(x) for x in re.split("[,:]", values)) for name, _, values in pairs}
        except ValueError as exception:
            raise DeviceFault(f"the controller's offsets cannot be read: {pairs}") from exception

    def quiet(self) -> None:
        """Let pass what is still under way, such as the second ok that a status question before a line earns."""
        end = self._clock.now() + ANSWER
        last = self._clock.now()
        while self._clock.now() < min(end, last + QUIET):
            if list(self.replies()):
                last = self._clock.now()
            self._clock.sleep(LINK_POLL_PERIOD_S)

    def identify(self, stop: Asked = never) -> Identity:
        """Make sure that lines are answered, and read who answers; raises DeviceFault.

        A link that is open at one end only may pass status on, but no lines. The part of a line that was sent when
        another link was lost is dropped first, lest the end of ours make a command of it.
        """
        self.link.write(GRBL_JOG_CANCEL)
        self.ask("", stop=stop)
        self.quiet()
        told = dict(
            text.strip("[]").partition(":")[::2] for text in self.ask("$I", stop=stop) if text.startswith("[")
        )
        settings = [text[1:].partition("=") for text in self.ask("$$", stop=stop) if text.startswith("$")]
        settings += [text[1:].partition("=") for text in self.ask("$N", stop=stop) if text.startswith("$N")]
        try:
            count, _, letters = told["AXS"].partition(":")
            _, blocks, receive, *_ = told["OPT"].split(",")
            self.axes = int(count)
            known = {name: value for name, _, value in settings}
            return Identity(letters, int(receive), int(blocks), known, "; ".join(map(":".join, told.items())))
        except (KeyError, ValueError) as exception:
            raise DeviceFault(f"the controller is no grblHAL that can be used: it tells {told}") from exception
