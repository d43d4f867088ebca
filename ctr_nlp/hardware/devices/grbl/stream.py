"""Stream of one motion to a Grbl controller: lines sent a little ahead of it, counted and supervised.

Every line is sent twice, so that ledger.py can tell by counting whether it came as it was sent.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.exceptions import TrajectoryError
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices import MotionProgress, Signs
from ctr_nlp.hardware.devices.grbl.identity import Identity
from ctr_nlp.hardware.devices.grbl.ledger import Ledger
from ctr_nlp.hardware.devices.grbl.stop import OVERHEARD
from ctr_nlp.hardware.devices.grbl.talk import (
    GRBL_HOLD,
    GRBL_RESUME,
    GRBL_STATUS_QUERY,
    Reply,
    Report,
    Talk,
    report_of,
)
from ctr_nlp.hardware.motion import lookahead
from ctr_nlp.hardware.motion.gcode import GCODE_DECIMALS, MEANING, MODES, WAITS, GcodeWriter, lines
from ctr_nlp.hardware.motion.lookahead import Commands, FollowedPath, PathPlace
from ctr_nlp.typing import Array

STATUS_QUERY_RETRY_S = 0.1
"""s after which a status question counts as lost and is asked again."""

FRESH = 0.15
"""s after which a position is too old for sending more lines: this process may have been suspended."""

IDLE_SETTLING_TIME_S = 1.0
"""s in which an idle controller that is not quite at the end may still begin with the last line."""

SPARE_BUFFER_BYTES = 128
"""Bytes of the controller's buffer that are left free, lest a doubled ok makes it run over."""

STOPPED = "[MSG:Stop]"
"""Message of a controller that a client has stopped (0x19), and that has dropped what it was to play."""

OFF_LINE = 4.0
"""How far a controller may be reported from the lines that it was sent, in multiples of its axes' resolution.

It counts the steps that it makes, and makes them along these lines, so that one step and rounding is usual. What
is further off was not sent so, or is not so, even where it is little beside the tolerances of the axes.
"""

GRBL_SOFT_LIMIT_ALARM = 2
"""The alarm of a line that leads beyond the soft limits."""

BEFORE_ASKING = (20, 20, 50)
"""Bytes of copies before the question in them, in turns: 1.7 and 4.3 ms at 115200 baud, in which a controller
plans the line before; some need longer for that than others."""

ANSWER_DELAY_MARGINS_S = (0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2)
"""s by which answers may stay later than before the motion: the largest of these that its pace allows is taken.
The least is allowed in any case, since times of single answers vary."""

IN_FLIGHT = 320
"""Bytes that may be under way unacknowledged, once the controller has been given all that it may have at first:
a hold waits behind them, 28 ms at 115200 baud."""


