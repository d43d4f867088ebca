"""`ctr-nlp study`: thousands of plans, on the processes of this machine or on a cluster."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ctr_nlp.cli.arguments import add_out_option, whole
from ctr_nlp.cli.console import INTERRUPTED, SOLVED, SOME_FAILED, Command, console, print_table, progress_bar
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.exceptions import OptionError
from ctr_nlp.studies.grid.case import DONE
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.running import PATIENCE, Progress, local_client, run
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.support.extras import needed
from ctr_nlp.support.interrupt import deferred_interrupt

SHOWN = "e3", "stability_min", "process_s"
"""Columns whose means and extremes are printed."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Plan every combination of the problems, robots and settings that a study file names, on all "
        "cores of this machine or on a Dask cluster. A row of every plan goes into DIR/rows (Parquet) as it is "
        "made; a study that was stopped, or whose machine died, goes on where it was, and a changed study does "
        "only what is new in it.",
        epilog="Exit status: 0 every plan was made and solved, 1 some not, 2 bad input, 130 interrupted. It needs "
        'the extra `study`: pip install "ctr_nlp[study]".',
    )
    parser.add_argument("study", metavar="STUDY.toml")
    told = "scheduler of a Dask cluster to work on, as tcp://HOST:PORT (default: processes of this machine)"
    parser.add_argument("--address", metavar="URL", help=told)
    cores = os.cpu_count() or 1
    parser.add_argument("--workers", metavar="N", type=whole, help=f"processes of this machine (default {cores})")
    told = f"seconds that a plan may take before it is given up (default {PATIENCE:g})"
    parser.add_argument("--patience", metavar="S", type=float, default=PATIENCE, help=told)
    parser.add_argument("--plans", action="store_true", help="keep the plans themselves, too, in DIR/plans")
    told = "do nothing new; tell what is known, by a column such as problem, robot_name or set_stability_margin"
    parser.add_argument("--by", metavar="COLUMN", help=told)
    add_out_option(parser, "runs/NAME-study")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    study = Study.from_toml(arguments.study)
    out = Path(arguments.out or f"runs/{path_component(study.name)}-study")
    if arguments.by is not None:
        _print(Results(out).frame(), arguments.by)
        return SOLVED
    with _client(arguments) as client, progress_bar() as labelled, deferred_interrupt() as interrupted:
        console(stderr=True).print(f"The cluster's own page is {client.dashboard_link}.")
        report = labelled(study.name)

        def seen(progress: Progress) -> None:
            told = f"{progress.failed} failed, {progress.rate:.3g} a second"
            report(progress.done, progress.total, told)

        asked = {"keep_plans": arguments.plans, "patience": arguments.patience}
        progress = run(study, out, client, seen=seen, stop=interrupted, **asked)
        stopped = interrupted() and progress.done < progress.total
    frame = Results(out).frame()
    _print(frame, "problem")
    done = "all" if progress.done == progress.total else f"{progress.done} of {progress.total}"
    told = f"wrote {out}: rows of {done} plans; {progress.known} of them were known, and {progress.failed} failed"
    console().print(told)
    if stopped:
        return INTERRUPTED
    return SOLVED if not progress.failed and bool(frame["complete"].fillna(False).all()) else SOME_FAILED


@contextmanager
def _client(arguments: argparse.Namespace) -> Iterator[Any]:
    """Of the cluster asked for, or of processes of this machine."""
    if arguments.address is None:
        with local_client(arguments.workers or os.cpu_count() or 1) as client:
            yield client
        return
    with needed("distributed").Client(arguments.address) as client:
        yield client


def _print(frame: Any, column: str) -> None:
    """Means and extremes of plans by a column, and of failures the reasons."""
    if column not in frame:
        raise OptionError(f"--by {column} is no column of the study; those are {', '.join(sorted(frame))}")
    shown = [name for name in SHOWN if name in frame]
    rows = []
    for name, part in frame.groupby(column):
        cells = [f"{part[each].mean():.3g}" if part[each].notna().any() else "" for each in shown]
        rows.append([str(name), str(len(part)), str(int((part["status"] != DONE).sum())), *cells])
    print_table(f"plans by {column}, means", (column, "plans", "failed", *shown), rows)
    for reason, count in frame.loc[frame["status"] != DONE, "reason"].value_counts().items():
        console().print(f"{count} failed: {reason}")


main = Command("ctr-nlp study", _parser, _run)
