"""Seeded faults between player and controller: what is struck, how far the axes go on, and what is said of it.

The controller is emulated and its time is virtual, so that a seed gives the same run anywhere. Between the player
and the controller sits an injector that changes what passes, in either direction, once. From the moment at which
the changed bytes pass (or the host dies) until the axes rest for good, the way of every slide is measured on the
emulated mechanics, which the player does not see.

A fault either is noticed, or leaves no mark: then the plan must have been played to its end all the same, every
axis within its tolerance of the path, and no later than the hardware file allows.

`python tests/wire_faults.py --seeds 500` prints the table by kind.
"""

from __future__ import annotations

import argparse
import random
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from bench import Killed, World, plan_of
from emulator.faults import FAULTS, THIRD_PARTIES
from emulator.firmware import is_realtime
from emulator.wire import SerialLine, VirtualClock

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.motion.lookahead import FollowedPath
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing import session
from ctr_nlp.hardware.playing.results import PlaybackOutcome, Result
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array

MAX_TRAVEL_MM = 12.0
"""How far a slide may travel after a fault."""

MAX_TIME_S = 0.7
"""For how long an axis may move after a fault."""

AFTERWARDS_S = 8.0
"""Time in which all that the controller has in hand runs out."""

DIGITS = b"0123456789"
ALPHABET = b"0123456789.-GXYZABCFN "
"""What a changed byte becomes: what lines are made of."""

Reply = list[tuple[float, bytes]]


@dataclass
class Injector:
    """What strikes one connection once.

    struck_at: s of the firmware's time, None before. note: what was done, for people. held: a line that is to come
    after the next one. frozen: s for which the fault lets the controller do nothing, not even move.
    """

    line: SerialLine
    draw: random.Random
    struck_at: float | None = None
    note: str = ""
    held: bytes = b""
    frozen: float = 0.0

    def strike(self, note: str) -> None:
        """Note that it has happened."""
        if self.struck_at is None:
            self.struck_at = self.line.firmware.time
            self.note = note

    def on_lines(self, change: Callable[[bytes], bytes | None]) -> None:
        """Change one of the next lines that go to the controller; None leaves a line alone and waits for more."""
        left = [self.draw.randrange(3)]

        def alter(data: bytes) -> bytes:
            if self.struck_at is not None and not self.held:
                return data
            out = b""
            for piece in re.findall(rb"[^\n]*\n|[^\n]+", data):
                if self.held and piece.endswith(b"\n"):
                    out, self.held = out + piece + self.held, b""
                elif self.struck_at is None and piece.endswith(b"\n") and len(piece) > 1:
                    left[0] -= 1
                    new = change(piece) if left[0] < 0 else None
                    if new is not None:
                        self.strike(f"{piece!r} -> {new!r}")
                    out += piece if new is None else new
                else:
                    out += piece
            return out

        self.line.outward.append(alter)

    def on_replies(self, change: Callable[[bytes], Reply | None], once: bool = True) -> None:
        """Change one of the next replies, or all from there on; None leaves a reply alone."""
        left = [self.draw.randrange(3)]

        def alter(reply: bytes) -> Reply:
            if once and self.struck_at is not None:
                return [(0.0, reply)]
            if self.struck_at is None:
                left[0] -= 1
                if left[0] >= 0:
                    return [(0.0, reply)]
            new = change(reply)
            if new is None:
                return [(0.0, reply)]
            self.strike(f"{reply!r} -> {new!r}")
            return new

        self.line.inward.append(alter)


def places_in(piece: bytes, among: Callable[[int], bool]) -> list[int]:
    """Places of a line's bytes of which something holds, without its end and realtime characters."""
    return [i for i, byte in enumerate(piece[:-1]) if not is_realtime(byte) and among(byte)]