class Stream:
    """Commands that are played from where the controller stands, by counting characters or line by line.

    Never further ahead of the confirmed position than lookahead allows. An ok means that a line is planned; how
    much has been played follows from line number and position in status reports. Raises TrajectoryError where the
    link is too slow.
    """

    def __init__(
        self, talk: Talk, identity: Identity, hardware: Hardware, clock: Clock, commands: Commands
    ) -> None:
        self._talk = talk
        self._identity = identity
        self._connection = hardware.connection
        self._clock = clock
        self._axes = hardware.axes
        self._columns = identity.columns(hardware)
        self._resolution = identity.resolution(hardware)
        self._slides = np.array([axis.unit == "mm" for axis in hardware.axes])
        self._tolerance = hardware.tolerance
        now = talk.report()
        self._seen = Report("Idle", False, now.position, 0, now.free, None, None)
        start = self._seen.position[self._columns]
        self._follow_path(start, commands)
        self._place = PathPlace(0.0, 0.0, 0, 0.0)
        self._count = len(commands.time)
        self._lines = GcodeWriter(hardware.letters, start, MEANING)
        self._next = list[bytes]()
        self._sent = 0
        self.underruns = 0
        """How often the planner was found empty in a motion that had begun, and had not ended."""
        self._resumed = self._filled = False
        self._said = self._astray = ""
        texts = lines(hardware.letters, start, commands.positions, commands.time, MEANING)
        size = sum(len(text) + len(self._lines.copy(text)) + 2 for text in texts)
        link, patience = self._check_link(identity.acceleration(hardware), size)
        talk.ask(MODES)
        blocks = identity.blocks if self._seen.free is None else self._seen.free
        # Rounded as in the text of lines, which is all that the controller knows.
        self._ledger = Ledger(np.round(start, GCODE_DECIMALS), self._resolution, blocks, link, patience)
        self._hold_sent = 0.0
        self._overrides = 100.0
        self._go_on()

    def _follow_path(self, start: Array, commands: Commands) -> None:
        """Set the commands to be played, from a position start (m,) on."""
        self._path = FollowedPath(start, commands, self._tolerance)
        self._window = lookahead.Window(self._path.ends, self._path.points, self._slides)

    @property
    def committed_time(self) -> float:
        """Time of the motion, s, at the end of the last line that is sent, or is about to be."""
        return float(self._path.ends[min(self._sent + bool(self._next), self._count)])

    def amend(self, commands: Commands) -> None:
        """Replace the commands beyond committed_time."""
        self._follow_path(self._path.points[0], commands)

    def _go_on(self) -> None:
        """Note that the axes may move from now on, and not faster than the clock."""
        self._holding = self._held = False
        now = self._clock.now()
        self._stamp = self._asked = self._asked_first = self._moved = self._fed = now
        self._schedule = now - self._place.time
        self._answered = True
        self._ledger.note_resume(now)

    @property
    def in_flight(self) -> int:
        """Bytes of lines that have not been acknowledged."""
        return self._ledger.in_flight

    @property
    def _acknowledged_line(self) -> int:
        """Number of the last line of which all copies were acknowledged."""
        return self._ledger.planned

    def _check_link(self, acceleration: Array, size: int) -> tuple[lookahead.LinkTiming, float]:
        """Return the link as measured, and the s by which it may answer later and still supply the motion.

        acceleration: of the axes (m,), in unit/s^2. size: bytes of the motion. Raises TrajectoryError where the
        link is too slow.
        """
        seconds = np.diff(self._path.ends)
        # A byte takes 10 bits on a serial line: start, 8 data bits, stop.
        link = lookahead.LinkTiming(self._talk.round_trip(), self._connection.baud / 10.0)
        speed = abs(np.diff(self._path.points, axis=0) / seconds[:, None]).max(axis=0)
        rate = size / max(
            float(self._path.ends[-1]), lookahead.MAX_MOTION_IN_HAND_S
        )  # a shorter motion is given at once
        part = lookahead.sustainable(speed, acceleration, self._slides, link, rate)
        if part < 1.0:
            advice = f"play it at {int(100 * part) / 100:g} of this tempo" if part >= 0.01 else "use another link"
            raise TrajectoryError(
                f"the link answers after {1e3 * link.round_trip:.0f} ms and takes {link.rate:.0f} bytes/s: with "
                f"{lookahead.MAX_MOTION_IN_HAND_S:g} s of motion in the controller's hands, it cannot keep "
                f"this pace; {advice}"
            )
        slower = [link._replace(round_trip=link.round_trip + later) for later in ANSWER_DELAY_MARGINS_S]
        kept = [lookahead.sustainable(speed, acceleration, self._slides, each, rate) >= 1.0 for each in slower]
        return link, max(
            later
            for later, keeps in zip(ANSWER_DELAY_MARGINS_S, kept, strict=True)
            if keeps or later == ANSWER_DELAY_MARGINS_S[0]
        )

    def update(self) -> MotionProgress:
        """Read the replies that have come and return the progress."""
        for reply in self._talk.replies():
            self._take(reply)
        done = self._acknowledged_line == self._count and self._seen.state == "Idle" and self._has_settled()
        state = "done" if done else "held" if self._held else "holding" if self._holding else "running"
        time = float(self._path.ends[-1]) if done else self._place.time
        position = self._seen.position[self._columns]
        return MotionProgress(state, time, position, self._stamp, self._place.away, self._signs())

    def _signs(self) -> Signs:
        idle = self._seen.state == "Idle" and not self._holding and self._acknowledged_line < self._count
        waiting = self._acknowledged_line < self._sent or self._sent < self._count
        stalled = self._stamp - max(self._moved, self._fed) if idle and waiting else 0.0
        cause = self._cause() if stalled > 0.0 else ""
        return Signs(self._said, self._overrides, max(stalled, 0.0), cause, self._astray)

    def _cause(self) -> str:
        """Explain why a controller that was sent lines rests: an ok was lost, or some lines were."""
        missing = self._ledger.missing
        if not missing:
            return ""
        there = abs(self._seen.position[self._columns] - self._path.points[self._sent]) <= self._resolution
        if there.all():
            lost = f"{missing} `ok` {'was' if missing == 1 else 'were'} lost on the way"
            return f"it has played all {self._sent} lines that it was sent, but {lost}"
        lines = f"of the {self._sent} lines that it was sent, some did not arrive, or were not obeyed"
        return f"{lines}: {missing} `ok` {'is' if missing == 1 else 'are'} missing"

    def _has_settled(self) -> bool:
        """Return whether an idle controller has finished: it may not have begun with the last lines.

        At the end of the path two reports that agree suffice; a single one may be corrupted.
        """
        off = abs(self._seen.position[self._columns] - self._path.points[-1]) / self._resolution
        rest = self._stamp - self._moved
        return rest > (lookahead.POSITION_POLL_PERIOD_S / 2 if off.max() <= 1.0 else IDLE_SETTLING_TIME_S)

    def _take(self, reply: Reply) -> None:
        if reply.kind == "ok":
            self._moved = self._clock.now()
            self._said = self._said or self._ledger.acknowledge(self._moved)
        elif reply.kind == "report":
            report = report_of(reply.text, self._talk.axes)
            if report is None:
                self._said = self._said or f"the controller's report cannot be read: {reply.text!r}"
            else:
                self._follow(report)
        elif reply.kind != "message" or reply.text == STOPPED:
            self._said = self._said or self._explain_reply(reply)

    def _explain_reply(self, reply: Reply) -> str:
        """Explain a reply that no controller gives to lines as they were sent."""
        if reply.kind == "unreadable":
            return f"a reply of the controller cannot be read, since it was changed on the way: {reply.text!r}"
        says = f"the controller says {reply.text!r}"
        if reply.kind == "error":
            line = min(self._acknowledged_line + 1, self._count)
            return (
                f"{says} (line {line} of {self._count}): a line was changed on the way, or another client sent it"
            )
        if reply.kind == "alarm" and reply.number == GRBL_SOFT_LIMIT_ALARM:
            return f"{says}: a line that was changed on the way, or another client's, leads beyond the soft limits"
        return f"{says}: another client stopped it" if reply.text == STOPPED else says

    def _follow(self, report: Report) -> None:
        """Take a report: state, overrides, position on the path, and whether it agrees with the lines sent."""
        before, self._answered, self._stamp = self._stamp, True, self._clock.now()
        if report.state not in ("Idle", "Run", "Hold"):
            self._said = self._said or f"the controller is in state {report.state} while it should play"
        if report.override is not None:
            self._overrides = report.override
        position = report.position[self._columns]
        if (position != self._seen.position[self._columns]).any():
            self._moved = self._stamp
        empty = report.free is not None and report.free >= self._identity.blocks
        begun = (
            self._place.time > lookahead.MAX_MOTION_IN_HAND_S
        )  # before, the controller is still being given its first lines
        if empty and begun and self._sent < self._count and not self._holding:
            self.underruns += 1
        self._resumed = self._resumed and report.state == "Hold"  # reported before the controller went on
        self._seen = report
        self._held = report.stopped and not self._resumed
        if report.state == "Hold" and not self._resumed:  # a person at the controller may have asked for it
            self._holding = True
            self._ledger.note_hold()
        if self._sent:
            running = report.state == "Run"
            self._said = self._said or self._ledger.contradiction(
                report.line, report.free, running, self._stamp, self._asked_first
            )
            self._locate(report, position, self._stamp - before)

    def _locate(self, report: Report, position: Array, passed: float) -> None:
        """Find the place of a reported position on the path.

        report: the whole of it. position: (m,) in the axes' units. passed: s since the report before.
        """
        # Only among the lines around the reported number: a path may come by the same place twice.
        ahead = min(report.line + 1, self._sent) if report.line else self._sent
        place = self._path.nearest(position, max(self._place.line - 1, 0), ahead)
        # Where the path rests, positions do not tell the time: it goes on with the clock, at most to the end of
        # the rest. Time never goes back, whatever a report says.
        while_resting = min(place.until, self._place.time + passed)
        time = max(self._place.time, place.time, while_resting)
        self._place = place._replace(time=time, line=max(place.line, self._place.line))
        off = self._off_lines(abs(position - self._path.at(place.time)))
        if off and not self._astray:
            self._astray = f"{off}: a line or this report was changed on the way, or the controller has lost count"

    def off_lines(self, position: Array) -> str:
        """Return which axis cannot have come to a position (m,) along the lines sent, "" where all can."""
        place = self._path.nearest(position, max(self._place.line - 1, 0), self._sent)
        return self._off_lines(abs(position - self._path.at(place.time)))

    def _off_lines(self, off: Array) -> str:
        """Return which axis is further from the lines sent than it can be, "" for none; off: distances (m,)."""
        worst = int((off / self._resolution).argmax())
        if off[worst] <= OFF_LINE * self._resolution[worst]:
            return ""
        axis = self._axes[worst]
        far = f"{off[worst]:.3g} {axis.unit} from the lines that were sent"
        return f"axis {axis.letter} ({axis.joint}) is reported {far}"

    def feed(self) -> None:
        """Ask for the next report, and send the lines that the controller may have now."""
        now = self._clock.now()
        if self._holding and self._seen.state == "Run" and now - self._hold_sent > OVERHEARD:
            # A hold that arrives just after a resume is not obeyed: say it again.
            self._say_hold()
        if not self._holding:
            self._send(now)
        # While lines are sent, most questions go with them; once all are, none does.
        poll = (
            lookahead.POSITION_POLL_PERIOD_S if self._sent < self._count else lookahead.POSITION_POLL_PERIOD_S / 2
        )
        if now - self._asked >= (poll if self._answered else STATUS_QUERY_RETRY_S):
            self._talk.link.write(GRBL_STATUS_QUERY)
            self._asked_first = now if self._answered else self._asked_first
            self._asked = now
            self._answered = False

    def _send(self, now: float) -> None:
        """Send the lines within the window; after a suspension of this process, wait for a new report first."""
        room = self._identity.receive - SPARE_BUFFER_BYTES
        if self._filled:
            room = min(IN_FLIGHT, room)
        if self._connection.flow == "wait":
            room = 1
        done = min(self._place.time, now - self._schedule)  # a report that lies cannot hurry the motion
        open_to = self._window.open_to(done)
        while self._sent < open_to:
            if self._clock.now() - self._stamp > FRESH:
                return
            # Kept until there is room: lines are numbered as they are made, and so each is made once.
            copies = self._next = self._next or self._copies()
            if self._ledger.missing and self.in_flight + sum(map(len, copies)) > room:
                return
            self._write(copies, now)
        self._filled = True

    def _write(self, copies: list[bytes], now: float) -> None:
        """Send the copies of the next line, with a status question within the last one, so that a lost ok shows.

        A controller takes questions out of lines as they arrive, and by then it is done with the line before. now:
        s.
        """
        *firsts, last = copies
        ask = self._answered
        if ask:
            self._asked = self._asked_first = now
            self._answered = False
        place = BEFORE_ASKING[self._sent % len(BEFORE_ASKING)]
        self._talk.link.write(b"".join(firsts) + last[:place] + GRBL_STATUS_QUERY * ask + last[place:])
        position = np.round(self._path.points[self._sent + 1], GCODE_DECIMALS) if firsts else None
        seconds = float(self._path.ends[self._sent + 1] - self._path.ends[self._sent])
        self._ledger.write(copies, position, seconds, now)
        self._sent = self._sent + 1
        self._fed = now
        self._next = []

    def _copies(self) -> list[bytes]:
        """Return the next line and its copy; a line that waits alone, since its copy would wait, too."""
        n = self._sent
        ends = self._path.ends
        text = self._lines.next(self._path.points[n + 1], float(ends[n + 1] - ends[n]), n + 1 == self._count)
        texts = [text] if WAITS in text else [text, self._lines.copy(text)]
        return [each.encode("ascii") + b"\n" for each in texts]

    def hold(self) -> None:
        """Ask for a feed hold; no line is sent until it is resumed."""
        self._say_hold()
        self._holding = True
        self._held = False
        self._ledger.note_hold()

    def _say_hold(self) -> None:
        self._talk.link.write(GRBL_HOLD)
        self._hold_sent = self._clock.now()

    def resume(self) -> None:
        """Continue after a hold."""
        self._talk.link.write(GRBL_RESUME)
        self._resumed = True
        self._go_on()
