"""The program behind scripts/play.py."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.cli.console import (
    BAD_INPUT,
    INTERRUPTED,
    SOLVED,
    SOME_FAILED,
    console,
    guarded,
    print_table,
    progress_bar,
)
from ctr_nlp.cli.output import MARK, check_folder
from ctr_nlp.cli.report import write_table
from ctr_nlp.errors import DeviceFault
from ctr_nlp.executor.checks import Checked
from ctr_nlp.executor.clock import RealClock
from ctr_nlp.executor.devices import Progress
from ctr_nlp.executor.devices.opening import device_of
from ctr_nlp.executor.devices.ur import arm_follower
from ctr_nlp.executor.hardware import Hardware, bench
from ctr_nlp.executor.journal import Journal, read_journal
from ctr_nlp.executor.player import Player
from ctr_nlp.executor.program import Program
from ctr_nlp.executor.record import Recorder, Tracking
from ctr_nlp.executor.results import Outcome, Result
from ctr_nlp.executor.session import begin, prepared, resume
from ctr_nlp.figures import save, tracking
from ctr_nlp.plan import Plan
from ctr_nlp.steer.interrupt import deferred_interrupt

JOURNAL = "journal.jsonl"

WISHES = {"p": "pause", "r": "resume", "a": "abort"}


def main(argv: list[str] | None = None) -> int:
    """Check a plan for some hardware and play it there."""
    return guarded(lambda: _run(_parser().parse_args(argv)))


def _parser() -> argparse.ArgumentParser:
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
        "--tempo", metavar="X", type=float, default=1.0, help="part of the plan's own pace, in (0, 1] (default 1)"
    )
    parser.add_argument("--home", action="store_true", help="run the controller's homing cycle before")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on where the last session in the journal ended, if the robot is there",
    )
    parser.add_argument(
        "--position-verified",
        action="store_true",
        help="with --resume: you have made sure that the axes stand where the controller says",
    )
    parser.add_argument(
        "--out", metavar="DIR", help=f"where {JOURNAL}, tracking.csv and tracking.png go (default: PLAN-play)"
    )
    return parser


def _run(arguments: argparse.Namespace) -> int:
    plan = Plan.load(arguments.plan)
    hardware = bench(plan.robot) if arguments.hardware is None else Hardware.from_toml(arguments.hardware)
    if arguments.dry_run:
        program, found = prepared(plan, hardware, arguments.tempo)
        _print_program(plan, program, found)
        return SOLVED
    out = Path(arguments.out or Path(arguments.plan).with_suffix("").as_posix() + "-play")
    records = read_journal(out / JOURNAL) if arguments.resume else None
    _claim(out)
    clock = RealClock()
    journal = Journal(out / JOURNAL, clock)
    arm = None if hardware.arm is None else arm_follower(hardware.arm, _tilt(plan, records), clock.now)
    device = device_of(hardware, journal, clock, _stood(hardware, records))
    player, recorder = Player(device, arm, journal, clock), Recorder()
    with deferred_interrupt() as interrupted, progress_bar() as labelled, _signals(player):
        seen = _seen(player, recorder, interrupted, labelled(plan.meta["problem"]["name"]))
        try:
            result = (
                begin(player, plan, hardware, arguments.tempo, home=arguments.home, seen=seen)
                if records is None
                else resume(player, plan, hardware, records, verified=arguments.position_verified, seen=seen)
            )
        except DeviceFault as error:
            result = Result(Outcome.DEVICE_FAULT, str(error), 0, None, False)
        finally:
            player.close()
            journal.close()
        stopped = interrupted()
    _report(plan, hardware, result, recorder.tracking(), out)
    if result.outcome is Outcome.SUCCESS:
        return SOLVED
    if result.outcome is Outcome.INVALID_PLAN:
        return BAD_INPUT
    return INTERRUPTED if stopped else SOME_FAILED


def _claim(out: Path) -> None:
    """Make out a folder of ours; raises OutputError. What is in it stays: a journal is added to."""
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / MARK).touch()


def _stood(hardware: Hardware, records: list[dict[str, Any]] | None) -> Any:
    """Where the axes of a simulated device stand: at their zeros, or where the journal saw them last."""
    seen = [record["position"] for record in records or () if record.get("position") is not None]
    return seen[-1] if seen else [axis.zero for axis in hardware.axes]


def _tilt(plan: Plan, records: list[dict[str, Any]] | None) -> Any:
    """Where a simulated arm stands: upright, or at the last frame that the journal tells of."""
    frames = [record["frame"] for record in records or () if record["kind"] == "frame"]
    return plan.theta[frames[-1] - 1] if frames else np.zeros(2)


class _signals:
    """What is typed, and signals that end programs, become wishes of the player's."""

    def __init__(self, player: Player) -> None:
        self._player = player
        self._before: dict[int, Any] = {}

    def __enter__(self) -> None:
        threading.Thread(target=self._listen, daemon=True).start()
        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                number = getattr(signal, name)
                self._before[number] = signal.signal(number, lambda *_: self._player.abort())

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _listen(self) -> None:
        for line in sys.stdin:
            wish = WISHES.get(line.strip().lower()[:1])
            if wish is not None:
                getattr(self._player, wish)()


