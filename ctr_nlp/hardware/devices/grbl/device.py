"""Steppers behind a Grbl controller: lines a little ahead of the motion, counted, watched and stopped."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import DeviceFault, HardwareError, ProgramError
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices import Asked, Progress, Signs, Standing
from ctr_nlp.hardware.devices.grbl.identity import Identity
from ctr_nlp.hardware.devices.grbl.replies import Reply, Report, report_of
from ctr_nlp.hardware.devices.grbl.settings import check
from ctr_nlp.hardware.devices.grbl.stop import OVERHEARD, stopped
from ctr_nlp.hardware.devices.grbl.talk import GREETING, HOLD, RESET, RESUME, STATUS, Talk, never
from ctr_nlp.hardware.link import Link
from ctr_nlp.hardware.motion import lookahead
from ctr_nlp.hardware.motion.gcode import MEANING, MODES, lines
from ctr_nlp.hardware.motion.program import Commands
from ctr_nlp.hardware.motion.progress import Place, Way

AGAIN = 0.1
"""s after which a status question counts as lost and is asked again."""

FRESH = 0.15
"""s after which a position is too old for giving the controller more: this process may have been suspended."""

SETTLING = 1.0
"""s in which an idle controller that is not quite at the end may still begin with the last line."""

HOMING = 180.0
"""s for a homing cycle."""

SPARE = 128
"""Bytes of the controller's buffer that are left free, lest a doubled ok makes it run over."""

IN_FLIGHT = 320
"""Bytes that may be on their way unacknowledged, once the controller has been given all that it may have at first:
a hold waits behind them, 28 ms at 115200 baud."""