def at_a_byte(
    draw: random.Random, alter: Callable[[bytes, int], bytes], among: Callable[[int], bool] = lambda _: True
) -> Callable[[bytes], bytes | None]:
    """A change of a line at one of its bytes."""

    def change(piece: bytes) -> bytes | None:
        places = places_in(piece, among)
        return alter(piece, draw.choice(places)) if places else None

    return change


def in_field(
    draw: random.Random, letters: bytes, alter: Callable[[bytes], bytes]
) -> Callable[[bytes], bytes | None]:
    """A change of the number of one of a line's words."""

    def change(piece: bytes) -> bytes | None:
        found = list(re.finditer(rb"[" + letters + rb"](-?[0-9.]+)", piece))
        if not found:
            return None
        word = draw.choice(found)
        return piece[: word.start(1)] + alter(word[1]) + piece[word.end(1) :]

    return change


def lost(piece: bytes, i: int) -> bytes:
    """Without a byte."""
    return piece[:i] + piece[i + 1 :]


def other(draw: random.Random, byte: int, among: bytes) -> bytes:
    """Another byte."""
    return bytes([draw.choice([new for new in among if new != byte])])


def number_changed(draw: random.Random, text: bytes) -> bytes:
    """A number with a digit, its sign or its point lost, or a digit changed."""
    i = draw.randrange(len(text))
    if draw.random() < 0.5 or text[i] not in DIGITS:
        return lost(text, i)
    return text[:i] + other(draw, text[i], DIGITS) + text[i + 1 :]


def shifted(report: bytes, axis: int, by: float) -> Reply | None:
    """A report with an axis elsewhere, None for other replies."""
    found = re.search(rb"MPos:([^|>]*)", report)
    if found is None:
        return None
    values = [float(value) for value in found[1].split(b",")]
    values[axis] += by
    return [(0.0, report.replace(found[1], ",".join(f"{value:.3f}" for value in values).encode()))]


Arm = Callable[[Injector, World], None]
"""Makes ready what is to strike."""


def bytes_lost(inject: Injector, world: World) -> None:
    """Some bytes in a row are lost."""
    count = inject.draw.choice((1, 1, 1, 2, 3, 6))

    def alter(piece: bytes, i: int) -> bytes:
        return piece[:i] + piece[i + count :]

    inject.on_lines(at_a_byte(inject.draw, alter))


def byte_doubled(inject: Injector, world: World) -> None:
    """A byte comes twice."""
    inject.on_lines(at_a_byte(inject.draw, lambda piece, i: piece[: i + 1] + piece[i:]))


def byte_changed(inject: Injector, world: World) -> None:
    """A byte becomes another one of those that lines are made of."""
    draw = inject.draw
    inject.on_lines(at_a_byte(draw, lambda piece, i: piece[:i] + other(draw, piece[i], ALPHABET) + piece[i + 1 :]))


def bit_flipped(inject: Injector, world: World) -> None:
    """A bit is inverted: this also makes characters that act at once."""
    draw = inject.draw
    flip = at_a_byte(
        draw, lambda piece, i: piece[:i] + bytes([piece[i] ^ 1 << draw.randrange(3)]) + piece[i + 1 :]
    )
    inject.on_lines(flip)


def position_changed(inject: Injector, world: World) -> None:
    """A digit, the sign or the point of a position is lost or changed."""
    inject.on_lines(in_field(inject.draw, b"XYZABC", lambda text: number_changed(inject.draw, text)))


def feed_changed(inject: Injector, world: World) -> None:
    """A digit or the point of a feed is lost or changed."""
    inject.on_lines(in_field(inject.draw, b"F", lambda text: number_changed(inject.draw, text)))


def line_lost(inject: Injector, world: World) -> None:
    """A line does not arrive."""
    inject.on_lines(lambda piece: bytes(byte for byte in piece if is_realtime(byte)))


def line_doubled(inject: Injector, world: World) -> None:
    """A line arrives twice."""
    inject.on_lines(lambda piece: 2 * piece)


