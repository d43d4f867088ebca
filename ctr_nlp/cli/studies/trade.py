"""`ctr-nlp trade`: study errors and losses over simulated robots against how much robustness is asked for."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from ctr_nlp.cli import problems
from ctr_nlp.cli.arguments import add_compile_option, add_out_option, add_problem_options, whole
from ctr_nlp.cli.console import EXIT_INTERRUPTED, EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder, output_folder, results_folder
from ctr_nlp.cli.terminal_output import console, print_table, progress_bar, report_written_files
from ctr_nlp.exceptions import escape_control_characters
from ctr_nlp.paths.named_problems import PROBLEM_NAMES
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.studies.robustness_trade_off import (
    COMPARED_STABILITY_MARGINS,
    ROBUSTNESS_STUDY_SAMPLES,
    ROBUSTNESS_STUDY_SEED,
    TOLERANCE_SCALES,
    RobustnessPoint,
    choice_sentence,
    choose_plan,
    plan_for_tolerances,
    plan_label,
    requested_plans,
)
from ctr_nlp.support.interrupt import end_if_interrupted
from ctr_nlp.support.tables import markdown, write_csv

TRADE_TABLE_COLUMNS = "planned for", "as planned mm", "mean over samples mm", "failed", "solved", ""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Plan motions for several fractions of the robot's tolerances, and evaluate all of them on "
        "the same simulated robots with the full tolerances, which planning does not see. Report e3 as planned, "
        "its mean over these robots, and how many fail. Of plans on which few fail, the one with the smallest "
        "mean is chosen. Walls are ignored. Write trade.md, .csv, .json, and for every problem a picture (.png, "
        ".pdf). A problem takes some minutes.",
        epilog="Exit status: 0 where a plan is chosen for every problem, 1 where none is for one of them, 2 "
        "where input is bad, 130 after an interruption.",
    )
    parser.add_argument(
        "problems", metavar="PROBLEM", nargs="*", help=f"{problems.PROBLEM_ARGUMENT_HELP} (default all names)"
    )
    shown = ", ".join(f"{amount:g}" for amount in TOLERANCE_SCALES)
    what = f"factors on the tolerances in planning; 0 plans for the nominal robot (default {shown})"
    parser.add_argument("--amounts", metavar="X", nargs="+", type=float, default=TOLERANCE_SCALES, help=what)
    what = (
        f"stability margins of nominal plans to compare with (default "
        f"{', '.join(map(str, COMPARED_STABILITY_MARGINS))})"
    )
    parser.add_argument(
        "--margins", metavar="MU", nargs="*", type=float, default=COMPARED_STABILITY_MARGINS, help=what
    )
    what = f"number of simulated robots (default {ROBUSTNESS_STUDY_SAMPLES})"
    parser.add_argument("--draws", metavar="N", type=whole, default=ROBUSTNESS_STUDY_SAMPLES, help=what)
    parser.add_argument(
        "--seed",
        metavar="N",
        type=whole,
        default=ROBUSTNESS_STUDY_SEED,
        help=f"random seed of the simulated robots (default {ROBUSTNESS_STUDY_SEED})",
    )
    what = f"share of simulated robots that may fail on the chosen plan (default {MOST_LOST})"
    parser.add_argument("--most-lost", metavar="P", type=float, default=MOST_LOST, help=what)
    parser.add_argument("--no-figures", action="store_true", help="write no picture")
    add_out_option(parser, "runs/trade")
    add_problem_options(parser)
    add_compile_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    tasks = problems.load_all(arguments.problems or PROBLEM_NAMES, arguments)
    check_folder(out, "trade")
    end_if_interrupted()
    found = list[list[RobustnessPoint]]()
    count = len(requested_plans(arguments.amounts, arguments.margins))
    with progress_bar() as labelled:
        for problem in tasks:
            every = arguments.amounts, arguments.margins, arguments.draws, arguments.seed
            found.append(plan_for_tolerances(problem, *every, labelled(problem.name)))
            if len(found[-1]) < count:
                break
    interrupted = len(found) < len(tasks) or any(len(points) < count for points in found)
    place = results_folder(out, interrupted)
    with output_folder(place, "trade") as staging:
        _write(found, staging, arguments)
        files = sorted(path.name for path in staging.iterdir())
    for points in filter(None, found):
        print_table(points[0].problem, list(TRADE_TABLE_COLUMNS), _rows(points, arguments.most_lost))
        console().print(choice_sentence(points, arguments.most_lost))
    report_written_files(place, files)
    if interrupted:
        return EXIT_INTERRUPTED
    return EXIT_SOLVED if all(choose_plan(points, arguments.most_lost) for points in found) else EXIT_SOME_FAILED


def _rows(points: list[RobustnessPoint], most_lost: float) -> list[list[str]]:
    best = choose_plan(points, most_lost)
    return [
        [
            *(plan_label(point.amount, point.margin), format_cell(point.planned), format_cell(point.mean)),
            f"{point.lost} of {point.draws}",
            "yes" if point.solved else "no",
            "chosen" if point is best else "",
        ]
        for point in points
    ]


def _write(found: list[list[RobustnessPoint]], folder: Path, arguments: argparse.Namespace) -> None:
    most = arguments.most_lost
    page = list[str]()
    every = [
        asdict(point) | {"lost_share": point.share, "chosen": point is choose_plan(points, most)}
        for points in found
        for point in points
    ]
    for points in filter(None, found):
        name = points[0].problem
        table = markdown(TRADE_TABLE_COLUMNS, _rows(points, most))
        page.append(f"{escape_control_characters(name)}\n\n{table}\n{choice_sentence(points, most)}\n")
        if not arguments.no_figures:
            from ctr_nlp.studies.robustness_trade_off_picture import draw_robustness_trade_off
            from ctr_nlp.view.figures import save  # brings matplotlib, which takes long to load

            for ending in ("png", "pdf"):
                save(draw_robustness_trade_off(points, name, most), folder / f"{path_component(name)}.{ending}")
    (folder / "trade.md").write_text("\n".join(page), encoding="utf-8")
    (folder / "trade.json").write_text(json.dumps(every, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    write_csv(folder / "trade.csv", every)


main = Command("ctr-nlp trade", _parser, _run)