class Grbl:
    """A grblHAL controller at the end of a link that opened makes.

    Streams by counting characters against the size of the controller's buffer, or line by line (connection.flow),
    and never further ahead of the confirmed position than lookahead allows. ok means planned: what has been played
    is told by the line number and position of status reports.
    """

    def __init__(self, hardware: Hardware, opened: Callable[[], Link], clock: Clock) -> None:
        self._hardware, self._opened, self._clock = hardware, opened, clock
        self._slides = np.array([axis.unit == "mm" for axis in hardware.axes])
        self._link: Link | None = None
        self._known: Identity | None = None
        self._lines: list[bytes] = []
        self._waiting: deque[int] = deque()
        self._holding = self._held = self._homing = False
        self._restarted = ""
        self.underruns = 0
        """How often the planner was found empty in a motion that had begun, and had not ended."""

    def connect(self, stop: Asked = never) -> None:
        """Open the link and make sure of who answers; unless idle, it is asked for no more than its status."""
        self._link = self._opened()
        self._talk = Talk(self._link, self._clock)
        idle = self._talk.report(GREETING, greeting=True, stop=stop).state == "Idle"
        self._talk.quiet()
        self._restarted, self._talk.lost = self._talk.lost, ""
        if idle:
            self._identify(stop)

    def _identify(self, stop: Asked = never) -> None:
        self._known = self._talk.identify(stop)
        self._columns = self._known.columns(self._hardware)
        check(self._known, self._hardware)

    @property
    def identity(self) -> str:
        """Version, options and driver of the controller."""
        return self._asked_who().told

    def _asked_who(self) -> Identity:
        if self._known is None:
            raise DeviceFault("the controller has not been asked who it is: it was not idle when it was connected")
        return self._known

    @property
    def in_flight(self) -> int:
        """Bytes of lines that have not been acknowledged."""
        return sum(self._waiting)

    @property
    def resolution(self) -> npt.NDArray[np.float64]:
        """What the axes (m,) can tell apart: a step, and the last digit of reports."""
        return self._asked_who().resolution(self._hardware)

    def standing(self) -> Standing:
        """Where it stands, which must be at rest and in order."""
        report = self._talk.report()
        if report.state != "Idle":
            raise DeviceFault(f"the controller is {report.state}; it must be Idle before anything is played")
        if self._known is None:
            self._identify()
        offsets = self._talk.offsets()
        for name in ("G54", "G92", "TLO"):
            if any(offsets.get(name, ())):
                raise DeviceFault(
                    f"the controller's {name} is {offsets[name]}; G-code must mean machine positions"
                )
        override = self._talk.override()
        if override != 100:
            raise DeviceFault(f"the feed override is {override:g} %; set it to 100 % at the controller")
        homed = self._hardware.connection.homing == "manual" or self._all_homed(offsets)
        return Standing(report.position[self._columns], homed)

    def _all_homed(self, offsets: dict[str, tuple[float, ...]]) -> bool:
        """Whether all slides have been homed; turning axes have no end to find."""
        *_, mask = offsets.get("HOME", (0.0,))
        return all(int(mask) >> column & 1 for column in np.array(self._columns)[self._slides])

    def home(self, stop: Asked) -> None:
        """Run the controller's homing cycle, which also ends an alarm."""
        if self._hardware.connection.homing != "cycle":
            raise HardwareError("this hardware homes by hand: connection.homing is not cycle")
        if self._talk.report().state == "Alarm":
            self._talk.link.write(RESET)
            self._talk.until("banner", GREETING)
            self._talk.quiet()
            self._talk.lost = ""
        if self._known is None:
            self._identify(stop)
        self._homing = True
        self._talk.ask("$H", HOMING, stop)
        self._homing = False
        self._talk.quiet()

    def start(self, commands: Commands) -> None:
        """Get ready to play commands from where it stands; raises ProgramError where the link is too slow."""
        self._seen = Report("Idle", False, self._talk.report().position, 0, None, None)
        self._way = Way(self._seen.position[self._columns], commands, self._hardware.tolerance)
        self._window = lookahead.Window(self._way.ends, self._way.points, self._slides)
        self._place = Place(0.0, 0.0, 0, 0.0)
        texts = lines(self._hardware.letters, self._way.points[0], commands.positions, commands.time, MEANING)
        self._lines = [text.encode("ascii") + b"\n" for text in texts]
        self._sent = self._planned = self.underruns = 0
        self._waiting.clear()
        self._resumed = self._filled = False
        self._said = self._restarted = ""
        self._check_link(commands)
        self._talk.ask(MODES)
        self._hold_sent, self._overrides = 0.0, 100.0
        self._go_on()

    def _go_on(self) -> None:
        """From now on the axes may move, and no faster than the clock."""
        self._holding = self._held = False
        now = self._clock.now()
        self._stamp = self._asked = self._moved = self._fed = now
        self._schedule = now - self._place.time
        self._answered = True

    def _check_link(self, commands: Commands) -> None:
        """Raise ProgramError where the link, as measured, cannot keep the motion supplied."""
        connection, seconds = self._hardware.connection, np.diff(self._way.ends)
        link = lookahead.LinkTiming(self._talk.round_trip(), connection.baud / 10.0)
        speed = abs(np.diff(self._way.points, axis=0) / seconds[:, None]).max(axis=0)
        rate = float(sum(map(len, self._lines)) / commands.time[-1])
        acceleration = self._asked_who().acceleration(self._hardware)
        part = lookahead.sustainable(speed, acceleration, self._slides, link, rate)
        if part < 1.0:
            advice = f"play it at {int(100 * part) / 100:g} of this tempo" if part >= 0.01 else "use another link"
            raise ProgramError(
                f"the link answers after {1e3 * link.round_trip:.0f} ms and takes {link.rate:.0f} bytes/s: with "
                f"{lookahead.AHEAD:g} s of motion in the controller's hands, it cannot keep this pace; {advice}"
            )

    def update(self) -> Progress:
        """Take what has come and find out how far it is."""
        for reply in self._talk.replies():
            self._take(reply)
        done = self._planned == len(self._lines) and self._seen.state == "Idle" and self._settled()
        state = "done" if done else "held" if self._held else "holding" if self._holding else "running"
        time, _, line, away = self._place
        if done:
            time, line = float(self._way.ends[-1]), len(self._lines)
        position = self._seen.position[self._columns]
        return Progress(state, time, line, position, self._stamp, away, self._signs())

    def _signs(self) -> Signs:
        idle = self._seen.state == "Idle" and not self._holding and self._planned < len(self._lines)
        waiting = self._planned < self._sent or self._sent < len(self._lines)
        stalled = self._stamp - max(self._moved, self._fed) if idle and waiting else 0.0
        return Signs(self._said, self._overrides, max(stalled, 0.0))

    def _settled(self) -> bool:
        """Whether an idle controller has done all that was planned: it may not have begun with the last of it.

        At the end of the way two reports that agree will do: one alone may be a lie.
        """
        off = abs(self._seen.position[self._columns] - self._way.points[-1]) / self.resolution
        rest = self._stamp - self._moved
        return rest > (lookahead.POLL / 2 if off.max() <= 1.0 else SETTLING)

    def _take(self, reply: Reply) -> None:
        if reply.kind == "ok":
            if not self._waiting:
                self._said = self._said or "the controller acknowledges more lines than it was sent"
                return
            self._waiting.popleft()
            self._planned, self._moved = self._planned + 1, self._clock.now()
        elif reply.kind == "report":
            report = report_of(reply.text, self._talk.axes)
            if report is None:
                self._said = self._said or f"the controller's report cannot be read: {reply.text!r}"
            else:
                self._follow(report)
        elif reply.kind != "message":
            line = f" (line {self._planned + 1} of {len(self._lines)})" if reply.kind == "error" else ""
            self._said = self._said or f"the controller says {reply.text!r}{line}"

    def _follow(self, report: Report) -> None:
        """Find where on its way a report shows it."""
        before, self._answered, self._stamp = self._stamp, True, self._clock.now()
        if report.state not in ("Idle", "Run", "Hold"):
            self._said = self._said or f"the controller is in state {report.state} while it should play"
        if report.override is not None:
            self._overrides = report.override
        position = report.position[self._columns]
        if (position != self._seen.position[self._columns]).any():
            self._moved = self._stamp
        empty = report.free is not None and self._known is not None and report.free >= self._known.blocks
        begun = self._place.time > lookahead.AHEAD  # before, the controller is still being given its first lines
        if empty and begun and self._sent < len(self._lines) and not self._holding:
            self.underruns += 1
        self._resumed = self._resumed and report.state == "Hold"  # told before the controller went on
        self._seen, self._held = report, report.stopped and not self._resumed
        if report.state == "Hold" and not self._resumed:  # a person at the controller may have asked for it
            self._holding = True
        if self._sent:
            self._locate(report, position, self._stamp - before)

    def _locate(self, report: Report, position: npt.NDArray[np.float64], passed: float) -> None:
        """The place on the way of a position that was reported so many s after the one before."""
        ahead = min(report.line + 1, self._sent) if report.line else self._sent
        place = self._way.nearest(position, max(self._place.line - 1, 0), ahead)
        while_resting = min(place.until, self._place.time + passed)
        time = max(self._place.time, place.time, while_resting)
        self._place = place._replace(time=time, line=max(place.line, self._place.line))

    def feed(self) -> None:
        """Ask for the next report, and send the lines that the controller may have now."""
        now = self._clock.now()
        if self._holding and self._seen.state == "Run" and now - self._hold_sent > OVERHEARD:
            self._say_hold()
        if now - self._asked >= (lookahead.POLL if self._answered else AGAIN):
            self._talk.link.write(STATUS)
            self._asked, self._answered = now, False
        if not self._holding:
            self._send(now)

    def _send(self, now: float) -> None:
        if now - self._stamp > FRESH:
            return
        room = self._asked_who().receive - SPARE
        if self._filled:
            room = min(IN_FLIGHT, room)
        if self._hardware.connection.flow == "wait":
            room = 1
        done = min(self._place.time, now - self._schedule)  # a report that lies cannot hurry the motion
        open_to = self._window.open_to(done)
        while self._sent < open_to:
            line = self._lines[self._sent]
            if self._waiting and self.in_flight + len(line) > room:
                return
            self._talk.link.write(line)
            self._waiting.append(len(line))
            self._sent, self._fed = self._sent + 1, now
        self._filled = True

    def hold(self) -> None:
        """Ask for a feed hold; no line is sent until it is resumed."""
        self._say_hold()
        self._holding, self._held = True, False

    def _say_hold(self) -> None:
        self._talk.link.write(HOLD)
        self._hold_sent = self._clock.now()

    def resume(self) -> None:
        """Go on after a hold."""
        self._talk.link.write(RESUME)
        self._resumed = True
        self._go_on()

    def abort(self) -> Standing:
        """Stop, whatever it does; raises DeviceFault where the position is lost."""
        if self._link is None:
            raise DeviceFault("the link was never opened: nothing could be sent")
        self._lines = []
        homing, self._homing = self._homing, False
        stopped(self._talk, self._clock, homing)
        if self._restarted:
            raise DeviceFault("the controller restarted when it was connected: its position is not to be trusted")
        return self.standing()

    def close(self) -> None:
        """Let go of the link; nothing is sent."""
        if self._link is not None:
            self._link.close()
