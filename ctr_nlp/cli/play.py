"""The program behind scripts/play.py."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.cli import live
from ctr_nlp.cli.arguments import add_live_option
from ctr_nlp.cli.console import (
    BAD_INPUT,
    INTERRUPTED,
    SOLVED,
    SOME_FAILED,
    guarded,
    progress_bar,
)
from ctr_nlp.cli.names import path_component
from ctr_nlp.cli.output import check_folder, published
from ctr_nlp.cli.output_file import check_file
from ctr_nlp.cli.play_report import JOURNAL, print_program, report
from ctr_nlp.errors import DeviceFault, OptionError
from ctr_nlp.executor.clock import RealClock
from ctr_nlp.executor.devices import Progress
from ctr_nlp.executor.devices.opening import arm_follower, device_of
from ctr_nlp.executor.hardware import Hardware, bench
from ctr_nlp.executor.journal import Journal, read_journal
from ctr_nlp.executor.player import Player, Seen
from ctr_nlp.executor.program import Program
from ctr_nlp.executor.record import Recorder
from ctr_nlp.executor.results import Outcome
from ctr_nlp.executor.session import begin, prepared, resume
from ctr_nlp.plan import Plan
from ctr_nlp.steer.interrupt import deferred_interrupt

WISHES = {"p": "pause", "r": "resume", "a": "abort"}


def main(argv: list[str] | None = None) -> int:
    """Check a plan for some hardware and play it there."""
    return guarded(lambda: _run(_parsed(argv)))


def _parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="play.py",
        description="Check a plan for some hardware, go slowly to its first frame, and play it. While it plays, "
        "lines on standard input are obeyed: p pauses, r resumes, a aborts; Ctrl-C aborts too.",
        epilog="Exit status: 0 played to the end, 1 not, 2 bad input (nothing was sent), 130 interrupted.",
    )
    parser.add_argument("plan", metavar="PLAN.npz")
    parser.add_argument("--hardware", metavar="FILE.toml", help="(default: a simulated bench rig)")
    parser.add_argument("--dry-run", action="store_true", help="check everything; open no device")
    parser.add_argument(
        "--tempo", metavar="X", type=float, help="part of the plan's own pace, in (0, 1] (default 1)"
    )
    parser.add_argument("--home", action="store_true", help="run the controller's homing cycle before")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on where the last session in the journal ended, if the robot is there, at that session's tempo",
    )
    parser.add_argument(
        "--position-verified",
        action="store_true",
        help="with --resume: you have made sure that the axes stand where the controller says",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help=f"where {JOURNAL}, tracking.csv and tracking.png go (default runs/PROBLEM-play)",
    )
    add_live_option(parser, "the robot where its axes are, over where they should be (the tilt as commanded),")
    arguments = parser.parse_args(argv)
    for name in ("home", "tempo", "dry_run"):
        if arguments.resume and getattr(arguments, name) not in (None, False):
            raise OptionError(f"--{name.replace('_', '-')} does not go with --resume")
    if arguments.position_verified and not arguments.resume:
        raise OptionError("--position-verified goes with --resume only")
    if arguments.live and arguments.dry_run:
        raise OptionError("--live does not go with --dry-run, in which nothing moves")
    return arguments


def _run(arguments: argparse.Namespace) -> int:
    plan = Plan.load(arguments.plan)
    hardware = bench(plan.robot) if arguments.hardware is None else Hardware.from_toml(arguments.hardware)
    tempo = 1.0 if arguments.tempo is None else arguments.tempo
    if arguments.dry_run:
        title = f"{plan.meta['problem']['name']}: checked; nothing was sent"
        print_program(title, *prepared(plan, hardware, tempo))
        return SOLVED
    out = Path(arguments.out or f"runs/{path_component(str(plan.meta['problem']['name']))}-play")
    records = read_journal(out / JOURNAL) if arguments.resume else None
    with live.playing(plan) if arguments.live else nullcontext() as told:
        return _played(arguments, plan, hardware, tempo, out, records, told)


def _played(
    arguments: argparse.Namespace,
    plan: Plan,
    hardware: Hardware,
    tempo: float,
    out: Path,
    records: list[dict[str, Any]] | None,
    told: live.Played | None,
) -> int:
    """Play, from the beginning or where records end; told, unless None, of all that is seen."""
    _claim(out)
    clock = RealClock()
    journal = Journal(out / JOURNAL, clock)
    arm = None if hardware.arm is None else arm_follower(hardware.arm, _tilt(plan, records), clock.now)
    device = device_of(hardware, journal, clock, _stood(hardware, records))
    player, recorder = Player(device, arm, journal, clock), Recorder()
    with deferred_interrupt() as interrupted, progress_bar() as labelled, _obeying(player):
        if interrupted():
            player.abort()
        seen = _seen(player, recorder, labelled(plan.meta["problem"]["name"]), told)
        try:
            result = (
                begin(player, plan, hardware, tempo, home=arguments.home, seen=seen)
                if records is None
                else resume(player, plan, hardware, records, verified=arguments.position_verified, seen=seen)
            )
        except DeviceFault as error:
            sys.stderr.write(f"error: {error}\nnothing was played; what was said is in {out / JOURNAL}\n")
            return SOME_FAILED
        finally:
            player.close()
            journal.close()
    if told is not None:
        told.ended(result.outcome.value)
    report(plan, hardware, result, recorder.tracking(), out)
    if result.outcome is Outcome.SUCCESS:
        return SOLVED
    if result.outcome is Outcome.INVALID_PLAN:
        return BAD_INPUT
    return INTERRUPTED if interrupted() else SOME_FAILED


def _claim(out: Path) -> None:
    """Make out a folder of ours; raises OutputError. Its journal is added to; what told of other sessions goes."""
    check_file(out / JOURNAL, '{"t": ')
    check_folder(out, "play")
    with published(out, "play"):
        pass


def _stood(hardware: Hardware, records: list[dict[str, Any]] | None) -> Any:
    """Where the axes of a simulated device stand: at their zeros, or where the journal saw them last."""
    seen = [record["position"] for record in records or () if record.get("position") is not None]
    return seen[-1] if seen else [axis.zero for axis in hardware.axes]


def _tilt(plan: Plan, records: list[dict[str, Any]] | None) -> Any:
    """Where a simulated arm stands: upright, or at the last frame that the journal tells of."""
    frames = [record["frame"] for record in records or () if record["kind"] == "frame"]
    return plan.theta[frames[-1] - 1] if frames else np.zeros(2)


@contextmanager
def _obeying(player: Player) -> Iterator[None]:
    """Within the block what is typed, and signals that end programs, are wishes of the player's."""
    threading.Thread(target=_listen, args=(player,), daemon=True).start()
    signals = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.signal(number, lambda *_: player.abort()) for number in signals}
    remember = signal.getsignal(signal.SIGINT)

    def interrupt(number: int, frame: Any) -> None:
        player.abort()
        if callable(remember):
            remember(number, frame)

    before[signal.SIGINT] = signal.signal(signal.SIGINT, interrupt)
    if hasattr(signal, "SIGTTIN"):  # in the background, reading a terminal must fail and not stop the program
        before[signal.SIGTTIN] = signal.signal(signal.SIGTTIN, signal.SIG_IGN)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _listen(player: Player) -> None:
    """Obey lines of standard input, past its buffer, whose lock would be in the way when the program ends."""
    try:
        while typed := os.read(sys.stdin.fileno(), 1024).decode(errors="replace"):
            for line in typed.splitlines():
                wish = WISHES.get(line.strip().lower()[:1])
                if wish is not None:
                    getattr(player, wish)()
    except (OSError, ValueError, AttributeError):
        return


def _seen(
    player: Player, recorder: Recorder, show: Callable[[int, int, str], None], told: live.Played | None
) -> Seen:
    """Record, and show progress."""

    def seen(program: Program, progress: Progress) -> None:
        recorder(program, progress)
        show(program.passed(progress.time), int(program.frames[-1]), player.state.value)
        if told is not None:
            told(program, progress, player.state.value)

    return seen
