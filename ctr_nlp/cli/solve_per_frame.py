"""The program behind scripts/solve_per_frame.py."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from ctr_nlp.cli import problems
from ctr_nlp.cli.arguments import (
    add_compile_option,
    add_file_options,
    add_film_option,
    add_model_options,
    add_problem_options,
    add_settings,
    add_wall_options,
    film_file,
    read_start,
    settings_from,
    walled,
)
from ctr_nlp.cli.console import console, guarded, progress_bar
from ctr_nlp.cli.film import write_film
from ctr_nlp.cli.output import check_folder, whole_folder
from ctr_nlp.cli.report import exit_status, print_report, write
from ctr_nlp.formulations import FORMULATIONS
from ctr_nlp.solvers import SOLVERS
from ctr_nlp.steer import DIRECTIONS, march
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.requests import checked_ends


def main(folder: Path, argv: list[str] | None = None) -> int:
    """Solve a problem frame by frame and write the plan; folder holds the named problems."""
    return guarded(lambda: _run(folder, _parser(folder).parse_args(argv)))


def _parser(folder: Path) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="solve_per_frame.py",
        description="Follow a target with the whole shape of the robot, frame by frame; write plan.npz, "
        "errors.csv, summary.json and pictures.",
        epilog="Exit status: 0 every frame solved, 1 some not, 2 bad input, 130 interrupted.",
    )
    parser.add_argument(
        "problem", metavar="PROBLEM", help=f"{', '.join(problems.names(folder))}, or a centreline file or a mask"
    )
    add_problem_options(parser)
    parser.add_argument("--formulation", choices=FORMULATIONS, default="joint", help="(default joint)")
    add_model_options(parser)
    parser.add_argument("--solver", choices=SOLVERS, help="(default sqp where there is a C compiler)")
    parser.add_argument(
        "--direction", choices=DIRECTIONS, default="best", help="order in which frames are solved (default best)"
    )
    parser.add_argument("--start", metavar="Q.json", help="configuration at time 0, from which the motion leads")
    parser.add_argument("--lock-tilt", action="store_true", help="no arm: the tilt stays 0")
    add_compile_option(parser)
    parser.add_argument("--out", metavar="DIR", help="(default runs/PROBLEM-FORMULATION-MODEL)")
    add_film_option(parser)
    add_file_options(parser)
    add_wall_options(parser)
    add_settings(parser)
    return parser


def _run(folder: Path, arguments: argparse.Namespace) -> int:
    problem = problems.load(arguments.problem, folder, arguments)
    settings = walled(settings_from(arguments), arguments, problem)
    if arguments.lock_tilt:
        problem = replace(problem, robot=problem.robot.with_locked_tilt())
    start = None if arguments.start is None else read_start(arguments.start)
    checked_ends(problem, arguments.direction, start)
    out = Path(arguments.out or f"runs/{problem.name}-{arguments.formulation}-{arguments.model}")
    check_folder(out)
    film = film_file(arguments)
    solver = NlpFrames(problem, arguments.formulation, arguments.solver, arguments.model, settings)
    problems.tell(problem)
    with progress_bar() as labelled:
        plan = march(problem, solver, arguments.direction, start, labelled(problem.name))
    if arguments.evaluate is not None:
        plan = plan.on(arguments.evaluate)
    with whole_folder(out) as staging:
        write(plan, staging)
        if film is not None:
            write_film([plan], film, out, staging)
    print_report(plan, out)
    if film is not None:
        console().print(f"wrote {film}")
    return exit_status(plan)
