"""`ctr-nlp choose`: compare robots on one path: which reaches its end, which comes nearest, and what binds."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from ctr_nlp.cli import plan_options, problems
from ctr_nlp.cli.arguments import (
    CHOICE_JOBS,
    DEFAULT_SETTINGS,
    add_compile_option,
    add_duration_option,
    add_frames_option,
    settings_from,
    whole,
)
from ctr_nlp.cli.console import EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.terminal_output import console, print_table, progress_bar, suggest_next
from ctr_nlp.exceptions import ProblemError
from ctr_nlp.ocp.settings import THRESHOLDS
from ctr_nlp.plan.measures import e3
from ctr_nlp.robot.shipped import read_robot_files
from ctr_nlp.support.interrupt import end_if_interrupted
from ctr_nlp.tube_design.choice import RobotChoice, compare_robots

CHOICE_TABLE_COLUMNS = (
    "robot",
    "outer mm",
    "reaches",
    "follows",
    "tip",
    "wall",
    "e3",
    "samples that hold",
    "what binds",
)


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Plan one path within a lumen for every robot of a folder, and list which of them reach its "
        "end, which comes nearest, and what keeps the others from it. By default each is planned as described "
        "alone, without tolerances, which takes some seconds a robot.",
        epilog="Exit status: 0 where a robot reaches the end, 1 where none does, 2 where input is bad, 130 after "
        "an interruption.",
    )
    parser.add_argument("problem", metavar="PROBLEM", help=problems.PROBLEM_ARGUMENT_HELP)
    what = "folder of robot files (.toml) that are compared (default: the robots that come with the package)"
    parser.add_argument("--robots", metavar="FOLDER", help=what)
    what = "plan for the robots' tolerances, too, and simulate 200 robots of each: about a minute a robot"
    parser.add_argument("--robust", action="store_true", help=what)
    what = f"processes side by side (default {CHOICE_JOBS})"
    parser.add_argument("--jobs", metavar="N", type=whole, default=CHOICE_JOBS, help=what)
    parser.set_defaults(robot=None, stability_margin=DEFAULT_SETTINGS.stability_margin)
    add_frames_option(parser)
    add_duration_option(parser)
    plan_options.add_file_options(parser)
    plan_options.add_threshold_options(parser)
    add_compile_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    problem = problems.load(arguments.problem, arguments)
    if problem.wall is None:
        raise ProblemError(
            f"no wall is known around {problem.name}; robots are compared within a lumen: give a path with radii, "
            "or a mask"
        )
    robots = read_robot_files(arguments.robots)
    settings = settings_from(arguments, *THRESHOLDS)
    problems.print_problem_notes(problem)
    end_if_interrupted()
    with progress_bar() as labelled:
        asked: dict[str, Any] = {"robust": arguments.robust, "settings": settings, "jobs": arguments.jobs}
        found = compare_robots(problem, robots, **asked, progress=labelled("robots are compared"))
    end_if_interrupted()
    print_table(f"{problem.name}, robots, in mm", list(CHOICE_TABLE_COLUMNS), [_row(one) for one in found])
    console().print(_conclusion(found, arguments.robust))
    if found[0].reaches:
        return EXIT_SOLVED
    words = ["design", arguments.problem, *problems.file_option_words(arguments), "--walls"]
    suggest_next(("tubes for this path", words if arguments.robust else [*words, "--nominal"]))
    return EXIT_SOME_FAILED


def _row(one: RobotChoice) -> list[Any]:
    """Return the table's row of a robot."""
    outer = max(tube.outer_diameter for tube in one.robot.tubes)
    if one.plan is None:
        return [one.name, outer, "no", "", "", "", None, "", one.reason]
    found = one.plan.verdicts
    binding = "" if one.binding is None else str(one.binding)
    reaches = "yes" if one.reaches else "no"
    return [
        *(one.name, outer, reaches, found.follows.word, found.arrives.value, found.within_wall.value),
        *(e3(one.plan), found.holds.value, binding),
    ]


def _conclusion(found: Sequence[RobotChoice], robust: bool) -> str:
    """Return a sentence on the best of the robots, which is the first."""
    reaching = [one.name for one in found if one.reaches]
    if reaching:
        checked = "" if robust else " as described; built robots differ: --robust simulates them"
        return f"{', '.join(reaching)} {'reach' if len(reaching) > 1 else 'reaches'} the end{checked}."
    nearest = found[0]
    if nearest.plan is None:
        return "None of the robots can be planned for on this path."
    return f"None of the robots reaches the end; {nearest.name} comes nearest."


main = Command("ctr-nlp choose", _parser, _run)
"""Compare robots on one path."""
