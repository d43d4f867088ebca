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
    add_out_option,
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
from ctr_nlp.cli.names import path_component
from ctr_nlp.cli.output.folder import check_folder, place_of, published
from ctr_nlp.cli.report import exit_status, print_report, write
from ctr_nlp.formulations import FORMULATIONS
from ctr_nlp.solvers import SOLVERS
from ctr_nlp.steer import DIRECTIONS, march
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.requests import checked_ends
from ctr_nlp.support.interrupt import end_if_interrupted


def main(folder: Path, argv: list[str] | None = None) -> int:
    """Solve a problem frame by frame and write the plan; folder holds the named problems."""
    return guarded(lambda: _run(folder, _parser(folder).parse_args(argv)))


def _parser(folder: Path) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="solve_per_frame.py",
        description="Follow a target with the whole shape of the robot, frame by frame; write plan.npz, "
        "errors.csv, summary.json and pictures.",
        epilog="Exit status: 0 no verdict is no, 1 one is, 2 bad input, 130 interrupted (what was solved goes "
        "into DIR/interrupted, and DIR's own files stay).",
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
    add_out_option(parser, "runs/PROBLEM-FORMULATION-MODEL")
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
    default = f"runs/{path_component(problem.name)}-{arguments.formulation}-{arguments.model}"
    out = Path(arguments.out or default)
    film = film_file(arguments)
    check_folder(out, "plan", film)
    solver = NlpFrames.of(problem, arguments.formulation, arguments.solver, arguments.model, settings)
    problems.tell(problem)
    end_if_interrupted()
    with progress_bar() as labelled:
        plan = march(problem, solver, arguments.direction, start, labelled(problem.name))
    if arguments.evaluate is not None:
        plan = plan.on(arguments.evaluate)
    if not plan.reached.any():
        end_if_interrupted()
    place = place_of(out, plan.meta["interrupted"])
    with published(place, "plan") as staging:
        write(plan, staging)
        files = sorted(path.name for path in staging.iterdir())
        if film is not None:
            film = write_film([plan], film, out, place, staging)
    print_report(plan, place, files)
    if film is not None:
        console().print(f"wrote {film}")
    return exit_status(plan)
