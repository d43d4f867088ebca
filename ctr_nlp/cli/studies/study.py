"""`ctr-nlp study`: make thousands of plans, in processes of this machine or on a cluster."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ctr_nlp.cli.arguments import add_out_option
from ctr_nlp.cli.console import EXIT_INTERRUPTED, EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.output.file import path_component, write_text
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.plan_report import exit_status
from ctr_nlp.cli.studies.workers import add_worker_options, open_client
from ctr_nlp.cli.terminal_output import console, print_table, progress_bar, report_written_files
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, YES
from ctr_nlp.studies.grid.case import Case
from ctr_nlp.studies.grid.groups import STUDY_RANKING_COLUMN, Groups, group_rows
from ctr_nlp.studies.grid.reports import write_report
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers.running import StudyProgress, run_study
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.view.report import page

STUDY_MEAN_COLUMNS = STUDY_RANKING_COLUMN, "stability_min", "process_s"
"""Columns whose means are printed."""
STUDY_COPY_NAME, GROUP_PICTURE_NAME, WORST_PLANS_PAGE_NAME = "study.toml", "by.png", "worst.html"
"""Files beside the rows: the study's own file, the picture of its plans by a column, and a page of the worst ones.
"""
VERDICT_WORD_COLUMNS = YES, NO, NOT_CHECKED
"""Words of verdicts, as columns."""
SHORT_DIGEST_LETTERS = 10
"""Letters of a digest that are enough to name a row."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Plan every combination of the problems, robots and settings that a study file names, on all "
        "cores of this machine or on a Dask cluster. A row of every plan goes into DIR/rows (Parquet) as it is "
        "made; a study that was stopped, or whose machine died, goes on where it was, and a changed study does "
        "only what is new in it.",
        epilog="Exit status: 0 where every plan was made and no verdict is `no`, 1 otherwise, 2 for bad input, "
        'and 130 after an interruption. The extra `study` is needed: pip install "ctr_nlp[study]".',
    )
    parser.add_argument("study", metavar="STUDY.toml")
    add_worker_options(parser)
    parser.add_argument("--plans", action="store_true", help="keep the plans themselves, too, in DIR/plans")
    told = (
        "make only the plan whose row has this digest, or one that begins so: here, without a cluster, and with "
    )
    told += "nothing written but, with --plans, the plan"
    parser.add_argument("--only", metavar="DIGEST", help=told)
    told = "do nothing new; report what is known by a column such as problem, robot_name or set_stability_margin, "
    told += "and draw it (DIR/by.png)"
    parser.add_argument("--by", metavar="COLUMN", help=told)
    told = "with --by: another column, over whose medians those of e3 are drawn, such as robustness_lost_share"
    parser.add_argument("--against", metavar="COLUMN", help=told)
    told = (
        f"with --by: write a page of the plans of the largest e3, moving side by side "
        f"(DIR/{WORST_PLANS_PAGE_NAME}); plans "
    )
    told += "that were not kept (--plans) are made again"
    parser.add_argument("--page", action="store_true", help=told)
    add_out_option(parser, "runs/NAME-study")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    study = Study.from_toml(arguments.study)
    out = Path(arguments.out or f"runs/{path_component(study.name)}-study")
    if arguments.by is not None:
        return _report_by_column(study, out, arguments)
    if arguments.only is not None:
        return _make_single_plan(study, arguments.only, out / "plans" if arguments.plans else None)
    for kind in ("study", *([] if study.report is None else [study.report])):
        check_folder(out, kind)
    Results(out).check_free()
    with open_client(arguments) as client, progress_bar() as labelled, deferred_interrupt() as interrupted:
        console(stderr=True).print(f"The cluster's own page is {client.dashboard_link}.")
        with output_folder(out, "study") as staging:
            (staging / STUDY_COPY_NAME).write_bytes(Path(arguments.study).read_bytes())
        report = labelled(study.name)

        def seen(progress: StudyProgress) -> None:
            told = f"{progress.failed} failed", f"{progress.rate:.3g} a second", progress.workers_in_words
            report(progress.done, progress.total, ", ".join(filter(None, told)))

        asked = {"keep_plans": arguments.plans, "patience": arguments.patience}
        progress = run_study(study, out, client, callback=seen, stop=interrupted, **asked)
        stopped = interrupted() and progress.done < progress.total
    if stopped and not progress.done:
        console().print("Nothing was written: the study was stopped before its first plan was done.")
        return EXIT_INTERRUPTED
    found = _group_plans(study, out, "problem")
    _print(found, arguments.study)
    done = "all" if progress.done == progress.total else f"{progress.done} of {progress.total}"
    report_written_files(
        out,
        more=f": rows of {done} plans; {progress.done_before} from earlier runs, {progress.failed} failed",
    )
    if stopped:
        return EXIT_INTERRUPTED
    if study.report is not None:
        _report(study, out)
    return EXIT_SOLVED if found.all_passed else EXIT_SOME_FAILED


