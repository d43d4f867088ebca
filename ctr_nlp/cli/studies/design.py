"""`ctr-nlp design`: choose tubes together with the motions of several problems."""

from __future__ import annotations

import argparse
import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from ctr_nlp.cli import plan_options, problems
from ctr_nlp.cli.arguments import (
    add_compile_option,
    add_figures_option,
    add_numbers,
    add_out_option,
    add_problem_options,
    add_settings,
    settings_from,
    whole,
)
from ctr_nlp.cli.console import EXIT_INTERRUPTED, EXIT_SOLVED, Command
from ctr_nlp.cli.loads.options import (
    add_load_options,
    add_modulus_option,
    model_from_options,
    problem_with_modulus,
)
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder, output_folder, results_folder
from ctr_nlp.cli.plan_options import pieces_from, read_options_from, with_tip_force_option
from ctr_nlp.cli.plan_report import exit_status
from ctr_nlp.cli.studies.design_output import (
    DesignWithPlans,
    EvaluatedPlan,
    print_designs,
    print_left_out,
    write_designs,
)
from ctr_nlp.cli.terminal_output import busy, progress_bar, report_written_files, suggest_next
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS, Model
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.shared.manufacture import Manufacture
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.marching import Progress
from ctr_nlp.robot.shipped import read_robot, read_robot_files
from ctr_nlp.studies.workers.clients import cluster_client
from ctr_nlp.support.interrupt import end_if_interrupted
from ctr_nlp.support.pool import Jobs, run_in_parallel
from ctr_nlp.tube_design.co_design import STARTS, design
from ctr_nlp.tube_design.groups import assign_to_robots, divide_problems
from ctr_nlp.tube_design.leave_one_out import HeldOutEnd, leave_one_out
from ctr_nlp.tube_design.plans import on_tubing_as_sold, plan_tasks
from ctr_nlp.tube_design.stock import read_stock

