"""Questions to a Grbl controller and its answers: identity, settings, status.

Protocol of Grbl and grblHAL, line by line: github.com/gnea/grbl/wiki/Grbl-v1.1-Interface. The bytes `?`, `!`, `~`,
0x18 and 0x85 are real-time commands: the controller takes them out of the stream as they arrive, also within a
line.
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
"""Number of reports of which at least one contains the overrides."""

QUIET = 0.15
"""s without a reply after which nothing else is under way."""

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
"""ASCII, since noise may contain other digits, such as ¹, which int does not read."""


class Reply(NamedTuple):
    """A line from the controller.

    kind: ok, error, alarm, banner, message, setting, report or unreadable. number: of an error or alarm.
    """

    kind: str
    text: str
    number: int = 0


@dataclass(frozen=True)
class Report:
    """A status report.

    position (m,): MPos, in the order of the controller's axes, mm and deg. state: Idle, Run, Hold, Jog, Alarm,
    Home, Check, ...; stopped: whether a Hold has come to rest. line: number of the line that is being played, 0
    where it is not reported. free: empty blocks of the planner; feed: the speed at which the last prepared steps
    end, in the controller's units; override: of the feed, in %; None where it is not reported, as for many reports
    after one that contains it.
    """

    state: str
    stopped: bool
    position: Array
    line: int
    free: int | None
    feed: float | None
    override: float | None


def reply_of(text: str) -> Reply:
    """Classify a line from the controller; text: without its end."""
    for kind, pattern in _PATTERNS:
        found = pattern.fullmatch(text)
        if found:
            return Reply(kind, text, int(found[1]) if kind in ("error", "alarm") else 0)
    return Reply("unreadable", text)


def report_of(text: str, axes: int) -> Report | None:
    """Parse a status report; None where it is damaged.

    text: the line. axes: number of the controller's axes.
    """
    found = REPORT.fullmatch(text)
    if not found:
        return None
    fields = dict(field.partition(":")[::2] for field in found["fields"].split("|"))
    place = fields.get("MPos", "")
    line = fields.get("Ln", "0")
    # Bf: free planner blocks, free bytes of the receive buffer. FS: feed, spindle speed. Ov: overrides of feed,
    # rapids, spindle. Only the first number of each is needed.
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
    """Return False: no stop is requested."""
    return False


class Talk:
    """Lines to and from a controller: replies as they come, and answers that are waited for."""

    def __init__(self, link: ByteLink, clock: Clock) -> None:
        self.link = link
        self._clock = clock
        self._rest = b""
        self.axes = 6
        self.lost = ""
        """Text with which the controller last restarted or stopped by itself, losing its lines; "" for none."""

    def replies(self) -> Iterator[Reply]:
        """Yield every complete line that has come, without waiting."""
        self._rest += self.link.read()
        while b"\n" in self._rest:  # what is not asked for stays for the next time
            line, _, self._rest = self._rest.partition(b"\n")
            reply = reply_of(line.rstrip(b"\r").decode("latin-1"))
            if reply.kind in ("alarm", "banner"):
                self.lost = reply.text
            yield reply

    def wait_for_replies(self, seconds: float, stop: Asked = never) -> Iterator[Reply]:
        """Yield the replies of so many seconds, or until stop returns True."""
        end = self._clock.now() + seconds
        while self._clock.now() < end and not stop():
            yield from self.replies()
            self._clock.sleep(LINK_POLL_PERIOD_S)

    def replies_until(self, kind: str, seconds: float) -> list[Reply]:
        """Return the replies up to the first of a kind, at most those of so many seconds."""
        heard: list[Reply] = []
        for reply in self.wait_for_replies(seconds):
            heard.append(reply)
            if reply.kind == kind:
                break
        return heard

    def request_report(self, seconds: float) -> Report | None:
        """Ask for a status report; None where no readable one comes within so many seconds."""
        self.link.write(GRBL_STATUS_QUERY)
        reports = (
            report_of(reply.text, self.axes) for reply in self.wait_for_replies(seconds) if reply.kind == "report"
        )
        return next((report for report in reports if report is not None), None)

    def ask(self, line: str, seconds: float = ANSWER, stop: Asked = never) -> list[str]:
        """Send a line, wait for its ok and return the replies before that.

        line: without its end; an empty one ends an error's latch, and errors of lines before it are none of its
        own. seconds: to wait. stop: called meanwhile. Raises DeviceFault, also where stop returns True.
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
        """Return the status of a controller just connected, and the text with which it restarted, "" for none.

        stop: called meanwhile; where it returns True, DeviceFault is raised. Many boards restart when a port is
        opened.
        """
        report = self.report(GREETING, greeting=True, stop=stop)
        self.quiet()
        return report, self.take_restart_message()

    def take_restart_message(self) -> str:
        """Return and clear the text with which the controller last restarted or stopped by itself."""
        said = self.lost
        self.lost = ""
        return said

    def check(self) -> None:
        """Raise DeviceFault where the controller restarted or stopped by itself."""
        if self.lost:
            raise DeviceFault(f"the controller said {self.lost!r}: its position is not to be trusted")

    def report(self, seconds: float = ANSWER, greeting: bool = False, stop: Asked = never) -> Report:
        """Ask for the status until it comes.

        seconds: to wait. greeting: whether the controller may restart meanwhile. stop: called meanwhile. Raises
        DeviceFault, also where stop returns True.
        """
        end = self._clock.now() + seconds
        while self._clock.now() < end and not stop():
            # Asked again and again: a controller that restarts drops what it received before.
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
            raise DeviceFault("a stop was asked for while the controller was to report its status")
        raise DeviceFault(f"the controller sends no status within {seconds:g} s")

    def round_trip(self) -> float:
        """Return the median of five times from a status question to its answer, s; raises DeviceFault."""
        taken = []
        for _ in range(5):
            asked = self._clock.now()
            self.report()
            taken.append(self._clock.now() - asked)
        return float(statistics.median(taken))

    def override(self) -> float:
        """Return the feed override in %, which only some reports contain; raises DeviceFault."""
        for _ in range(RARELY):
            override = self.report().override
            if override is not None:
                return override
        raise DeviceFault("the controller does not report its feed override: set $10=511")

    def offsets(self) -> dict[str, tuple[float, ...]]:
        """Return offsets between G-code and machine, and what is homed, by name ($#); raises DeviceFault."""
        pairs = [text.strip("[]").partition(":") for text in self.ask("$#") if text.startswith("[")]
        try:
            return {name: tuple(float(x) for x in re.split("[,:]", values)) for name, _, values in pairs}
        except ValueError as exception:
            raise DeviceFault(f"the controller's offsets cannot be read: {pairs}") from exception

    def quiet(self) -> None:
        """Discard replies that are still under way, such as the second ok of a status question before a line."""
        end = self._clock.now() + ANSWER
        last = self._clock.now()
        while self._clock.now() < min(end, last + QUIET):
            if list(self.replies()):
                last = self._clock.now()
            self._clock.sleep(LINK_POLL_PERIOD_S)

    def identify(self, stop: Asked = never) -> Identity:
        """Check that lines are answered, and read identity and settings; raises DeviceFault.

        stop: called meanwhile; where it returns True, DeviceFault is raised. A link that is open at one end only
        may pass status on, but no lines. The part of a line that was sent when another link broke is dropped
        first, lest the end of ours make a command of it.
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
            raise DeviceFault(f"the controller is no grblHAL that can be used: it reports {told}") from exception