def lines_exchanged(inject: Injector, world: World) -> None:
    """A line arrives after the one behind it."""

    def change(piece: bytes) -> bytes | None:
        inject.held = piece
        return b""

    inject.on_lines(change)


def ok_lost(inject: Injector, world: World) -> None:
    """An ok is lost."""
    inject.on_replies(lambda reply: [] if reply.strip() == b"ok" else None)


def ok_doubled(inject: Injector, world: World) -> None:
    """An ok comes twice."""
    inject.on_replies(lambda reply: 2 * [(0.0, reply)] if reply.strip() == b"ok" else None)


def report_lost(inject: Injector, world: World) -> None:
    """A report is lost."""
    inject.on_replies(lambda reply: [] if reply.startswith(b"<") else None)


def reply_garbled(inject: Injector, world: World) -> None:
    """One to three bytes of a reply become others."""

    def change(reply: bytes) -> Reply | None:
        broken = bytearray(reply)
        for _ in range(inject.draw.randint(1, 3)):
            i = inject.draw.randrange(max(1, len(broken) - 2))
            broken[i] = inject.draw.randrange(256)
        return None if bytes(broken) == reply else [(0.0, bytes(broken))]

    inject.on_replies(change)


def report_digit_changed(inject: Injector, world: World) -> None:
    """A digit of a report becomes another one, so that it can still be read."""

    def change(reply: bytes) -> Reply | None:
        places = [i for i, byte in enumerate(reply) if byte in DIGITS]
        if not reply.startswith(b"<") or not places:
            return None
        i = inject.draw.choice(places)
        return [(0.0, reply[:i] + other(inject.draw, reply[i], DIGITS) + reply[i + 1 :])]

    inject.on_replies(change)


def replies_late(inject: Injector, world: World) -> None:
    """All replies come late from now on."""
    by = inject.draw.uniform(0.1, 1.0)
    inject.on_replies(lambda reply: [(by, reply)], once=False)


def replies_silent(inject: Injector, world: World) -> None:
    """No reply comes any more; the controller hears everything."""
    inject.on_replies(lambda reply: [], once=False)


def reports_jump(inject: Injector, world: World) -> None:
    """From now on reports are off by some tolerances, as those of a controller that has lost count."""
    axis = inject.draw.randrange(6)
    by = inject.draw.choice((-1, 1)) * 10 ** inject.draw.uniform(-1.0, 1.5) * world.hardware.tolerance[axis]
    inject.on_replies(lambda reply: shifted(reply, axis, by), once=False)


def report_jumps_once(inject: Injector, world: World) -> None:
    """One report is off by some tolerances."""
    axis = inject.draw.randrange(6)
    by = inject.draw.choice((-1, 1)) * 10 ** inject.draw.uniform(-1.0, 1.5) * world.hardware.tolerance[axis]
    inject.on_replies(lambda reply: shifted(reply, axis, by))


def other_console(inject: Injector, world: World) -> None:
    """Another client of the same controller sends something."""
    said = inject.draw.choice(THIRD_PARTIES)
    inject.line.firmware.receive(said)
    inject.strike(repr(said))


def of_emulator(name: str, seconds: tuple[float, float] | None = None) -> Arm:
    """A fault of the emulator's own, that lasts for so many s."""

    def strike(inject: Injector, world: World) -> None:
        options = {} if seconds is None else {"seconds": inject.draw.uniform(*seconds)}
        inject.strike(f"{name} {options}")
        inject.frozen = options.get("seconds", 0.0) if name == "busy" else 0.0
        FAULTS[name](**options).strike(inject.line)

    return strike


def killed(inject: Injector, world: World) -> None:
    """The player is gone."""
    inject.strike("killed")
    world.links[-1].dead = True
    raise Killed


LINK = "|".join(
    (
        "changed on the way",
        "lost on the way",
        "came late",
        "cannot be read",
        "acknowledges more lines",
    )
)
"""What a message says where bytes on the link are to blame, whatever has become of them."""

