"""`ctr-nlp reach`: plan to every end of a tree for one or more robots."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ctr_nlp.anatomy.files import ANATOMY_SUFFIXES, title
from ctr_nlp.cli.arguments import add_entry_option, add_frames_option, add_numbers, add_out_option, count
from ctr_nlp.cli.console import EXIT_INTERRUPTED, EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.plan_options import add_piece_arguments, add_reading_options, pieces_from, read_options_from
from ctr_nlp.cli.problems import file_option_words
from ctr_nlp.cli.studies.workers import add_worker_options, open_client
from ctr_nlp.cli.terminal_output import (
    announce,
    console,
    print_stderr,
    print_table,
    progress_bar,
    report_written_files,
    suggest_next,
)
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.monte_carlo import DEFAULT_PLAN_SAMPLES
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS
from ctr_nlp.robot import Robot
from ctr_nlp.robot.shipped import read_robot, read_robot_files
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.reach.outcomes import LENGTH_CHECK, MISSED, NEARLY, UNPLANNED, EndOutcome
from ctr_nlp.studies.reach.reach import DEFAULT_BOUND_S, Reach, reach_tree
from ctr_nlp.studies.reached.cases import REACHED
from ctr_nlp.studies.workers.running import StudyProgress
from ctr_nlp.support.interrupt import deferred_interrupt


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Plan to every end of a tree that is wide enough, for every robot, on all cores of this "
        "machine or on a Dask cluster, and list which ends are reached and what binds at the others. Rows of the "
        "plans are kept in DIR/rows as they come: called again with the same folder, the command goes on where "
        "it was.",
        epilog="Writes reach.csv (a row for each end and robot), tree.png (the tree, coloured by the best robot), "
        "reach.html (one page with both) and summary.json. Exit status: 0 where every wide-enough end is reached "
        "by at least one robot, 1 otherwise, 2 for bad input, and 130 after an interruption. The extra `study` is "
        f'needed: pip install "ctr_nlp[study]". {NOT_FOR_PATIENTS}',
    )
    parser.add_argument(
        "file", metavar="MASK", help=f"mask or tree of centrelines ({', '.join(ANATOMY_SUFFIXES)})"
    )
    add_piece_arguments(parser)
    parser.add_argument(
        "--robot",
        metavar="FILE.toml|NAME",
        action="append",
        help="robot file or name of a robot of the package; give it once for each robot (default: all robots of "
        "the package)",
    )
    add_entry_option(parser, "where the tree begins; in a mask the widest end")
    parser.add_argument(
        "--from-carina",
        action="store_true",
        help="insert robots at the main bifurcation, up to which a rigid tube guides them: the first one of which "
        "two sides each lead to at least a sixth of all ends",
    )
    parser.add_argument(
        "--nominal", action="store_true", help="plan for the robots as described, not within their tolerances"
    )
    parser.add_argument(
        "--trim",
        choices=("start",),
        help="move the robot's base inwards where a path is longer than it reaches; without it, such ends are "
        "missed",
    )
    add_numbers(
        parser,
        ("smoothing", "MM", "how far the followed curves may keep from the paths (default 0, and 2 in a mask)"),
    )
    add_frames_option(parser)
    told = (
        f"robots within the tolerances on which each plan is simulated (default {DEFAULT_PLAN_SAMPLES}); with 0 "
    )
    told += "no end counts as reached"
    parser.add_argument("--samples", metavar="N", type=count, default=DEFAULT_PLAN_SAMPLES, help=told)
    told = (
        "processor time, in seconds, of the search for a proof that the robot cannot arrive, at each end that is "
    )
    told += f"missed; 0: none (default {DEFAULT_BOUND_S:g})"
    parser.add_argument("--bound", metavar="S", type=float, default=DEFAULT_BOUND_S, help=told)
    add_worker_options(parser)
    add_reading_options(parser)
    add_out_option(parser, "runs/PROBLEM-reach")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    robots = _read_robots(arguments.robot)
    out = Path(arguments.out or f"runs/{path_component(title(arguments.file))}-reach")
    check_folder(out, "reach")
    Results(out).check_free()
    # An output folder with rows and no manifest would be taken for the user's after an interruption.
    with output_folder(out, "reach"):
        pass
    with open_client(arguments) as client, progress_bar() as labelled, deferred_interrupt() as interrupted:
        print_stderr(f"The cluster's own page is {client.dashboard_link}.")
        report = labelled("plans to the ends")

        def seen(progress: StudyProgress) -> None:
            failed = f"{progress.failed} failed" if progress.failed else ""
            report(progress.done, progress.total, ", ".join(filter(None, (failed, progress.workers_in_words))))

        found = reach_tree(
            arguments.file,
            robots,
            out,
            entry=arguments.entry,
            from_carina=arguments.from_carina,
            robust=not arguments.nominal,
            frames=arguments.frames,
            samples=arguments.samples,
            bound_s=arguments.bound,
            trim=arguments.trim is not None,
            smoothing=arguments.smoothing,
            options=read_options_from(arguments),
            pieces=pieces_from(arguments),
            client=client,
            patience=arguments.patience,
            callback=seen,
            stop=interrupted,
        )
    from ctr_nlp.studies.reach.report import write  # brings matplotlib, which takes long to load

    with output_folder(out, "reach") as staging:
        write(found, staging)
        files = sorted(path.name for path in staging.iterdir())
    for note in found.tree.branches.facts.notes:
        print_stderr(f"note: {note}")
    _print(found)
    report_written_files(out, files)
    if not found.complete:
        announce("Not everything is planned yet; the same command goes on where it was.")
        return EXIT_INTERRUPTED
    missed = next((one for one in found.best if one.outcome in (MISSED, NEARLY)), None)
    if missed is not None:
        suggest_next(("a plan to the first end that is missed", _plan_words(arguments, found, missed)))
    best = found.counts()["any"]
    return EXIT_SOLVED if best[REACHED] == best["wide_enough"] else EXIT_SOME_FAILED


def _plan_words(arguments: argparse.Namespace, found: Reach, missed: EndOutcome) -> list[object]:
    """Return the words of a command that plans to an end as `ctr-nlp reach` did."""
    asked = vars(arguments) | {"target": [f"{x:.1f}" for x in (missed.x, missed.y, missed.z)]}
    if arguments.entry is not None or arguments.from_carina:
        asked["entry"] = [f"{x:.1f}" for x in found.tree.entry]
    words: list[object] = ["plan", arguments.file, *file_option_words(argparse.Namespace(**asked))]
    if arguments.robot is not None:
        words += ["--robot", next(file for file in arguments.robot if Path(file).stem == missed.robot)]
    return [*words, "--nominal"] if arguments.nominal else words


def _read_robots(files: Sequence[str] | None) -> dict[str, Robot]:
    """Read robots, by the names of their files, those of the package without any; raise OptionError where two have
    the same name.
    """
    if files is None:
        robots = read_robot_files()
        announce(f"robots: {', '.join(robots)}, which come with the package; --robot takes another")
        return robots
    robots = dict[str, Robot]()
    for file in files:
        name = Path(file).stem
        if name in robots:
            raise OptionError(f"two robot files are named {name}; give each a name of its own, which tables show")
        robots[name] = read_robot(file)
    return robots


def _print(found: Reach) -> None:
    """Print a row for each end, with its best robot, and how many ends are reached."""
    from ctr_nlp.studies.reach.report import TABLE_COLUMNS, table_row, totals

    # An end that waits for a plan waits for those of several robots: none of them is the best.
    several = len(found.robots) > 1
    rows = [
        table_row(replace(one, robot="", margin=math.nan) if several and one.outcome == UNPLANNED else one)
        for one in found.best
    ]
    robots = f", best of {len(found.robots)} robots" if several else ""
    robots += "" if found.complete else " so far"
    print_table(
        f"{found.tree.name}{robots}; depth, room, tip and contact in mm",
        TABLE_COLUMNS,
        rows,
        text=("robot", "outcome", "binds"),
    )
    far = sum(one.failed == LENGTH_CHECK for one in found.best)
    if far:
        print_stderr(
            f"note: {far} ends are farther from the entry than the robots reach; --from-carina or --trim start "
            "inserts them further in"
        )
    for sentence in totals(found):
        console().print(f"- {sentence}", soft_wrap=True)


main = Command("ctr-nlp reach", _parser, _run)