DESIGN_CHECK_SAMPLES, DESIGN_CHECK_SEED = 500, 0
"""Number and seed of the simulated robots on which every plan is evaluated; design and planning do not see
them.
"""
NOT_WITH_EVERY_END = (
    *("branch", "branches", "target", "insertion", "tilt", "reverse"),
    *("wall_of_mask", "keep_out", "inside"),
)
"""Options for single paths, which do not go with all ends of a tree."""
RULES = {
    "wall": "least thickness of a tube's wall, mm",
    "channel": "least inner diameter of the innermost tube, mm",
    "outer": "largest outer diameter, mm",
    "clearance": "by how much a tube's inner diameter exceeds the next one's outer diameter, mm",
    "strain_made": "largest strain of a tube when it is bent into its curvature, as a part",
    "strain_deployed": "largest strain of the aligned robot's tubes, as a part",
    "bend_radius": "least radius of any tube's curvature, mm",
}
"""Rules of manufacture that are options, and their help."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Choose the tubes of one robot together with its motions along several targets: "
        "curvatures, lengths of curved parts and diameters, within what can be made of Nitinol. By "
        "default for all robots within the tolerances of the robot file, so that plans survive on robots as "
        "built. Write robot.toml, a plan of every problem, design.json and a drawing sheet (sheet.svg, "
        "sheet.pdf), with several robots in a folder for each, robot_1 and so on.",
        epilog="Exit status: 0 where no verdict on a plan is `no`, 1 where one is, 2 where input is bad, 130 "
        "after an interruption. `ctr-nlp plan PROBLEM --robot DIR/robot.toml` plans "
        "further problems on the robot.",
    )
    kinds = f"{problems.PROBLEM_ARGUMENT_HELP}, or a folder of centreline files"
    parser.add_argument("problems", metavar="PROBLEM", nargs="+", help=kinds)
    what = "problems that are planned on the designed robot, which is not designed for them, or a folder of them"
    parser.add_argument("--hold-out", metavar="PROBLEM", nargs="+", default=[], help=what)
    parser.add_argument("--nominal", action="store_true", help="leave tolerances out")
    what = "choose the tubes within the walls, so that most ends are reached; by default as if there were no "
    what += "walls, for the least mean error"
    parser.add_argument("--walls", action="store_true", help=what)
    parser.add_argument("--constant-curvature", action="store_true", help="all curved parts are arcs")
    what = "numbers that stay as they are, such as outer_diameter_1 or curved_length_3"
    parser.add_argument("--fix", metavar="NAME", nargs="+", default=[], help=what)
    what = "round the tubes to Nitinol tubing that can be bought, and lengths and curvatures to what can be made; "
    what += "FILE: your own list, with columns part, outer_diameter_mm and inner_diameter_mm (or _in for inches), "
    what += "instead of the package's short one"
    parser.add_argument("--stock", metavar="FILE", nargs="?", const="", help=what)
    what = "robots that are designed, each for the problems that it follows best (default 1); a problem that is "
    what += "held out takes the one that follows it best"
    parser.add_argument("--robots", metavar="K", type=whole, default=1, help=what)
    what = f"number of initial designs, the robot's own tubes and random ones (default {STARTS})"
    parser.add_argument("--starts", metavar="N", type=whole, default=STARTS, help=what)
    what = "model that is designed on; on the dominant one stiffness does not count, and no tube can snap "
    what += "(default elastic)"
    parser.add_argument("--model", choices=KINEMATIC_MODELS, default="elastic", help=what)
    what = "several branches of each file of anatomy, each a problem of its own; `ctr-nlp branches` lists them"
    parser.add_argument("--branches", metavar="NAME|NUMBER", nargs="+", help=what)
    what = "every end of each file's tree that is wide enough for the robot, each a problem of its own; without "
    what += "--robot for the first one of the package, instead of the paper's"
    parser.add_argument("--every-end", action="store_true", help=what)
    what = "goes with --every-end: insert robots at the main bifurcation, up to which a rigid tube guides them"
    parser.add_argument("--from-carina", action="store_true", help=what)
    what = "also design for all files but one, in turn, and report how many ends of that one are reached; goes "
    what += "with --walls, and takes as many times longer as there are files"
    parser.add_argument("--leave-one-out", action="store_true", help=what)
    add_rules(parser)
    add_load_options(parser, required=False)
    plan_options.add_tip_force(parser)
    add_modulus_option(parser)
    parser.add_argument("--jobs", metavar="N", type=whole, default=2, help="processes side by side (default 2)")
    what = "scheduler of a Dask cluster on which problems are worked on instead, as tcp://HOST:PORT (extra "
    what += "study): for cohorts of dozens of problems and more"
    parser.add_argument("--address", metavar="URL", help=what)
    add_out_option(parser, "runs/design")
    add_figures_option(parser)
    add_problem_options(parser)
    add_settings(parser, "a tenth of a plain horizon's", jumps=False)
    plan_options.add_file_options(parser)
    add_compile_option(parser)
    return parser


def add_rules(parser: argparse.ArgumentParser) -> None:
    """Add the options for the rules of manufacture, `RULES`, to `parser`."""
    defaults = Manufacture()
    group = parser.add_argument_group("rules of manufacture")
    for name, what in RULES.items():
        option = name.replace("_", "-"), "X" if name.startswith("strain") else "MM"
        add_numbers(group, (*option, f"{what} (default {getattr(defaults, name):g})"))
    what = "no tube is shaped like an S, bent to one side at its root and to the other at its tip"
    group.add_argument("--one-sided", action="store_true", help=what)


def rules_from(arguments: argparse.Namespace) -> Manufacture:
    """Return the rules of manufacture from add_rules' options in `arguments`; raises OptionError."""
    given = {name: value for name in RULES if (value := getattr(arguments, name)) is not None}
    return Manufacture(**given, one_sided=arguments.one_sided)


