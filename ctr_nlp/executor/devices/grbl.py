"""Steppers behind a Grbl controller: lines ahead of the motion, counted, watched and stopped."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import DeviceFault
from ctr_nlp.executor.clock import Clock
from ctr_nlp.executor.devices import Progress, Standing
from ctr_nlp.executor.devices.grbl_identity import Identity
from ctr_nlp.executor.devices.grbl_replies import Reply, Report, report_of
from ctr_nlp.executor.devices.grbl_talk import GREETING, HOLD, RESET, RESUME, STATUS, Talk
from ctr_nlp.executor.gcode import MODES, lines
from ctr_nlp.executor.hardware import Hardware
from ctr_nlp.executor.link import Link
from ctr_nlp.executor.program import Commands
from ctr_nlp.executor.way import Place, Way

POLL = 0.05
"""s between status questions while it moves."""

STOPPING = 0.02
"""s between them while it stops."""

OVERHEARD = 0.06
"""s in which a controller must react to a hold; else it has not heard it, as happens just after a resume."""

AGAIN = 0.3
"""s after which a status question counts as lost and is asked again."""

SILENCE = 2.0
"""s without a report after which the controller counts as gone."""

STALLED = 1.0
"""s in which nothing moves, nothing is acknowledged, and yet something should."""

HOLD_LIMIT = 2.0
"""s in which a hold must have come to rest before the controller is reset all the same."""

HOMING = 180.0
"""s for a homing cycle."""

SPARE = 128
"""Bytes of the controller's buffer that are left free, lest a doubled ok makes it run over."""

FIRST = 8
"""Lines at the start for which all of the controller's buffer is used, so that it need not wait for more."""

AHEAD = 320
"""Bytes that may be on their way afterwards: a hold waits behind them, 28 ms at 115200 baud."""

RESTART = 3.0
"""s for a restart."""


