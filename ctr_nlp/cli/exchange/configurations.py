"""`ctr-nlp import`: make a plan of configurations that another program has found."""

from __future__ import annotations

import argparse
from pathlib import Path

from ctr_nlp.cli import problems
from ctr_nlp.cli.arguments import ROBOT_HELP, add_figures_option, add_out_option
from ctr_nlp.cli.console import Command
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.plan_options import (
    add_check_options,
    add_file_options,
    add_threshold_options,
    evaluate_plan,
    with_thresholds,
)
from ctr_nlp.cli.plan_report import draw, exit_status, print_report, write
from ctr_nlp.cli.terminal_output import report_written_files
from ctr_nlp.models import DEFAULT_MODEL, KINEMATIC_MODELS
from ctr_nlp.paths.problem import Problem
from ctr_nlp.typing import Array
from ctr_nlp.view.exchange.configurations import plan_through, read_configurations

DURATION = 10.0
"""Duration, s, where neither the file nor an option gives one."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Make a plan of configurations that another program has found: move the robot of a problem "
        "through them, and judge the motion as any plan. Write plan.npz, errors.csv, summary.json and pictures; "
        "`ctr-nlp report`, `robust`, `under`, `export` and `play` take that plan as any other.",
        epilog="A .mat file (up to version 7) has q, of size T x (2d + 2), a row a frame: alpha_1.. in rad, "
        "beta_1.. in mm, theta_x and theta_y in rad, and may have time in s. A .csv file has the columns "
        "alpha_1_rad.., beta_1_mm.., theta_x_rad, theta_y_rad, and may have time_s. Exit status: 0 where no "
        "verdict is `no`, 1 where one is, 2 where input is bad and nothing is written.",
    )
    parser.add_argument("configurations", metavar="Q.mat|Q.csv")
    what = (
        f"what they are to follow, in as many frames as there are configurations: {problems.PROBLEM_ARGUMENT_HELP}"
    )
    parser.add_argument("--problem", metavar="PROBLEM", required=True, help=what)
    parser.add_argument("--robot", metavar="FILE.toml|NAME", help=ROBOT_HELP)
    what = f"model on which shapes and margins are found (default: {DEFAULT_MODEL})"
    parser.add_argument("--model", choices=sorted(KINEMATIC_MODELS), default=DEFAULT_MODEL, help=what)
    what = f"of the motion, in seconds (default: from the file's times, else {DURATION:g})"
    parser.add_argument("--duration", metavar="S", type=float, help=what)
    add_out_option(parser, "runs/PROBLEM-import")
    add_figures_option(parser)
    add_check_options(parser)
    add_threshold_options(parser)
    add_file_options(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    problem, q = _read(arguments)
    out = Path(arguments.out or f"runs/{path_component(problem.name)}-import")
    check_folder(out, "import")
    plan = plan_through(problem, q, arguments.model, Path(arguments.configurations).name)
    plan = evaluate_plan(with_thresholds(plan, arguments), arguments)
    with output_folder(out, "import") as staging:
        write(plan, staging)
        if not arguments.no_figures:
            draw(plan, (), staging)
        files = sorted(path.name for path in staging.iterdir())
    print_report(plan)
    report_written_files(out, files)
    return exit_status(plan)


def _read(arguments: argparse.Namespace) -> tuple[Problem, Array]:
    """Return the problem, in as many frames as there are configurations, and these (T, 2d + 2); raises
    CtrError.
    """
    found = read_configurations(arguments.configurations)
    duration = next(each for each in (arguments.duration, found.duration, DURATION) if each is not None)
    asked = argparse.Namespace(**vars(arguments) | {"frames": len(found.q), "duration": duration})
    return problems.load(arguments.problem, asked), found.q


main = Command("ctr-nlp import", _parser, _run)
