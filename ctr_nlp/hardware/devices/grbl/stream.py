"""One motion, streamed to a Grbl controller: lines a little ahead of it, counted, and watched."""

from __future__ import annotations

from collections import deque

import numpy as np

from ctr_nlp.exceptions import TrajectoryError
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices import Progress, Signs
from ctr_nlp.hardware.devices.grbl.identity import Identity
from ctr_nlp.hardware.devices.grbl.stop import OVERHEARD
from ctr_nlp.hardware.devices.grbl.talk import HOLD, RESUME, STATUS, Reply, Report, Talk, report_of
from ctr_nlp.hardware.motion import lookahead
from ctr_nlp.hardware.motion.gcode import MEANING, MODES, Lines, lines
from ctr_nlp.hardware.motion.lookahead import Commands, FollowedPath, Place
from ctr_nlp.typing import Array

AGAIN = 0.1
"""s after which a status question counts as lost and is asked again."""

FRESH = 0.15
"""s after which a position is too old for giving the controller more: this process may have been suspended."""

SETTLING = 1.0
"""s in which an idle controller that is not quite at the end may still begin with the last line."""

SPARE = 128
"""Bytes of the controller's buffer that are left free, lest a doubled ok makes it run over."""

IN_FLIGHT = 320
"""Bytes that may be under way unacknowledged, once the controller has been given all that it may have at first:
a hold waits behind them, 28 ms at 115200 baud."""