CHANGED = rf"{LINK}|the controller says 'error:\d+'|did not arrive"
"""Of lines that were changed: the controller may also refuse them."""

JUMPS = "from their path|reported .* from the lines that were sent|ahead of their schedule|has moved by"
"""Of positions that cannot be."""

REALTIME = r"in state|the controller says|feed override|not asked for|not resume"
"""Of characters that act at once, which a flipped bit may make as well as another client."""


class Kind(NamedTuple):
    """How a fault strikes, and what a message must say to name its cause; "" where no player is left to say it."""

    arm: Arm
    cause: str


KINDS: dict[str, Kind] = {
    "bytes lost": Kind(bytes_lost, CHANGED),
    "byte doubled": Kind(byte_doubled, CHANGED),
    "byte changed": Kind(byte_changed, CHANGED),
    "bit flipped": Kind(bit_flipped, f"{CHANGED}|{REALTIME}"),
    "position changed": Kind(position_changed, CHANGED),
    "feed changed": Kind(feed_changed, CHANGED),
    "line lost": Kind(line_lost, "lost on the way"),
    "line doubled": Kind(line_doubled, "acknowledges more lines|changed on the way"),
    "lines exchanged": Kind(lines_exchanged, "changed on the way|acknowledges more lines"),
    "ok lost": Kind(ok_lost, "lost on the way"),
    "ok doubled": Kind(ok_doubled, "acknowledges more lines|changed on the way"),
    "report lost": Kind(report_lost, "lost on the way|came late"),
    "reply garbled": Kind(reply_garbled, LINK),
    "report's digit changed": Kind(report_digit_changed, LINK),
    "replies late": Kind(replies_late, "came late|reported no position"),
    "replies silent": Kind(replies_silent, "reported no position"),
    "reports jump": Kind(reports_jump, JUMPS),
    "one report jumps": Kind(report_jumps_once, JUMPS),
    "other console": Kind(
        other_console, "another client|somebody|the controller says|in state|acknowledges more lines"
    ),
    "killed": Kind(killed, ""),
    "link cut": Kind(of_emulator("cut"), "link"),
    "controller silent": Kind(of_emulator("silent", (0.6, 5.0)), "reported no position"),
    "controller busy": Kind(of_emulator("busy", (0.6, 3.0)), "reported no position"),
    "power fails": Kind(of_emulator("power_cycle"), "the controller says|said"),
}
"""Name -> how it strikes, and the words (a pattern) of which a message must have some."""


class RecordingClock(VirtualClock):
    """A virtual clock that notes where the mechanics are, every ms."""

    def __init__(self) -> None:
        super().__init__()
        self.world: World | None = None
        self.began = np.inf
        self.track: list[tuple[float, tuple[float, ...]]] = []

    def sleep(self, seconds: float) -> None:
        """Let time pass, and note where the axes are."""
        end = self.now() + max(seconds, 0.0)
        while self.now() < end:
            super().sleep(min(0.001, end - self.now()))
            if self.world is not None:
                firmware = self.world.firmware
                self.track.append((firmware.time, tuple(np.add(firmware.motion.position, firmware.slip))))


class Run(NamedTuple):
    """One fault and what followed from it.

    travel: mm of the slide that went furthest after it; time: s until nothing moved any more, without those
    for which the controller itself did nothing. noticed: whether
    the result is other than success. late: s by which the plan's motion took longer than planned. off: largest
    distance of an axis that is trusted from where it is, in tolerances; 0 where nothing is trusted. astray:
    largest distance of an axis from its path, in tolerances, up to the end. wrong: what the message says instead
    of the cause, "" where it names it.
    """

    seed: int
    kind: str
    travel: float
    time: float
    noticed: bool
    late: float
    off: float
    astray: float
    wrong: str
    note: str
    message: str

    @property
    def faults(self) -> list[str]:
        """What is not as it must be."""
        found = []
        if self.noticed and self.travel > MAX_TRAVEL_MM:
            found.append(f"travels {self.travel:.1f} mm")
        if self.noticed and self.time > MAX_TIME_S:
            found.append(f"moves for {self.time:.2f} s")
        if self.off > 1.0:
            found.append(f"trusted {self.off:.2g} tolerances off")
        if not self.noticed and self.astray > 1.0:
            found.append(f"unnoticed, though {self.astray:.2g} tolerances from the path")
        if not self.noticed and self.late > 1.0:
            found.append(f"unnoticed, though {self.late:.2g} s late")
        if self.wrong:
            found.append(f"wrong cause: {self.wrong}")
        return found