def _seen(
    player: Player, recorder: Recorder, interrupted: Callable[[], bool], report: Callable[[int, int, str], None]
) -> Callable[[Program, Progress], None]:
    """Record, show progress, and turn Ctrl-C into an abort."""
    asked = False

    def seen(program: Program, progress: Progress) -> None:
        nonlocal asked
        recorder(program, progress)
        passed = program.frames[program.frame_time <= progress.time]
        report(int(passed[-1]) if len(passed) else 0, int(program.frames[-1]), player.state.value)
        if interrupted() and not asked:
            asked = True
            player.abort()

    return seen


def _print_program(plan: Plan, program: Program, found: Checked) -> None:
    print_table(
        f"{plan.meta['problem']['name']}: checked, nothing was sent",
        ("", "value", "unit"),
        [
            ("frames", len(program.frames), ""),
            ("duration, and of this later than planned", f"{program.duration:.2f} / {found.late:.2f}", "s"),
            ("largest part of speeds, accelerations", f"{found.speed:.2f} / {found.acceleration:.2f}", ""),
            ("least stability margin on the way", None if np.isnan(found.margin) else found.margin, ""),
        ],
    )


def _report(plan: Plan, hardware: Hardware, result: Result, seen: Tracking | None, out: Path) -> None:
    """How it went, on the terminal and, where enough was seen, as a table and a picture."""
    rows: list[tuple[str, Any, str]] = [("result", result.outcome.value, "")]
    if seen is not None and len(seen.frame):
        names = [f"{axis.letter} ({axis.unit})" for axis in hardware.axes]
        write_table(out / "tracking.csv", _columns(seen, names))
        title = f"Tracking: {plan.meta['problem']['name']}, {hardware.connection.device} device"
        save(tracking(title, seen.frame, seen.error, seen.late, names), out / "tracking.png")
        for unit in dict.fromkeys(axis.unit for axis in hardware.axes):
            some = [k for k, axis in enumerate(hardware.axes) if axis.unit == unit]
            rows.append(("largest error at frames' times", float(abs(seen.error[:, some]).max()), unit))
        rows.append(("frames due within, took", f"{seen.time[-1]:.2f} / {seen.time[-1] + seen.late[-1]:.2f}", "s"))
    rows.append(("last frame passed, of", f"{result.frame} / {len(plan.time)}", ""))
    where = "trusted" if result.trusted else "not to be trusted: home, or look, before it is used"
    rows.append(("position of the axes", where, ""))
    print_table(
        f"{plan.meta['problem']['name']} on the {hardware.connection.device} device", ("", "value", "unit"), rows
    )
    console().print(result.message)
    console().print(f"wrote {out}: {', '.join(sorted(p.name for p in out.iterdir() if p.name[0] != '.'))}")


def _columns(seen: Tracking, names: list[str]) -> dict[str, list[Any]]:
    columns: dict[str, list[Any]] = {
        "frame": seen.frame.tolist(),
        "time_s": seen.time.tolist(),
        "late_s": seen.late.tolist(),
    }
    for k, name in enumerate(names):
        columns[f"commanded {name}"] = seen.commanded[:, k].tolist()
        columns[f"measured {name}"] = seen.measured[:, k].tolist()
    return columns
