"""Replay of a closed loop from its journal: the same measurements give the same commands, bit for bit."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import TrajectoryError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.guiding.corrected_trajectory import CorrectedTrajectory
from ctr_nlp.hardware.guiding.guide import readings_of
from ctr_nlp.hardware.motion.gcode import MEANING, lines
from ctr_nlp.hardware.motion.trajectory import Patch, Trajectory
from ctr_nlp.hardware.playing.session import (
    find_program_record,
    is_closed_loop,
    rebuild_planned_trajectory,
    split_at_parameter,
)
from ctr_nlp.identify.closed_loop.tracker import Tracker
from ctr_nlp.plan.plan import Plan


class Replay(NamedTuple):
    """Result of a replay.

    corrections, commands: how many of each were compared; commands are Grbl's lines. differs: the first that is
    not the same, "" where all are.
    """

    corrections: int
    commands: int
    differs: str


def replay_session(plan: Plan, hardware: Hardware, records: list[dict[str, Any]], tracker: Tracker) -> Replay:
    """Compute the closed loop of a session again from the records of its journal, and compare.

    tracker: as it was when the session began. Raises TrajectoryError where plan or hardware is another, or where
    the session was not of a closed loop.
    """
    told = find_program_record(records)
    if not is_closed_loop(told):
        raise TrajectoryError("the journal's session was played without --closed-loop, so it has no measurements")
    trajectory = rebuild_planned_trajectory(plan, hardware, told)
    for patch in told["patches"]:
        trajectory = trajectory.apply_patch(Patch.from_record(patch))
    before = plan.q[:0]
    if told["parameter"] is not None:
        trajectory, before = split_at_parameter(trajectory, told["parameter"], told["tempo"])
    course = CorrectedTrajectory(trajectory, tracker, before)
    count = 0
    for record in records:
        if record["kind"] == "sensed":
            q = np.array(record["q"])
            readings = readings_of(record["readings"])
            course.observe(record["time"], q, record["now"], readings)
        elif record["kind"] == "corrected":
            count += 1
            if course.correct(record["knot"]).to_record() != record["patch"]:
                return Replay(count, 0, f"correction {count}, at {record['t']:g} s")
    return _compare_commands(count, course.trajectory, hardware, records)


def _compare_commands(
    count: int, trajectory: Trajectory, hardware: Hardware, records: list[dict[str, Any]]
) -> Replay:
    """Compare the lines of a corrected trajectory with those that a Grbl controller was sent last."""
    begun = max((k for k, record in enumerate(records) if record["kind"] == "start"), default=len(records))
    sent = "".join(record.get("data", "") for record in records[begun:] if record["kind"] == "sent")
    # With a blank after the number: the first copies of lines, not the shortened second ones.
    found = re.findall(r"N\d+ [^\n]*(?=\n)", sent)
    if not found:
        return Replay(count, 0, "")
    commands = trajectory.commands()
    start = np.array(records[begun]["position"])
    again = lines(hardware.letters, start, commands.positions, commands.time, MEANING)
    differs = next(
        (f"line {k}: {a!r}" for k, (a, b) in enumerate(zip(found, again, strict=False), 1) if a != b), ""
    )
    return Replay(count, len(found), differs)