def plan(name: str) -> Plan:
    """A slow or a fast motion, its slides as fast as they may be; no two frames alike, and one reversal."""
    t = np.linspace(0.0, 1.0, 20)[:, None]
    out = {"slow": (10, 16, 22), "fast": (20, 40, 70)}[name]
    alpha = np.hstack([0.8 * t, -0.6 * np.sin(2.5 * t), 0.4 * t**2])
    beta = np.hstack([2 + out[0] * t, 4 + out[1] * t, 8 + out[2] * t])
    return plan_of(np.hstack([alpha, beta, np.zeros((20, 2))]), 0.1)


@cache
def known(name: str) -> Plan:
    """The plan of a name, made once."""
    return plan(name)


@contextmanager
def prepared_once() -> Iterator[None]:
    """A trajectory is made and checked once for each plan and place to start from."""
    made: dict[object, Trajectory] = {}
    looked: dict[int, object] = {}
    make, look = session.trajectory_of, session.check_trajectory

    def trajectory_of(
        plan: Plan, hardware: object, tempo: float = 1.0, standing: Array | None = None, share: float = 1.0
    ) -> Trajectory:
        key = id(plan), tempo, None if standing is None else standing.tobytes(), share
        if key not in made:
            made[key] = make(plan, hardware, tempo, standing, share)
        return made[key]

    def checked(trajectory: Trajectory, model: str | None = None) -> object:
        if id(trajectory) not in looked:
            looked[id(trajectory)] = look(trajectory, model)
        return looked[id(trajectory)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "trajectory_of", trajectory_of)
        patch.setattr(session, "check_trajectory", checked)
        yield


def run(seed: int, folder: Path, kind: str = "") -> Run:
    """Play with one fault at a random moment of the plan's motion."""
    draw = random.Random(seed)
    kind = kind or list(KINDS)[seed % len(KINDS)]
    clock = RecordingClock()
    world = World(folder, known(draw.choice(("slow", "fast"))), clock=clock, state=folder / "state")
    world.meet()
    at, injectors = draw.uniform(0.0, 0.8), list[Injector]()

    def seen(trajectory: Trajectory, progress: object) -> None:
        if trajectory.frames[0] == 1:
            clock.began = min(clock.began, world.firmware.time)
        if not injectors and trajectory.frames[0] == 1 and progress.time >= at * trajectory.duration:
            injectors.append(Injector(world.links[-1].wire.line, draw))
            KINDS[kind].arm(injectors[0], world)

    clock.world = world
    try:
        result = world.begin(callback=seen)
    except Killed:
        result = None
    clock.sleep(AFTERWARDS_S)
    return judged(seed, kind, world, clock, injectors[0], result)


