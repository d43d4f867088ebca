"""`ctr-nlp trade`: errors as planned, over draws and lost draws, against how much robustness is asked for."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from ctr_nlp.cli import problems
from ctr_nlp.cli.arguments import add_compile_option, add_out_option, add_problem_options, whole
from ctr_nlp.cli.console import INTERRUPTED, SOLVED, SOME_FAILED, Command
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder, place_of, published
from ctr_nlp.cli.telling import console, print_table, progress_bar, wrote
from ctr_nlp.plan.account import shown
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.problems import NAMES
from ctr_nlp.studies.trade import (
    AMOUNTS,
    DRAWS,
    MARGINS,
    SEED,
    Traded,
    asked,
    chosen,
    planned_for,
    sentence,
    traded,
)
from ctr_nlp.support.interrupt import end_if_interrupted
from ctr_nlp.support.tables import markdown, write_csv

COLUMNS = "planned for", "as planned mm", "mean over draws mm", "lost", "solved", ""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Plan motions for more and less of the robot's tolerances, and judge them on the same draws "
        "of all of these, which planning does not see: tell e3 as planned, its mean over draws, and "
        "how many draws are lost. Of plans that lose few, the one with the least mean is chosen. "
        "Walls do not count. Write trade.md, .csv, .json, and for every problem a picture (.png, "
        ".pdf). A problem takes some minutes.",
        epilog="Exit status: 0 where a plan is chosen for every problem, 1 where none is for one of them, 2 "
        "where input is bad, 130 after an interruption.",
    )
    parser.add_argument("problems", metavar="PROBLEM", nargs="*", help=f"{problems.KINDS} (default all names)")
    shown = ", ".join(f"{amount:g}" for amount in AMOUNTS)
    what = f"what tolerances are scaled by in planning; 0: a plan for the robot described alone (default {shown})"
    parser.add_argument("--amounts", metavar="X", nargs="+", type=float, default=AMOUNTS, help=what)
    what = f"margins of plans for the robot described alone beside (default {', '.join(map(str, MARGINS))})"
    parser.add_argument("--margins", metavar="MU", nargs="*", type=float, default=MARGINS, help=what)
    what = f"robots that plans are judged on (default {DRAWS})"
    parser.add_argument("--draws", metavar="N", type=whole, default=DRAWS, help=what)
    parser.add_argument("--seed", metavar="N", type=whole, default=SEED, help=f"of the draws (default {SEED})")
    what = f"share of the draws that a chosen plan may lose (default {MOST_LOST})"
    parser.add_argument("--most-lost", metavar="P", type=float, default=MOST_LOST, help=what)
    parser.add_argument("--no-figures", action="store_true", help="write no picture")
    add_out_option(parser, "runs/trade")
    add_problem_options(parser)
    add_compile_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    tasks = problems.load_all(arguments.problems or NAMES, arguments)
    check_folder(out, "trade")
    end_if_interrupted()
    found = list[list[Traded]]()
    count = len(asked(arguments.amounts, arguments.margins))
    with progress_bar() as labelled:
        for problem in tasks:
            every = arguments.amounts, arguments.margins, arguments.draws, arguments.seed
            found.append(traded(problem, *every, labelled(problem.name)))
            if len(found[-1]) < count:
                break
    interrupted = len(found) < len(tasks) or any(len(points) < count for points in found)
    place = place_of(out, interrupted)
    with published(place, "trade") as staging:
        _write(found, staging, arguments)
        files = sorted(path.name for path in staging.iterdir())
    for points in filter(None, found):
        print_table(points[0].problem, list(COLUMNS), _rows(points, arguments.most_lost))
        console().print(sentence(points, arguments.most_lost))
    wrote(place, files)
    if interrupted:
        return INTERRUPTED
    return SOLVED if all(chosen(points, arguments.most_lost) for points in found) else SOME_FAILED


def _rows(points: list[Traded], most_lost: float) -> list[list[str]]:
    best = chosen(points, most_lost)
    return [
        [
            *(planned_for(point.amount, point.margin), shown(point.planned), shown(point.mean)),
            f"{point.lost} of {point.draws}",
            "yes" if point.solved else "no",
            "chosen" if point is best else "",
        ]
        for point in points
    ]


def _write(found: list[list[Traded]], folder: Path, arguments: argparse.Namespace) -> None:
    most, page = arguments.most_lost, list[str]()
    every = [
        asdict(point) | {"lost_share": point.share, "chosen": point is chosen(points, most)}
        for points in found
        for point in points
    ]
    for points in filter(None, found):
        name = points[0].problem
        page.append(f"{name}\n\n{markdown(COLUMNS, _rows(points, most))}\n{sentence(points, most)}\n")
        if not arguments.no_figures:
            from ctr_nlp.figures import save  # brings matplotlib, which takes long to load
            from ctr_nlp.studies.trade_picture import picture

            for ending in ("png", "pdf"):
                save(picture(points, name, most), folder / f"{path_component(name)}.{ending}")
    (folder / "trade.md").write_text("\n".join(page), encoding="utf-8")
    (folder / "trade.json").write_text(json.dumps(every, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    write_csv(folder / "trade.csv", every)


main = Command("ctr-nlp trade", _parser, _run)