def _run(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    designed_for = problems.expand_folders(arguments.problems)
    held_out = problems.expand_folders(arguments.hold_out)
    if arguments.leave_one_out and not arguments.walls:
        raise OptionError("--leave-one-out goes with --walls: an end counts as reached within walls alone")
    _check_every_end(arguments)
    anatomies = [_load(name, arguments) for name in designed_for]
    tasks = [task for each in anatomies for task in each]
    held = [task for name in held_out for task in _load(name, arguments)]
    model = model_from_options(arguments.model, arguments)
    if twice := [name for name, count in Counter(task.name for task in (*tasks, *held)).items() if count > 1]:
        raise OptionError(
            f"two problems are called {twice[0]}; plans are written under these names, rename a file"
        )
    rules = rules_from(arguments)
    settings = settings_from(arguments, "seed")
    stock = None if arguments.stock is None else read_stock(arguments.stock or None)
    if arguments.nominal and arguments.tip_force is not None:
        raise OptionError("--tip-force goes with tolerances, which --nominal leaves out; leave one of them out")
    check_folder(out, "design")
    end_if_interrupted()
    alike: dict[str, Any] = {
        "model": model,
        "rules": rules,
        "fixed": arguments.fix,
        "constant_curvature": arguments.constant_curvature,
        "settings": settings,
    }
    with _workers(arguments) as jobs, progress_bar() as labelled:
        alike["jobs"] = jobs
        alike["walls"] = arguments.walls
        groups = divide_problems(tasks, arguments.robots, progress=labelled("groups"), **alike)
        only: dict[str, Any] = {name: getattr(arguments, name) for name in ("nominal", "starts")}
        if arguments.walls and len(groups) > 1:
            # Groups within walls come with tubes that were found from several starts.
            only["starts"] = 1
        made = list[DesignWithPlans]()
        for number, group in enumerate(groups, start=1):
            label = f"design {number} of {len(groups)}" if len(groups) > 1 else "design"
            found = design(group, stock=stock, progress=labelled(label), **only, **alike)
            made.append(DesignWithPlans(found, tuple(EvaluatedPlan(plan) for plan in found.plans)))
            if found.interrupted:
                break
        interrupted = made[-1].design.interrupted
        left_out = list[HeldOutEnd]()
        if arguments.leave_one_out and not interrupted:
            asked = {name: value for name, value in alike.items() if name != "walls"}
            shown = labelled("leave one out")
            left_out = leave_one_out(
                anatomies, arguments.robots, nominal=arguments.nominal, progress=shown, **asked
            )
        if not interrupted:
            made = _plan_held_out(made, held, settings, model, arguments, jobs, labelled)
    place = results_folder(out, interrupted)
    with output_folder(place, "design") as staging:
        write_designs(made, staging, nominal=arguments.nominal, figures=not arguments.no_figures)
    print_designs(made, arguments.nominal, arguments.walls)
    if left_out:
        print_left_out(designed_for, left_out, arguments.nominal)
    report_written_files(place)
    if interrupted:
        return EXIT_INTERRUPTED
    if len(made) == 1 and len(arguments.problems) == 1:
        suggest_next(("a plan for these tubes", ["plan", arguments.problems[0], "--robot", place / "robot.toml"]))
    plans = [tried.plan for one in made for tried in one.evaluated_plans]
    return max((exit_status(plan) for plan in plans), default=EXIT_SOLVED)


def _workers(arguments: argparse.Namespace) -> AbstractContextManager[Jobs]:
    """Return the number of processes, or a client of the cluster, that work on problems; raises ClusterError."""
    if arguments.address is None:
        return nullcontext(arguments.jobs)
    return cluster_client(arguments.address)


def _plan_held_out(
    designs: Sequence[DesignWithPlans],
    held_out: Sequence[Problem],
    settings: Settings,
    model: Model,
    arguments: argparse.Namespace,
    jobs: Jobs,
    labelled: Callable[[str], Progress],
) -> list[DesignWithPlans]:
    """Return designs with plans of the held-out problems, each on the robot that follows it best, and evaluate all
    plans on simulated robots.

    designs: the designs. held_out: the held-out problems. labelled: turns a label into a progress callback.
    """
    robots = [one.design.robot for one in designs]
    choice = (
        assign_to_robots(held_out, robots, settings, jobs, model, arguments.walls)
        if held_out and len(robots) > 1
        else [0] * len(held_out)
    )
    on = [replace(task, robot=robots[k]) for task, k in zip(held_out, choice, strict=True)]
    asked: dict[str, Any] = {"model": model, "walls": arguments.walls, "jobs": jobs}
    plans = plan_tasks(on, settings, arguments.nominal, **asked, progress=labelled("held out"))
    whole = [[*one.design.plans, *(plan for plan in plans if plan.robot == one.design.robot)] for one in designs]
    # After Ctrl-C results are missing; those plans are kept without an evaluation.
    tried = dict(run_in_parallel(_evaluate_on_samples, [plan for each in whole for plan in each], jobs))
    numbers = itertools.count()
    return [
        DesignWithPlans(one.design, tuple(tried.get(next(numbers), EvaluatedPlan(plan)) for plan in each))
        for one, each in zip(designs, whole, strict=True)
    ]


def _evaluate_on_samples(plan: Plan) -> EvaluatedPlan:
    """Evaluate a plan on simulated robots, and on ones of tubing as sold, where any of its frames was reached."""
    if not plan.reached_frames.any():
        return EvaluatedPlan(plan)
    return EvaluatedPlan(
        plan.with_samples(DESIGN_CHECK_SAMPLES, DESIGN_CHECK_SEED),
        on_tubing_as_sold(plan, DESIGN_CHECK_SAMPLES, DESIGN_CHECK_SEED),
    )


def _load(name: str, arguments: argparse.Namespace) -> list[Problem]:
    """Return the problems of one name or file: one, or one for each of --branches."""
    if arguments.every_end and problems.is_anatomy(name):
        return _load_every_end(name, arguments)
    branches = arguments.branches if problems.is_anatomy(name) else None
    if branches is not None and arguments.branch is not None:
        raise OptionError("--branches does not go with --branch; leave one of them out")
    found = list[Problem]()
    for branch in branches or [arguments.branch]:
        asked = argparse.Namespace(**(vars(arguments) | {"branch": branch}))
        problem = problem_with_modulus(problems.load(name, asked), arguments)
        problem = _with_file_name(name, with_tip_force_option(problem, arguments))
        found.append(replace(problem, name=f"{problem.name}-{path_component(branch)}") if branches else problem)
    return found


def _load_every_end(name: str, arguments: argparse.Namespace) -> list[Problem]:
    """Return the problem of every end of a file's tree that is wide enough for the robot."""
    # Readers of anatomy are loaded where a file of anatomy is named, and not for a named problem.
    from ctr_nlp.anatomy.lumen_tree import read_lumen_tree
    from ctr_nlp.studies.reach.end_problems import end_problems

    with busy(f"{name} is read"):
        tree = read_lumen_tree(
            name,
            arguments.entry,
            from_carina=arguments.from_carina,
            options=read_options_from(arguments),
            pieces=pieces_from(arguments),
        )
    # The paper's robot is too thick for most ends of an airway tree.
    robot = next(iter(read_robot_files().values())) if arguments.robot is None else read_robot(arguments.robot)
    trim, smoothing = arguments.trim is not None, arguments.smoothing
    found = end_problems(tree, robot, arguments.frames, arguments.duration, trim=trim, smoothing=smoothing)
    return [
        replace(each, name=path_component("-".join(each.name.rsplit(" ", 1))))
        for each in (problem_with_modulus(with_tip_force_option(one, arguments), arguments) for one in found)
    ]


def _check_every_end(arguments: argparse.Namespace) -> None:
    """Raise OptionError where options contradict --every-end, or go with it and it is missing."""
    if not arguments.every_end:
        if arguments.from_carina:
            raise OptionError("--from-carina goes with --every-end; add it, or give --entry X Y Z")
        return
    if not any(map(problems.is_anatomy, arguments.problems)):
        raise OptionError(f"--every-end goes with a mask or a centreline file; {arguments.problems[0]} is none")
    if arguments.from_carina and arguments.entry is not None:
        raise OptionError("--from-carina does not go with --entry; leave one of them out")
    if arguments.trim == "end":
        raise OptionError("--trim end does not go with --every-end, whose ends would not be reached; use start")
    given = next((name for name in NOT_WITH_EVERY_END if getattr(arguments, name) is not None), None)
    if given is not None:
        raise OptionError(
            f"--{given.replace('_', '-')} does not go with --every-end, for which each end has its own path and "
            "the tree its wall; leave one of them out"
        )


def _with_file_name(name: str, problem: Problem) -> Problem:
    """Return the problem under the name that its files get; `name` is that on the command line."""
    return replace(problem, name=path_component(problem.name or Path(name).stem))


main = Command("ctr-nlp design", _parser, _run)