class Grbl:
    """A grblHAL controller at the end of a link that opened makes.

    Streams by counting characters against the size of the controller's buffer, or line by line (connection.flow).
    ok means planned: what has been played is told by the line number and position of status reports.
    """

    def __init__(self, hardware: Hardware, opened: Callable[[], Link], clock: Clock) -> None:
        self._hardware, self._opened, self._clock = hardware, opened, clock
        self._link: Link | None = None
        self._identity: Identity | None = None
        self._lines: list[bytes] = []
        self._waiting: deque[int] = deque()
        self._holding = self._held = False
        self.underruns = 0

    def connect(self) -> None:
        """Open the link and make sure of who answers; unless idle, it is asked for no more than its status."""
        self._link = self._opened()
        self._talk = Talk(self._link, self._clock)
        idle = self._talk.report(GREETING, greeting=True).state == "Idle"
        self._talk.quiet()
        self._restarted, self._talk.lost = bool(self._talk.lost), ""
        if idle:
            self._identify()

    def _identify(self) -> None:
        self._identity = identity = self._talk.identify()
        self._columns = identity.columns(self._hardware)
        identity.check(self._hardware)

    @property
    def in_flight(self) -> int:
        """Bytes of lines that have not been acknowledged."""
        return sum(self._waiting)

    @property
    def resolution(self) -> npt.NDArray[np.float64]:
        """What the axes (m,) can tell apart: a step, and the last digit of reports."""
        assert self._identity is not None
        return self._identity.resolution(self._hardware)

    def standing(self) -> Standing:
        """Where it stands, which must be at rest and in order."""
        report = self._talk.report()
        if report.state != "Idle":
            raise DeviceFault(f"the controller is {report.state}; it must be Idle before anything is played")
        if self._identity is None:
            self._identify()
        offsets = self._talk.offsets()
        for name in ("G54", "G92", "TLO"):
            if any(offsets.get(name, ())):
                raise DeviceFault(
                    f"the controller's {name} is {offsets[name]}; G-code must mean machine positions"
                )
        homed = self._hardware.connection.homing == "manual" or self._all_homed(offsets)
        return Standing(report.position[self._columns], homed)

    def _all_homed(self, offsets: dict[str, tuple[float, ...]]) -> bool:
        """Whether all slides have been homed; turning axes have no end to find."""
        *_, mask = offsets.get("HOME", (0.0,))
        pairs = zip(self._hardware.axes, self._columns, strict=True)
        return all(int(mask) >> column & 1 for axis, column in pairs if axis.unit == "mm")

    def home(self, stop: Callable[[], bool]) -> None:
        """Run the controller's homing cycle, which also ends an alarm; stop resets the controller in mid-cycle."""
        if self._hardware.connection.homing != "cycle":
            raise DeviceFault("this hardware homes by hand: connection.homing is not cycle")
        if self._talk.report().state == "Alarm":
            self._reset()
        if self._identity is None:
            self._identify()
        self._talk.ask("$H", HOMING, stop)
        self._talk.quiet()

    def start(self, commands: Commands) -> None:
        """Begin to play commands from where it stands."""
        self._seen = Report("Idle", False, self._talk.report().position, 0, None)
        self._way = Way(self._seen.position[self._columns], commands, self._hardware.tolerance)
        self._place = Place(0.0, 0.0, 0, 0.0)
        texts = lines(self._hardware.letters, self._way.points[0], commands.positions, commands.time)
        self._lines = [text.encode("ascii") + b"\n" for text in texts]
        self._sent = self._planned = self.underruns = 0
        self._waiting.clear()
        self._holding = self._held = False
        self._talk.ask(MODES)
        now = self._clock.now()
        self._stamp = self._asked = self._moved = now
        self._answered = True

    def update(self) -> Progress:
        """Take what has come, ask for the next report, and send what there is room for."""
        for reply in self._talk.replies():
            self._take(reply)
        now = self._clock.now()
        done = self._planned == len(self._lines) and self._seen.state == "Idle" and self._settled()
        if not (done or self._held):
            self._ask(now)
            self._send()
            self._watch(now)
        state = "done" if done else "held" if self._held else "holding" if self._holding else "running"
        time, _, line, away = self._place
        if done:
            time, line = float(self._way.ends[-1]), len(self._lines)
        return Progress(state, time, line, self._seen.position[self._columns], self._stamp, away)

    def _settled(self) -> bool:
        """Whether an idle controller has done all that was planned: it may not have begun with the last of it."""
        off = abs(self._seen.position[self._columns] - self._way.points[-1]) / self.resolution
        rest = self._stamp - self._moved
        return rest > (0.0 if off.max() <= 1.0 else STALLED)

    def _take(self, reply: Reply) -> None:
        if reply.kind == "ok":
            if not self._waiting:
                raise DeviceFault("the controller acknowledges more lines than it was sent")
            self._waiting.popleft()
            self._planned, self._moved = self._planned + 1, self._clock.now()
        elif reply.kind == "report":
            report = report_of(reply.text, self._talk.axes)
            if report is None:
                raise DeviceFault(f"the controller's report cannot be read: {reply.text!r}")
            self._follow(report)
        elif reply.kind != "message":
            line = f" (line {self._planned + 1} of {len(self._lines)})" if reply.kind == "error" else ""
            raise DeviceFault(f"the controller says {reply.text!r}{line}")

    def _follow(self, report: Report) -> None:
        """Find where on its way a report shows it."""
        before, self._answered, self._stamp = self._stamp, True, self._clock.now()
        if report.state not in ("Idle", "Run", "Hold"):
            raise DeviceFault(f"the controller is in state {report.state} while it should play")
        position = report.position[self._columns]
        if (position != self._seen.position[self._columns]).any():
            self._moved = self._stamp
        empty = report.free is not None and self._identity is not None and report.free >= self._identity.blocks
        if empty and self._sent < len(self._lines) and self._planned and not self._holding:
            self.underruns += 1
        self._seen, self._held = report, report.stopped
        self._holding = self._holding or report.state == "Hold"  # a person at the controller may have asked for it
        if self._sent:
            ahead = min(report.line + 1, self._sent) if report.line else self._sent
            place = self._way.nearest(position, max(self._place.line - 1, 0), ahead)
            while_resting = min(place.until, self._place.time + self._stamp - before)
            time = max(self._place.time, place.time, while_resting)
            self._place = place._replace(time=time, line=max(place.line, self._place.line))

    def _ask(self, now: float) -> None:
        if self._holding and self._seen.state == "Run" and now - self._hold_sent > OVERHEARD:
            self._say_hold()
        wait = (STOPPING if self._holding else POLL) if self._answered else AGAIN
        if now - self._asked >= wait:
            self._talk.link.write(STATUS)
            self._asked, self._answered = now, False

    def _send(self) -> None:
        if self._holding or self._identity is None:
            return
        room = self._identity.receive - SPARE
        if self._planned >= FIRST:
            room = min(AHEAD, room)
        if self._hardware.connection.flow == "wait":
            room = 1
        while self._sent < len(self._lines):
            line = self._lines[self._sent]
            if self._waiting and self.in_flight + len(line) > room:
                return
            self._talk.link.write(line)
            self._waiting.append(len(line))
            self._sent, self._moved = self._sent + 1, self._clock.now()

    def _watch(self, now: float) -> None:
        if now - self._stamp > SILENCE:
            raise DeviceFault(f"the controller has not reported its status for {SILENCE:g} s")
        if self._seen.state == "Idle" and self._stamp - self._moved > STALLED and not self._holding:
            raise DeviceFault(
                f"the controller is idle, with {self._planned} of {self._sent} lines acknowledged: replies or "
                "lines were lost"
            )

    def hold(self) -> None:
        """Ask for a feed hold; no line is sent until it is resumed, and nothing at all once it is at rest."""
        self._say_hold()
        self._holding, self._held = True, False

    def _say_hold(self) -> None:
        self._talk.link.write(HOLD)
        self._hold_sent = self._clock.now()

    def resume(self) -> None:
        """Go on after a hold."""
        self._talk.link.write(RESUME)
        self._holding = self._held = False
        self._stamp = self._asked = self._moved = self._clock.now()
        self._answered = True

    def abort(self) -> Standing:
        """Hold, wait for rest, then reset, which keeps the position; raises DeviceFault where it is lost."""
        self._lines = []
        if self._restarted:
            raise DeviceFault("the controller restarted when it was connected: its position is not to be trusted")
        self._talk.check()
        rested = self._rested()
        if not (self._reset() and rested):
            raise DeviceFault("the controller was reset in motion: its position is not to be trusted")
        return self.standing()

    def _reset(self) -> bool:
        """Restart the controller's program; whether it did so without an alarm."""
        self._talk.link.write(RESET)
        said = [reply.kind for reply in self._until("banner", RESTART) if reply.kind != "report"]
        if "banner" not in said:
            raise DeviceFault(f"the controller answers a reset with {said}: its position is not to be trusted")
        self._talk.lost = ""
        return "alarm" not in said

    def _rested(self) -> bool:
        """Whether a feed hold has come to rest."""
        end = self._clock.now() + HOLD_LIMIT
        self._say_hold()
        while self._clock.now() < end:
            self._talk.link.write(STATUS)
            for reply in self._until("report", 2 * POLL):
                self._talk.check()
                report = report_of(reply.text, self._talk.axes) if reply.kind == "report" else None
                state = "" if report is None else report.state
                if state == "Alarm":
                    raise DeviceFault("the controller is in alarm: its position is not to be trusted")
                if state == "Idle" or (report is not None and report.stopped):
                    return True
                if state == "Run" and self._clock.now() - self._hold_sent > OVERHEARD:
                    self._say_hold()
        return False

    def _until(self, kind: str, seconds: float) -> list[Reply]:
        """Replies up to one of a kind, or of so many s."""
        found: list[Reply] = []
        for reply in self._talk.waited(seconds):
            found.append(reply)
            if reply.kind == kind:
                break
        return found

    def close(self) -> None:
        """Let go of the link; nothing is sent."""
        if self._link is not None:
            self._link.close()
