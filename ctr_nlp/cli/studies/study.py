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
from ctr_nlp.cli.output.folder import check_folder, published
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.metrics import summary
from ctr_nlp.studies.grid.case import DONE
from ctr_nlp.studies.grid.reports import reported
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.running import PATIENCE, Progress, local_client, run
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.support.extras import needed
from ctr_nlp.support.interrupt import deferred_interrupt

SHOWN = "e3", "stability_min", "process_s"
"""Columns whose means are printed."""
COPY = "study.toml"
"""The study's own file, beside its rows."""
SHORT = 10
"""Letters of a digest that are enough to name a row."""


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
    told = (
        "make only the plan whose row has this digest, or one that begins so: here, without a cluster, and with "
    )
    told += "nothing written, to find out why it failed"
    parser.add_argument("--only", metavar="DIGEST", help=told)
    told = "do nothing new; tell what is known, by a column such as problem, robot_name or set_stability_margin"
    parser.add_argument("--by", metavar="COLUMN", help=told)
    add_out_option(parser, "runs/NAME-study")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    study = Study.from_toml(arguments.study)
    out = Path(arguments.out or f"runs/{path_component(study.name)}-study")
    if arguments.by is not None:
        _print(Results(out).frame(), arguments.by, arguments.study)
        return SOLVED
    if arguments.only is not None:
        return _alone(study, arguments.only)
    for kind in ("study", *([] if study.report is None else [study.report])):
        check_folder(out, kind)
    with _client(arguments) as client, progress_bar() as labelled, deferred_interrupt() as interrupted:
        console(stderr=True).print(f"The cluster's own page is {client.dashboard_link}.")
        with published(out, "study") as staging:
            (staging / COPY).write_bytes(Path(arguments.study).read_bytes())
        report = labelled(study.name)

        def seen(progress: Progress) -> None:
            told = f"{progress.failed} failed, {progress.rate:.3g} a second"
            report(progress.done, progress.total, told)

        asked = {"keep_plans": arguments.plans, "patience": arguments.patience}
        progress = run(study, out, client, seen=seen, stop=interrupted, **asked)
        stopped = interrupted() and progress.done < progress.total
    frame = _of(study, Results(out).frame())
    _print(frame, "problem", arguments.study)
    done = "all" if progress.done == progress.total else f"{progress.done} of {progress.total}"
    told = f"wrote {out}: rows of {done} plans; {progress.known} of them were known, and {progress.failed} failed"
    console().print(told)
    if stopped:
        return INTERRUPTED
    if study.report is not None:
        _report(study.report, frame, out)
    return SOLVED if not progress.failed and bool(frame["complete"].fillna(False).all()) else SOME_FAILED


def _of(study: Study, frame: Any) -> Any:
    """Those rows of a folder that are the study's, in its order."""
    place = {case.digest: number for number, case in enumerate(study.cases)}
    own = frame[frame["digest"].isin(place)]
    return own.sort_values("digest", key=lambda digests: digests.map(place), ignore_index=True)


def _report(report: str, frame: Any, out: Path) -> None:
    """The page that the study ends with, and what it says."""
    with published(out, report) as staging:
        sentences = reported(report, frame.to_dict("records"), staging)
        files = sorted(path.name for path in staging.iterdir())
    for sentence in sentences:
        console().print(f"- {sentence}")
    console().print(f"wrote {out}: {', '.join(files)}")


def _alone(study: Study, digest: str) -> int:
    """The one plan whose row has a digest that begins so, made here; its row is printed, nothing is written."""
    cases = [case for case in study.cases if case.digest.startswith(digest)]
    if len(cases) != 1:
        raise OptionError(f"--only {digest} is the digest of {len(cases)} plans of the study; it must be of one")
    plan = cases[0].planned(cases[0].loaded())
    console().print(f"{plan}")
    for name, value in (cases[0].columns | summary(plan)).items():
        console().print(f"{name}: {value}", markup=False, soft_wrap=True)
    return SOLVED if plan.complete else SOME_FAILED


@contextmanager
def _client(arguments: argparse.Namespace) -> Iterator[Any]:
    """Of the cluster asked for, or of processes of this machine."""
    if arguments.address is None:
        with local_client(arguments.workers or os.cpu_count() or 1) as client:
            yield client
        return
    with needed("distributed").Client(arguments.address) as client:
        yield client


def _print(frame: Any, column: str, study: str) -> None:
    """Means of plans by a column; of failures the reasons, each with a command that fails in the same way."""
    if column not in frame:
        raise OptionError(f"--by {column} is no column of the study; those are {', '.join(sorted(frame))}")
    shown = [name for name in SHOWN if name in frame]
    rows = []
    for name, part in frame.groupby(column):
        cells = [f"{part[each].mean():.3g}" if part[each].notna().any() else "" for each in shown]
        rows.append([str(name), str(len(part)), str(int((part["status"] != DONE).sum())), *cells])
    print_table(f"plans by {column}, means", (column, "plans", "failed", *shown), rows)
    for reason, part in frame.loc[frame["status"] != DONE].groupby("reason"):
        again = f"ctr-nlp study {study} --only {part['digest'].iloc[0][:SHORT]}"
        console().print(f"{len(part)} failed: {reason} Again: {again}", markup=False, soft_wrap=True)


main = Command("ctr-nlp study", _parser, _run)
