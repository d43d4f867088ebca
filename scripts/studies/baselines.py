"""`python scripts/studies/baselines.py`: compare the design of tubes with general optimisers."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

from tube_optimisers.race import DESIGN_OPTIMISERS, OptimiserRun, improvement_rows, race_optimisers, seconds_to

from ctr_nlp.cli import plan_options, problems
from ctr_nlp.cli.arguments import (
    add_compile_option,
    add_out_option,
    add_problem_options,
    add_settings,
    settings_from,
    whole,
)
from ctr_nlp.cli.console import EXIT_INTERRUPTED, EXIT_SOLVED, Command
from ctr_nlp.cli.output.file import write_text
from ctr_nlp.cli.output.folder import check_folder, output_folder, results_folder
from ctr_nlp.cli.studies.design import add_rules, rules_from
from ctr_nlp.cli.terminal_output import busy, print_table, report_written_files
from ctr_nlp.support.interrupt import end_if_interrupted
from ctr_nlp.support.tables import markdown, write_csv
from ctr_nlp.tube_design.co_design import STARTS
from ctr_nlp.tube_design.request import draft, search_for

BASELINE_TABLE_COLUMNS = "method", "best e3 mm", "process s", "design as good after s", "tubes tried"


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Design tubes for several targets as `ctr-nlp design --nominal` does, and then search for "
        "them with CMA-ES and Nelder-Mead, which plan the motions of every robot that they try, for as long. Draw "
        "the least root mean square of the targets' e3 over process time. Write baselines.md, .csv, .png and "
        ".pdf. CMA-ES needs the package cma (pip install ctr_nlp[studies]).",
        epilog="Exit status: 0 where all is done, 2 where input is bad, 130 after an interruption.",
    )
    parser.add_argument("problems", metavar="PROBLEM", nargs="+", help=problems.PROBLEM_ARGUMENT_HELP)
    what = f"tubes that the design is started from (default {STARTS})"
    parser.add_argument("--starts", metavar="N", type=whole, default=STARTS, help=what)
    what = "how many times the design's process time the others may take (default 1)"
    parser.add_argument("--times", metavar="X", type=float, default=1.0, help=what)
    add_rules(parser)
    add_out_option(parser, "runs/baselines")
    add_problem_options(parser)
    add_settings(parser, "a tenth of a plain horizon's", jumps=False)
    plan_options.add_file_options(parser)
    add_compile_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    settings = settings_from(arguments, "seed")
    tasks = problems.load_all(arguments.problems, arguments)
    search = search_for(tasks, rules=rules_from(arguments), settings=settings)
    search = replace(search, tasks=tuple(draft(task) for task in search.tasks))
    check_folder(out, "baselines")
    end_if_interrupted()
    with busy("tubes are designed by each method in turn"):
        runs = race_optimisers(search, arguments.starts, settings.seed, arguments.times)
    names = [task.name for task in tasks]
    interrupted = len(runs) < len(DESIGN_OPTIMISERS)
    place = results_folder(out, interrupted)
    with output_folder(place, "baselines") as staging:
        _write(runs, names, staging)
    print_table(f"one robot for {', '.join(names)}", list(BASELINE_TABLE_COLUMNS), _rows(runs))
    report_written_files(place)
    return EXIT_INTERRUPTED if interrupted else EXIT_SOLVED


def _rows(runs: list[OptimiserRun]) -> list[list[str]]:
    design = runs[0]
    return [
        [
            run.method,
            f"{run.best:.3f}" if math.isfinite(run.best) else "",
            f"{run.seconds[-1]:.0f}" if len(run.seconds) else "",
            f"{seconds_to(design, run.best):.0f}" if math.isfinite(seconds_to(design, run.best)) else "never",
            f"{run.evaluations}",
        ]
        for run in runs
    ]


def _write(runs: list[OptimiserRun], names: list[str], folder: Path) -> None:
    from tube_optimisers.picture import draw_optimiser_race

    from ctr_nlp.view.figures import save  # brings matplotlib, which takes long to load

    write_csv(folder / "baselines.csv", improvement_rows(runs))
    write_text(
        folder / "baselines.md",
        f"One robot for {', '.join(names)}\n\n{markdown(BASELINE_TABLE_COLUMNS, _rows(runs))}\n",
    )
    for ending in ("png", "pdf"):
        save(draw_optimiser_race(runs, names), folder / f"baselines.{ending}")


main = Command("baselines.py", _parser, _run)

if __name__ == "__main__":
    sys.exit(main())