def _group_plans(study: Study, out: Path, column: str, more: Sequence[str] = ()) -> Groups:
    """Return the study's plans in groups by a column, with the values of `STUDY_MEAN_COLUMNS` and of the columns
    `more`.
    """
    results = Results(out)
    known = results.columns
    shown = [name for name in STUDY_MEAN_COLUMNS if name in known]
    return group_rows(results, {case.digest for case in study.cases}, column, [*dict.fromkeys([*shown, *more])])


def _report_by_column(study: Study, out: Path, arguments: argparse.Namespace) -> int:
    """Print and draw the study's plans in groups by a column, and return the exit status."""
    against = arguments.against
    found = _group_plans(study, out, arguments.by, [] if against is None else [against])
    check_folder(out, "by")
    from ctr_nlp.studies.grid.picture import draw_groups  # brings matplotlib, which takes long to load
    from ctr_nlp.view.figures import save

    with output_folder(out, "by") as staging:
        save(draw_groups(found, STUDY_RANKING_COLUMN, against), staging / GROUP_PICTURE_NAME)
        if arguments.page:
            write_text(staging / WORST_PLANS_PAGE_NAME, _page(study, out, found))
        files = sorted(path.name for path in staging.iterdir())
    _print(found, arguments.study)
    report_written_files(out, files)
    return EXIT_SOLVED


def _page(study: Study, out: Path, found: Groups) -> str:
    """Return the plans of the largest error as one HTML page."""
    if not found.worst:
        raise OptionError(
            "--page shows the plans with the largest e3, but the study has no plans yet; run it first"
        )
    cases = {case.digest: case for case in study.cases}
    plans = [_load_or_make_plan(cases[bad.digest], out / "plans") for bad in found.worst]
    return page(plans, [f"{bad.problem}, {bad.robot}, {bad.digest[:SHORT_DIGEST_LETTERS]}" for bad in found.worst])


def _load_or_make_plan(case: Case, folder: Path) -> Plan:
    kept = case.plan_path(folder)
    return Plan.load(kept) if kept.is_file() else case.plan_motion(case.load_problem())


def _report(study: Study, out: Path) -> None:
    """Write the report that the study ends with, and print its sentences."""
    assert study.report is not None
    place = {case.digest: number for number, case in enumerate(study.cases)}
    rows = [row for row in Results(out).frame().to_dict("records") if row["digest"] in place]
    rows.sort(key=lambda row: place[row["digest"]])
    with output_folder(out, study.report) as staging:
        sentences = write_report(study.report, rows, staging)
        files = sorted(path.name for path in staging.iterdir())
    for sentence in sentences:
        console().print(f"- {sentence}")
    report_written_files(out, files)


def _make_single_plan(study: Study, digest: str, keep: Path | None) -> int:
    """Make the one plan whose digest begins with `digest`, print it, and write it into the folder `keep`, if any;
    returns the exit status.
    """
    cases = [case for case in study.cases if case.digest.startswith(digest)]
    if len(cases) != 1:
        raise OptionError(
            f"--only {digest} matches {len(cases)} plans of the study; give a digest that matches one"
        )
    plan = cases[0].plan_motion(cases[0].load_problem())
    if keep is not None:
        cases[0].save_plan(plan, keep)
    console().print(f"{plan}")
    for name, value in (cases[0].columns | summary(plan)).items():
        console().print(f"{name}: {value}", soft_wrap=True)
    return exit_status(plan)


def _print(found: Groups, study: str) -> None:
    """Print plans by a column, the worst ones, and why plans failed, with the commands that make such a plan
    alone; `study` is the study's file.
    """
    shown = dict.fromkeys(name for group in found.groups for name in group.values)
    rows = []
    for group in found.groups:
        means = [
            f"{group.column_values(name).mean():.3g}" if len(group.column_values(name)) else "" for name in shown
        ]
        rows.append([group.name, str(group.plans), str(group.failed), *means])
    print_table(f"plans by {found.column}, means", (found.column, "plans", "failed", *shown), rows)
    counted = [
        [name.replace("_", " "), *(str(words[word]) for word in VERDICT_WORD_COLUMNS)]
        for name, words in found.verdicts.items()
    ]
    if counted:
        print_table("verdicts, numbers of plans", ("verdict", *VERDICT_WORD_COLUMNS), counted)
    worst = [
        [f"{bad.error:.3g}", bad.problem, bad.robot, bad.digest[:SHORT_DIGEST_LETTERS]] for bad in found.worst
    ]
    if worst:
        print_table("plans of the largest e3", ("e3 mm", "problem", "robot", "digest for --only"), worst)
    for failure in found.failures:
        again = f"ctr-nlp study {study} --only {failure.digest[:SHORT_DIGEST_LETTERS]}"
        console().print(f"{failure.plans} failed: {failure.reason} Again: {again}", soft_wrap=True)


main = Command("ctr-nlp study", _parser, _run)
