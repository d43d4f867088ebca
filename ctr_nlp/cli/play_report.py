"""Report on a plan that is played: checks before anything moves, and afterwards how it went."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.cli import closed_loop
from ctr_nlp.cli.output.file import check_file
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.terminal_output import console, print_stderr, print_table, report_written_files
from ctr_nlp.exceptions import OptionError, OutputError
from ctr_nlp.hardware.axis import Axis
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.guiding.loop import ClosedLoop
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.checks import TrajectoryCheck
from ctr_nlp.hardware.playing.record import Tracking
from ctr_nlp.hardware.playing.results import PlaybackOutcome, Result
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.tables import columns_to_rows, write_csv
from ctr_nlp.typing import Array

JOURNAL = "journal.jsonl"
"""Record of all sessions in the output folder, to which each session adds its own."""

ESTIMATE = "estimate.csv"
"""Estimates of the robot over a closed loop, in the output folder."""


FILE_SUFFIXES = (".json", ".jsonl", ".csv", ".png", ".npz", ".toml", ".txt")
"""Suffixes of --out that were meant for a file, and not for the folder."""


def claim(out: Path) -> None:
    """Make `out` a folder of ours. Its journal is added to; other files of earlier sessions are removed.

    Raises OptionError for the name of a file, and OutputError for a folder that is not ours or cannot be written.
    """
    if out.suffix.lower() in FILE_SUFFIXES:
        raise OptionError(f"--out is {out}, but {JOURNAL} and more go into a folder; name a folder")
    check_file(out / JOURNAL, '{"t": ')
    check_folder(out, "play")
    # Publishing nothing marks the folder as ours and removes what earlier sessions published.
    with output_folder(out, "play"):
        pass


def print_trajectory(title: str, trajectory: Trajectory, found: TrajectoryCheck) -> None:
    """Print a trajectory's duration and use of the hardware's limits under `title`; found: its check."""
    rows: list[tuple[str, Any, str]] = [
        ("frames", len(trajectory.frames), ""),
        ("duration", f"{trajectory.duration:.2f}", "s"),
        ("longer than planned by", f"{found.late:.2f}", "s"),
        ("largest part of a speed limit", f"{found.speed:.2f}", ""),
        ("largest part of an acceleration limit", f"{found.acceleration:.2f}", ""),
    ]
    if not np.isnan(found.margin):
        rows.append(("least stability margin on the path", found.margin, ""))
    print_table(title, ("", "value", "unit"), rows)


def report(
    plan: Plan,
    hardware: Hardware,
    result: Result,
    seen: Tracking | None,
    journal: Journal,
    loop: ClosedLoop | None,
) -> bool:
    """Report how playback went, on the terminal and, where enough was seen, in files beside the journal.

    Parameters
    ----------
    plan : Plan
        The plan that was played.
    hardware : Hardware
        The hardware that played it.
    result : Result
        How playback ended.
    seen : Tracking, optional
        Where the axes were when frames were due.
    journal : Journal
        Journal of the session, closed.
    loop : ClosedLoop, optional
        Closed loop that corrected the plan.

    Returns
    -------
    bool
        Whether everything could be written and remembered.
    """
    out = journal.path.parent
    name = plan.meta["problem"]["name"]
    device = hardware.connection.device
    where = "trusted" if result.trusted else "not to be trusted"
    if result.memory_error:
        where += ", but not remembered"
    rows: list[tuple[str, Any, str]] = [
        ("result", result.outcome.value, ""),
        ("position of the axes", where, ""),
    ]
    # A retraction that succeeds passes no frame of the plan.
    if result.frame or result.outcome is not PlaybackOutcome.SUCCESS:
        rows.insert(1, ("last frame passed", f"{result.frame} of {len(plan.time)}", ""))
    files = [] if journal.unwritten else [JOURNAL]
    missing = [why for why in (result.memory_error, journal.unwritten) if why]
    if seen is not None and len(seen.frame):
        letters = [f"{axis.letter} ({axis.unit})" for axis in hardware.axes]
        try:
            described = [_describe_axis(axis) for axis in hardware.axes]
            files += _written(f"Tracking: {name}, {device} device", seen, letters, described, out, loop)
        except OutputError as exception:
            missing.append(str(exception))
        for unit in dict.fromkeys(axis.unit for axis in hardware.axes):
            some = [k for k, axis in enumerate(hardware.axes) if axis.unit == unit]
            largest = float(abs(seen.error[:, some]).max())
            rows.append((f"largest error of an axis in {unit}, at the times of frames", largest, unit))
        rows.append(("time of the last frame passed, as commanded", f"{seen.time[-1]:.2f}", "s"))
        rows.append(
            (
                "time of the last frame passed, as measured without pauses",
                f"{seen.time[-1] + seen.late[-1]:.2f}",
                "s",
            )
        )
    print_table(f"{name} on the {device} device", ("", "value", "unit"), rows)
    if loop is not None:
        closed_loop.print_estimates(loop)
    console().print(result.message)
    if not result.trusted:
        console().print("Home the axes, or see that they are where the controller says, before they are used.")
    if files:
        report_written_files(out, files)
    for why in missing:
        print_stderr(f"error: {why}")
    return not missing


def _describe_axis(axis: Axis) -> str:
    """Return an axis' letter, what it moves, and its unit, as in "X, tube 1 out (mm)"."""
    kind, _, tube = axis.joint.partition("_")
    return f"{axis.letter}, tube {tube} {'out' if kind == 'beta' else 'turned'} ({axis.unit})"


def _written(
    title: str, seen: Tracking, names: list[str], described: list[str], out: Path, loop: ClosedLoop | None
) -> list[str]:
    """Write tracking.csv, tracking.png and estimate.csv, and return their names; raises OutputError.

    names: of the axes in the table. described: of the axes in the picture.
    """
    from ctr_nlp.view.figures import save, tracking  # matplotlib is not needed before anything has moved

    with output_folder(out, "play") as staging:
        write_csv(staging / "tracking.csv", columns_to_rows(_columns(seen, names)))
        save(tracking(title, seen.frame, seen.error, seen.late, described), staging / "tracking.png")
        if loop is not None and loop.estimates:
            write_csv(staging / ESTIMATE, columns_to_rows(closed_loop.columns(loop)))
        return sorted(path.name for path in staging.iterdir() if path.suffix in (".csv", ".png"))


def _columns(seen: Tracking, names: list[str]) -> dict[str, Array]:
    columns: dict[str, Any] = {"frame": seen.frame, "time_s": seen.time, "late_s": seen.late}
    for k, name in enumerate(names):
        columns |= {f"commanded {name}": seen.commanded[:, k], f"measured {name}": seen.measured[:, k]}
    return columns
