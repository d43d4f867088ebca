"""Options and output of closed loops: sensors, messages to the operator, estimates, replay of the journal."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from ctr_nlp.cli.console import EXIT_SOLVED, EXIT_SOME_FAILED
from ctr_nlp.cli.terminal_output import console, print_stderr, print_table
from ctr_nlp.exceptions import OptionError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.guiding.loop import ClosedLoop, final_estimate, initial_estimate
from ctr_nlp.hardware.guiding.replay import replay_session
from ctr_nlp.hardware.sensing.description import URLS, Sensing
from ctr_nlp.hardware.sensing.simulated import SimulatedRobot
from ctr_nlp.hardware.sensing.source_factory import source_of
from ctr_nlp.identify.closed_loop.tracker import Note, Tracker
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import YES
from ctr_nlp.typing import Array


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of closed loops to `parser`."""
    parser.add_argument(
        "--closed-loop",
        action="store_true",
        help="correct the plan during playback from measurements of the sensor in the hardware file ([sensing]); "
        "the real robot may differ from the plan's within its tolerances",
    )
    parser.add_argument(
        "--sensor",
        metavar="URL",
        help=f"sensor to use instead of the url in the hardware file: {URLS}; without [sensing] in that file, it "
        "measures the tip in the robot's base frame, with noise of 0.5 mm",
    )
    parser.add_argument(
        "--replay",
        action="store_true",
        help="compute the commands of the last closed-loop session again from the journal, and check that they "
        "are the same bit for bit; opens no device",
    )


def with_sensor(hardware: Hardware, url: str | None) -> Hardware:
    """Return hardware with the sensor at `url`, if given; raises HardwareError, and OptionError where there is no
    sensor.
    """
    if url is not None:
        return replace(hardware, sensing=replace(hardware.sensing or Sensing(), url=url))
    if hardware.sensing is None:
        raise OptionError("a closed loop needs a sensor: --sensor URL, or a table [sensing] in the hardware file")
    return hardware


def sensing_of(hardware: Hardware) -> Sensing:
    """Return the description of the sensor of `hardware` in a closed loop, which always has one."""
    assert hardware.sensing is not None
    return hardware.sensing


@contextmanager
def start_closed_loop(
    plan: Plan, hardware: Hardware, records: list[dict[str, Any]] | None
) -> Iterator[ClosedLoop]:
    """Yield a closed loop on a plan, and close it when the block ends; raises OptionError.

    plan: the plan to correct. hardware: with a sensor. records: of the journal of a session that is continued,
    whose last estimate of the robot is the prior of this one; None for a new session.
    """
    sensing = sensing_of(hardware)
    known = None if records is None else final_estimate(records)
    tracker = Tracker(plan, sensing.sensors, prior=known)
    source = source_of(sensing, plan)
    if isinstance(source, SimulatedRobot):
        print_stderr(f"sensor: {source}")
    loop = ClosedLoop(tracker, source, _print_note)
    try:
        yield loop
    finally:
        loop.close()


def warn(plan: Plan) -> None:
    """Say on stderr, before anything moves, where a plan is not known to hold on built robots.

    A closed loop corrects where the robot is, not how much stability a plan leaves it: one that was not made for
    the tolerances is stopped where the estimated robot comes too near to a snap, mostly long before its end.
    """
    doubtful = [each for each in (plan.verdicts.stable, plan.verdicts.holds) if each.word != YES]
    if not doubtful:
        return
    told = "; ".join(map(str, doubtful))
    print_stderr(
        f"warning: the robot may snap on this plan. {told}. A closed loop cannot prevent that: it stops, with "
        "exit status 1, where the estimated robot comes close to a snap"
    )


def _print_note(note: Note) -> None:
    """Print a message of the tracker on stderr."""
    print_stderr(f"note: {note.why}: the robot is {note.state.value}")


def print_estimates(loop: ClosedLoop) -> None:
    """Print a loop's estimates of the robot's parameters, how well measurements fitted, and its messages."""
    if not loop.estimates:
        return
    last = loop.estimates[-1]
    of = loop.tracker.observer.differences
    columns = last.mean, last.deviation, np.sqrt(of.covariance.diagonal())
    named = zip(of.values_by_name(last.mean.tolist()), *(column.tolist() for column in columns), strict=True)
    print_table(
        "estimated parameters of the robot, in parts of the described value, mm, rad and N",
        ("", "estimate", "deviation", "before"),
        [(name, *(f"{value:.4f}" for value in values)) for name, *values in named],
    )
    sizes = np.array([each.size for each in loop.estimates])
    known = np.isfinite(sizes)
    taken = np.array([each.accepted for each in loop.estimates])[known]
    if known.any():
        told = f"{known.sum()} times measured, {taken.mean():.0%} of values taken, innovations"
        console().print(f"{told} {np.sqrt(sizes[known].mean()):.2f} times as large as expected")
    for note in loop.tracker.notes:
        after = note.time - loop.estimates[0].time
        console().print(f"{after:.2f} s after the start: {note.why} ({note.state.value})")


def columns(loop: ClosedLoop) -> dict[str, Array]:
    """Return the estimates of `loop` over time as columns by name, with a row for each look at the sensors."""
    time, mean, deviation, size, accepted = (np.array(column) for column in zip(*loop.estimates, strict=True))
    found: dict[str, Any] = {"time_s": time - time[0], "innovation": size, "accepted": accepted}
    for k, name in enumerate(loop.tracker.observer.differences.values_by_name(mean[0].tolist())):
        found |= {name: mean[:, k], f"deviation of {name}": deviation[:, k]}
    return found


def replay(plan: Plan, hardware: Hardware, records: list[dict[str, Any]]) -> int:
    """Compute the commands of the last session again from its measurements, report whether they are the same, and
    return the exit status.

    plan: the plan that was played. hardware: with the sensor. records: of the session's journal.
    """
    tracker = Tracker(plan, sensing_of(hardware).sensors, prior=initial_estimate(records))
    corrections, commands, differs = replay_session(plan, hardware, records, tracker)
    if differs:
        console().print(f"the replay differs from the journal: {differs}")
        return EXIT_SOME_FAILED
    lines = f" and {commands} lines of motion" if commands else ""
    console().print(f"replayed {corrections} corrections{lines}: the same as in the journal, bit for bit")
    return EXIT_SOLVED