class Stream:
    """Commands that are played from where the controller stands, by counting characters or line by line.

    Never further ahead of the confirmed position than lookahead allows. ok means planned: what has been played is
    told by the line number and position of status reports. Raises TrajectoryError where the link is too slow.
    """

    def __init__(
        self, talk: Talk, identity: Identity, hardware: Hardware, clock: Clock, commands: Commands
    ) -> None:
        self._talk, self._identity, self._connection, self._clock = talk, identity, hardware.connection, clock
        self._columns, self._resolution = identity.columns(hardware), identity.resolution(hardware)
        self._slides, self._tolerance = np.array([axis.unit == "mm" for axis in hardware.axes]), hardware.tolerance
        self._seen = Report("Idle", False, talk.report().position, 0, None, None, None)
        start = self._seen.position[self._columns]
        self._follow_path(start, commands)
        self._place, self._count = Place(0.0, 0.0, 0, 0.0), len(commands.time)
        self._lines, self._next = Lines(hardware.letters, start, MEANING), b""
        self._waiting: deque[int] = deque()
        self._sent = self._planned = 0
        self.underruns = 0
        """How often the planner was found empty in a motion that had begun, and had not ended."""
        self._resumed = self._filled = False
        self._said = ""
        texts = lines(hardware.letters, start, commands.positions, commands.time, MEANING)
        self._check_link(identity.acceleration(hardware), sum(len(text) + 1 for text in texts))
        talk.ask(MODES)
        self._hold_sent, self._overrides = 0.0, 100.0
        self._go_on()

    def _follow_path(self, start: Array, commands: Commands) -> None:
        """Commands from a position (m,) on are what is played."""
        self._path = FollowedPath(start, commands, self._tolerance)
        self._window = lookahead.Window(self._path.ends, self._path.points, self._slides)

    @property
    def given(self) -> float:
        """To the end of the last line that is sent, or is about to be."""
        return float(self._path.ends[min(self._sent + bool(self._next), self._count)])

    def amend(self, commands: Commands) -> None:
        """Play other commands from there on."""
        self._follow_path(self._path.points[0], commands)

    def _go_on(self) -> None:
        """From now on the axes may move, and no faster than the clock."""
        self._holding = self._held = False
        now = self._clock.now()
        self._stamp = self._asked = self._moved = self._fed = now
        self._schedule = now - self._place.time
        self._answered = True

    @property
    def in_flight(self) -> int:
        """Bytes of lines that have not been acknowledged."""
        return sum(self._waiting)

    def _check_link(self, acceleration: Array, size: int) -> None:
        """Raise TrajectoryError where the link, as measured, cannot keep so many bytes of motion supplied."""
        seconds = np.diff(self._path.ends)
        link = lookahead.LinkTiming(self._talk.round_trip(), self._connection.baud / 10.0)
        speed = abs(np.diff(self._path.points, axis=0) / seconds[:, None]).max(axis=0)
        rate = size / float(self._path.ends[-1])
        part = lookahead.sustainable(speed, acceleration, self._slides, link, rate)
        if part < 1.0:
            advice = f"play it at {int(100 * part) / 100:g} of this tempo" if part >= 0.01 else "use another link"
            raise TrajectoryError(
                f"the link answers after {1e3 * link.round_trip:.0f} ms and takes {link.rate:.0f} bytes/s: with "
                f"{lookahead.AHEAD:g} s of motion in the controller's hands, it cannot keep this pace; {advice}"
            )

    def update(self) -> Progress:
        """Take what has come and find out how far it is."""
        for reply in self._talk.replies():
            self._take(reply)
        done = self._planned == self._count and self._seen.state == "Idle" and self._settled()
        state = "done" if done else "held" if self._held else "holding" if self._holding else "running"
        time = float(self._path.ends[-1]) if done else self._place.time
        position = self._seen.position[self._columns]
        return Progress(state, time, position, self._stamp, self._place.away, self._signs())

    def _signs(self) -> Signs:
        idle = self._seen.state == "Idle" and not self._holding and self._planned < self._count
        waiting = self._planned < self._sent or self._sent < self._count
        stalled = self._stamp - max(self._moved, self._fed) if idle and waiting else 0.0
        return Signs(self._said, self._overrides, max(stalled, 0.0), self._cause() if stalled > 0.0 else "")

    def _cause(self) -> str:
        """Why a controller that was sent lines rests: it has played them and an ok was lost, or it lacks some."""
        missing = self._sent - self._planned
        if not missing:
            return ""
        there = abs(self._seen.position[self._columns] - self._path.points[self._sent]) <= self._resolution
        if there.all():
            lost = f"{missing} `ok` {'was' if missing == 1 else 'were'} lost on the way"
            return f"it has played all {self._sent} lines that it was sent, but {lost}"
        return f"of the {self._sent} lines that it was sent, {missing} did not arrive, or were not obeyed"

    def _settled(self) -> bool:
        """Whether an idle controller has done all that was planned: it may not have begun with the last of it.

        At the end of the path two reports that agree will do: one alone may be a lie.
        """
        off = abs(self._seen.position[self._columns] - self._path.points[-1]) / self._resolution
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
            line = f" (line {self._planned + 1} of {self._count})" if reply.kind == "error" else ""
            self._said = self._said or f"the controller says {reply.text!r}{line}"

    def _follow(self, report: Report) -> None:
        """Find where on its path a report shows it."""
        before, self._answered, self._stamp = self._stamp, True, self._clock.now()
        if report.state not in ("Idle", "Run", "Hold"):
            self._said = self._said or f"the controller is in state {report.state} while it should play"
        if report.override is not None:
            self._overrides = report.override
        position = report.position[self._columns]
        if (position != self._seen.position[self._columns]).any():
            self._moved = self._stamp
        empty = report.free is not None and report.free >= self._identity.blocks
        begun = self._place.time > lookahead.AHEAD  # before, the controller is still being given its first lines
        if empty and begun and self._sent < self._count and not self._holding:
            self.underruns += 1
        self._resumed = self._resumed and report.state == "Hold"  # told before the controller went on
        self._seen, self._held = report, report.stopped and not self._resumed
        if report.state == "Hold" and not self._resumed:  # a person at the controller may have asked for it
            self._holding = True
        if self._sent:
            self._locate(report, position, self._stamp - before)

    def _locate(self, report: Report, position: Array, passed: float) -> None:
        """The place on the path of a position that was reported so many s after the one before."""
        ahead = min(report.line + 1, self._sent) if report.line else self._sent
        place = self._path.nearest(position, max(self._place.line - 1, 0), ahead)
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
        """Lines within the window; a player that was suspended between two of them looks before it sends more."""
        room = self._identity.receive - SPARE
        if self._filled:
            room = min(IN_FLIGHT, room)
        if self._connection.flow == "wait":
            room = 1
        done = min(self._place.time, now - self._schedule)  # a report that lies cannot hurry the motion
        open_to = self._window.open_to(done)
        while self._sent < open_to:
            if self._clock.now() - self._stamp > FRESH:
                return
            line = self._next = self._next or self._line()
            if self._waiting and self.in_flight + len(line) > room:
                return
            self._talk.link.write(line)
            self._waiting.append(len(line))
            self._sent, self._fed, self._next = self._sent + 1, now, b""
        self._filled = True

    def _line(self) -> bytes:
        """The line after those sent."""
        n, ends = self._sent, self._path.ends
        text = self._lines.next(self._path.points[n + 1], float(ends[n + 1] - ends[n]), n + 1 == self._count)
        return text.encode("ascii") + b"\n"

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