def judged(
    seed: int, kind: str, world: World, clock: RecordingClock, inject: Injector, result: Result | None
) -> Run:
    """What followed from a fault."""
    times = np.array([time for time, _ in clock.track])
    track = np.array([position for _, position in clock.track])
    struck = inject.struck_at
    if struck is None:
        return Run(seed, kind, 0.0, 0.0, False, 0.0, 0.0, 0.0, "", "never struck", "")
    after = times >= struck - 1e-9
    steps = abs(np.diff(track[after], axis=0))
    moving = np.flatnonzero(steps.max(axis=1) > 1e-6) if len(steps) else np.array([], dtype=int)
    time = max(0.0, float(times[after][moving[-1] + 1] - struck) - inject.frozen) if len(moving) else 0.0
    travel = float(steps[:, :3].sum(axis=0).max()) if len(steps) else 0.0
    tolerance = world.hardware.tolerance
    off = 0.0
    if result is not None and result.trusted and result.position is not None:
        off = float((abs(result.position - track[-1]) / tolerance).max())
    success = result is not None and result.outcome is PlaybackOutcome.SUCCESS
    if success:
        off = max(
            off,
            float((abs(world.trajectory().positions(world.trajectory().duration) - track[-1]) / tolerance).max()),
        )
    begun = next(time for time, position in clock.track if time >= clock.began)
    late = float(times[after][moving[-1] + 1]) - begun - world.trajectory().duration if len(moving) else 0.0
    path = FollowedPath(world.trajectory().positions(0.0), world.trajectory().commands(), tolerance)
    pieces = len(path.ends) - 1
    astray = max(path.nearest(position, 0, pieces).away for position in track[after][::5])
    message = "" if result is None else result.message
    if result is None:
        wrong = "" if not remembered_as_trusted(world) else "trusted after a kill"
    elif result.outcome is PlaybackOutcome.SUCCESS:
        wrong = ""
    else:
        wrong = "" if re.search(KINDS[kind].cause, message) else message
    return Run(seed, kind, travel, time, not success, late, off, astray, wrong, inject.note, message)


def remembered_as_trusted(world: World) -> bool:
    """Whether a later session would play on this device without a person's word."""
    world.links[-1].dead = False
    player = world.player()
    try:
        player.connect(stop_first=True)
        return not player.doubt
    except DeviceFault:
        return False
    finally:
        player.close()


def chunk(seeds: list[int], kind: str) -> list[Run]:
    """Runs of some seeds, one after the other."""
    with prepared_once(), tempfile.TemporaryDirectory() as folder:
        runs = []
        for seed in seeds:
            place = Path(folder, str(seed))
            place.mkdir()
            runs.append(run(seed, place, kind))
        return runs


def table(runs: list[Run]) -> str:
    """Lines by kind: how many were struck, stopped, and how far and for how long axes then moved."""
    head = ("kind", "runs", "noticed", "mm", "s", "trusted off", "astray", "wrong cause", "at fault")
    rows = [head]
    for kind in [*KINDS, "all"]:
        some = [run for run in runs if kind in (run.kind, "all") and run.note != "never struck"]
        noticed = [run for run in some if run.noticed]
        if some:
            rows.append(
                (
                    kind,
                    str(len(some)),
                    str(len(noticed)),
                    f"{max((run.travel for run in noticed), default=0.0):.1f}",
                    f"{max((run.time for run in noticed), default=0.0):.2f}",
                    str(sum(run.off > 1.0 for run in some)),
                    str(sum(not run.noticed and run.astray > 1.0 for run in some)),
                    str(sum(bool(run.wrong) for run in some)),
                    str(sum(bool(run.faults) for run in some)),
                )
            )
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)


def main() -> int:
    """Run seeds, and print what is wrong and the table; the exit status is 1 where something is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=500)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kind", default="", choices=["", *KINDS])
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    seeds = list(range(options.first, options.first + options.seeds))
    shares = [seeds[i :: options.processes] for i in range(options.processes)]
    with ProcessPoolExecutor(options.processes) as pool:
        runs = [run for share in pool.map(chunk, shares, [options.kind] * len(shares)) for run in share]
    for run in sorted(runs):
        if run.faults or options.verbose:
            print(f"{run.seed} {run.kind}: {'; '.join(run.faults)}\n    {run.note}\n    {run.message}")
    print(table(runs))
    return int(any(run.faults for run in runs))


if __name__ == "__main__":
    sys.exit(main())
