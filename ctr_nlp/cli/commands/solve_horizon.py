"""The program behind scripts/solve_horizon.py."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from ctr_nlp.cli import live, problems
from ctr_nlp.cli.arguments import (
    add_compile_option,
    add_file_options,
    add_film_option,
    add_live_option,
    add_model_options,
    add_out_option,
    add_problem_options,
    add_stability_option,
    add_wall_options,
    film_file,
    read_start,
    walled,
    whole,
)
from ctr_nlp.cli.console import INTERRUPTED, console, guarded, progress_bar
from ctr_nlp.cli.film import write_film
from ctr_nlp.cli.names import path_component
from ctr_nlp.cli.output.folder import check_folder, place_of, published
from ctr_nlp.cli.report import exit_status, print_front, print_report, write, write_front
from ctr_nlp.formulations.settings import Settings, check_motion_weight
from ctr_nlp.plan.plan import Plan
from ctr_nlp.solvers import CHAIN_SOLVERS
from ctr_nlp.steer import Horizon
from ctr_nlp.steer.requests import check_search, checked_motions
from ctr_nlp.studies.trade_off import WEIGHTS, Point, trade_off
from ctr_nlp.support.interrupt import deferred_interrupt, end_if_interrupted
from ctr_nlp.target.problem import Problem


def main(folder: Path, argv: list[str] | None = None) -> int:
    """Solve a whole motion at once and write the plan; folder holds the named problems."""
    return guarded(lambda: _run(folder, _parser(folder).parse_args(argv)))


def _parser(folder: Path) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="solve_horizon.py",
        description="Follow a target with the whole shape of the robot, all frames in one program; write "
        "plan.npz, errors.csv, summary.json and pictures.",
        epilog="Exit status: 0 no verdict is no, 1 one is, 2 bad input, 130 interrupted (the best motion so far "
        "goes into DIR/interrupted, and DIR's own files stay).",
    )
    parser.add_argument(
        "problem", metavar="PROBLEM", help=f"{', '.join(problems.names(folder))}, or a centreline file or a mask"
    )
    add_problem_options(parser)
    add_model_options(parser)
    add_stability_option(parser)
    parser.add_argument("--solver", choices=CHAIN_SOLVERS, help="(default banded where there is a C compiler)")
    add_compile_option(parser)
    add_out_option(parser, "runs/PROBLEM-horizon-MODEL")
    add_film_option(parser)
    add_live_option(parser, "the motion as it is solved for, or with --jobs the best yet,")
    _add_motion(parser)
    _add_search(parser)
    add_file_options(parser)
    add_wall_options(parser)
    return parser


def _add_motion(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("the motion")
    group.add_argument("--start", metavar="Q.json", help="configuration at time 0, where the robot stands now")
    group.add_argument("--end", metavar="Q.json", help="configuration of the last frame")
    group.add_argument("--retract", action="store_true", help="plan the way back: the frames in opposite order")
    group.add_argument("--lock-tilt", action="store_true", help="no arm: the tilt stays 0")
    for kind, units in (("speed", "rad/s, mm/s, rad/s"), ("acceleration", "rad/s^2, mm/s^2, rad/s^2")):
        group.add_argument(
            f"--{kind}",
            metavar=("ALPHA", "BETA", "THETA"),
            nargs=3,
            type=float,
            help=f"largest {kind}s in {units} (default: the robot's)",
        )


def _add_search(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("weight and starts")
    group.add_argument(
        "--motion-weight",
        metavar="S2",
        type=float,
        help="lambda of the motion term in s^2 (default: motion costs a tenth of the start's shape errors)",
    )
    group.add_argument(
        "--sweep-motion-weight",
        metavar="S2",
        nargs="*",
        type=float,
        help="also solve for these weights and draw error against roughness beside other methods "
        f"(default {WEIGHTS[0]:g} to {WEIGHTS[-1]:g})",
    )
    group.add_argument(
        "--initial",
        metavar="PLAN.npz",
        nargs="+",
        default=[],
        help="plans to start from, instead of frame by frame",
    )
    group.add_argument("--starts", metavar="N", type=whole, help="motions to start from (default: all there are)")
    group.add_argument("--jobs", metavar="N", type=whole, default=1, help="processes for them (default 1)")
    group.add_argument("--seed", metavar="N", type=whole, default=0, help="of the random starts (default 0)")


def _run(folder: Path, arguments: argparse.Namespace) -> int:
    for weight in arguments.sweep_motion_weight or ():
        check_motion_weight(weight)
    problem = _problem(folder, arguments)
    out = Path(arguments.out or f"runs/{path_component(problem.name)}-horizon-{arguments.model}")
    film = film_file(arguments)
    check_folder(out, "plan", film)
    plan, points = _solved(arguments, problem)
    if arguments.evaluate is not None:
        plan = plan.on(arguments.evaluate)
    with deferred_interrupt() as pressed:
        interrupted = plan.meta["interrupted"] or (arguments.sweep_motion_weight is not None and pressed())
    place = place_of(out, interrupted)
    with published(place, "plan") as staging:
        write(plan, staging)
        if points:
            write_front(points, problem.name, staging)
        files = sorted(path.name for path in staging.iterdir())
        if film is not None:
            film = write_film([plan], film, out, place, staging)
    print_report(plan, place, files)
    if points:
        print_front(points)
    if film is not None:
        console().print(f"wrote {film}")
    return INTERRUPTED if interrupted else exit_status(plan)


def _solved(arguments: argparse.Namespace, problem: Problem) -> tuple[Plan, list[Point]]:
    """The plan, and the points of a sweep where one is asked for."""
    settings = Settings(seed=arguments.seed, stability_margin=arguments.stability_margin)
    settings = walled(settings, arguments, problem)
    start, end = (None if path is None else read_start(path) for path in (arguments.start, arguments.end))
    check_search(arguments.motion_weight, arguments.starts, arguments.jobs)
    initial = checked_motions(problem, [Plan.load(path).q for path in arguments.initial])
    points: list[Point] = []
    with live.solving(problem, arguments.model) if arguments.live else nullcontext() as seen:
        horizon = Horizon(problem, arguments.model, arguments.solver, start, end, settings)
        problems.tell(problem)
        end_if_interrupted()
        with progress_bar() as labelled:
            plan = horizon.solve(
                initial,
                arguments.motion_weight,
                arguments.starts,
                arguments.jobs,
                labelled(problem.name),
                seen,
            )
            if seen is not None:
                seen.ended(plan)
            if arguments.sweep_motion_weight is not None:
                weights = arguments.sweep_motion_weight or WEIGHTS
                points = trade_off(horizon, plan, weights, settings, labelled)
    return plan, points


def _problem(folder: Path, arguments: argparse.Namespace) -> Problem:
    """The problem with the robot and in the direction that arguments ask for."""
    problem = problems.load(arguments.problem, folder, arguments)
    robot = problem.robot.with_locked_tilt() if arguments.lock_tilt else problem.robot
    for kind in ("speed", "acceleration"):
        if getattr(arguments, kind) is not None:
            names = (f"alpha_{kind}", f"beta_{kind}", f"theta_{kind}")
            robot = robot.with_limits(**dict(zip(names, getattr(arguments, kind), strict=True)))
    problem = replace(problem, robot=robot)
    return problem.retraction() if arguments.retract else problem
