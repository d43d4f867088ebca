"""`ctr-nlp live`: steer a robot in the browser."""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

from ctr_nlp.cli import problems
from ctr_nlp.cli.arguments import add_compile_option, add_out_option, add_problem_options, whole
from ctr_nlp.cli.console import EXIT_INTERRUPTED, EXIT_SOLVED, Command
from ctr_nlp.cli.loads.options import (
    add_load_options,
    add_modulus_option,
    has_load,
    load_from,
    problem_with_modulus,
)
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.plan_options import add_file_options
from ctr_nlp.cli.plan_report import write
from ctr_nlp.cli.terminal_output import announce, print_stderr
from ctr_nlp.models import DEFAULT_MODEL, KINEMATIC_MODELS
from ctr_nlp.models.loads import Load, require_constant_load, with_modulus
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot, table_i_robot
from ctr_nlp.robot.shipped import read_robot
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.same_origin import is_loopback
from ctr_nlp.view.live import Live
from ctr_nlp.view.live.page.server import HOST, PORT
from ctr_nlp.view.live.steered.free import free_problem

USUAL = "bronchus"
"""Problem that is steered where none is named."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Steer a robot in the browser. Drag the target's tip or its handles, or slide single joints, "
        "and watch the robot follow within the lumen, with its error, stability margin and clearance. A recorded "
        "motion becomes a plan, which `ctr-nlp play` and `ctr-nlp robust` take. The page needs no network.",
        epilog="Ctrl-C ends it. Exit status: 130 after Ctrl-C, 2 where input is bad, a port is in use or there is "
        f"no C compiler. Examples: `{prog} arc`; `{prog} airway.csv --branch 3`; "
        f"`{prog} robot.toml --port 0`; `{prog} arc --youngs-modulus 60000 --force 0 0.1 0`.",
    )
    kinds = (
        f"{problems.PROBLEM_ARGUMENT_HELP}, or a robot file (.toml), whose robot then follows a path of "
        f"its own shape"
    )
    parser.add_argument("problem", metavar="PROBLEM", nargs="?", default=USUAL, help=f"{kinds} (default {USUAL})")
    parser.add_argument(
        "--model", choices=KINEMATIC_MODELS, default=DEFAULT_MODEL, help=f"(default {DEFAULT_MODEL})"
    )
    add_problem_options(parser)
    parser.add_argument(
        "--more-robots", metavar="FILE.toml", nargs="+", default=[], help="robots that can be chosen on the page"
    )
    add_load_options(parser, required=False)
    add_modulus_option(parser)
    add_compile_option(parser)
    add_out_option(parser, "runs/PROBLEM-live")
    group = parser.add_argument_group("where the page is served")
    group.add_argument("--host", metavar="ADDRESS", default=HOST, help=f"(default {HOST}: for this machine alone)")
    group.add_argument(
        "--port", metavar="N", type=whole, default=PORT, help=f"0: any that is free (default {PORT})"
    )
    add_file_options(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    problem = problem_with_modulus(_problem(arguments), arguments)
    load = _load(arguments)
    out = Path(arguments.out or f"runs/{path_component(problem.name)}-live")
    check_folder(_next(out), "plan")
    table_i = table_i_robot()
    modulus = arguments.youngs_modulus
    robots = {"Table I": table_i if modulus is None else with_modulus(table_i, modulus)}
    robots |= {Path(file).stem: read_robot(file) for file in arguments.more_robots}
    problems.print_problem_notes(problem)
    with deferred_interrupt() as interrupted:
        live = Live(
            problem,
            arguments.model,
            robots=robots,
            host=arguments.host,
            port=arguments.port,
            # Called in a thread of the recording: the next number is looked up only when the plan is there.
            save_plan=lambda plan: _save_recording(plan, _next(out)),
            load=load,
        )
        if not is_loopback(arguments.host):
            print_stderr(f"note: whoever reaches {live.url} can steer; nothing is encrypted, nobody is asked")
        announce(f"steer {problem.name} at {live.url}; Ctrl-C ends it")
        live.wait(interrupted)
        return EXIT_INTERRUPTED if interrupted() else EXIT_SOLVED


def _problem(arguments: argparse.Namespace) -> Problem:
    """Return the problem that is named, or that of a robot file alone."""
    if arguments.problem.endswith(".toml"):
        return free_problem(Path(arguments.problem).stem, Robot.from_toml(arguments.problem), arguments.frames)
    return problems.load(arguments.problem, arguments)


def _load(arguments: argparse.Namespace) -> Load | None:
    """Return the constant load on the robot, None where none was given; raises LoadError for one that changes."""
    return require_constant_load(load_from(arguments), "live steering") if has_load(arguments) else None


def _next(out: Path) -> Path:
    """Return a new folder within `out`, numbered from 1, so that no recording replaces another."""
    return next(folder for n in itertools.count(1) if not (folder := out / str(n)).exists())


def _save_recording(plan: Plan, folder: Path) -> str:
    """Write a plan into a folder, and return a sentence, without its full stop, that says where it is."""
    with output_folder(folder, "plan") as staging:
        write(plan, staging)
    return f"It is in {folder / 'plan.npz'}, for `ctr-nlp play` and `ctr-nlp robust`"


main = Command("ctr-nlp live", _parser, _run)
