"""`ctr-nlp warm`: compile the programs that problems are solved with, before they are needed."""

from __future__ import annotations

import argparse
import os
import time

from ctr_nlp.cli import problems
from ctr_nlp.cli.arguments import add_problem_options
from ctr_nlp.cli.console import EXIT_INTERRUPTED, EXIT_SOLVED, Command
from ctr_nlp.cli.loads.options import (
    add_load_options,
    add_modulus_option,
    model_from_options,
    problem_with_modulus,
)
from ctr_nlp.cli.terminal_output import console, print_stderr, print_table, progress_bar
from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS, suits
from ctr_nlp.paths.named_problems import PROBLEM_NAMES
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.per_frame import solve_per_frame
from ctr_nlp.support.interrupt import deferred_interrupt

WARM_FRAME_COUNT = 3
"""Frames of each problem; what is compiled does not depend on their number."""
BUILDS = {
    "frame by frame": lambda problem, model: solve_per_frame(problem, model=model),
    "horizon": lambda problem, model: solve_horizon(problem, model=model),
}
"""Ways to plan: planning a few frames compiles all that plans of the same structure need."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Compile what problems are solved with, frame by frame and over a horizon, so that their "
        "first plans need not wait. What is in the cache already stays there. Under a load the same "
        "programs serve all loads that keep their direction.",
        epilog="Exit status: 0 where all was compiled, 2 where input is bad or there is no C compiler, 130 "
        "after an interruption (what was compiled stays).",
    )
    parser.add_argument(
        "problems", metavar="PROBLEM", nargs="*", help=f"{problems.PROBLEM_ARGUMENT_HELP} (default all names)"
    )
    parser.add_argument(
        "--models", nargs="+", choices=KINEMATIC_MODELS, default=list(KINEMATIC_MODELS), help="(default all)"
    )
    add_problem_options(parser)
    add_load_options(parser, required=False)
    add_modulus_option(parser)
    parser.set_defaults(frames=WARM_FRAME_COUNT)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if why := cache.unavailable_reason():
        raise OptionError(f"nothing can be compiled: {why}")
    os.environ[cache.COMPILE_VARIABLE] = "now"
    named = problems.load_all(arguments.problems or PROBLEM_NAMES, arguments)
    chosen = [problem_with_modulus(problem, arguments) for problem in named]
    tasks = [
        (problem, model, how)
        for problem in chosen
        for model in arguments.models
        if suits(problem.robot, model)
        for how in BUILDS
    ]
    rows = list[tuple[str, str, str, float]]()
    with deferred_interrupt() as interrupted, progress_bar() as labelled:
        report = labelled("compiling")
        for number, (problem, model, how) in enumerate(tasks):
            if interrupted():
                break
            report(number, len(tasks), f"{problem.name}, {model}, {how}")
            begin = time.perf_counter()
            BUILDS[how](problem, model_from_options(model, arguments))
            rows.append((problem.name, model, how, time.perf_counter() - begin))
        stopped = len(rows) < len(tasks)
    print_table("ready", ("problem", "model", "how", "s"), rows, text=("model", "how"))
    console().print(f"kept in {cache.folder()}")
    if stopped:
        print_stderr("interrupted; what was compiled is kept")
    return EXIT_INTERRUPTED if stopped else EXIT_SOLVED


main = Command("ctr-nlp warm", _parser, _run)
