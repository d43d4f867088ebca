"""The program behind scripts/solve_per_frame.py."""

from __future__ import annotations

import argparse
import csv
import json
from dataclasses import replace
from pathlib import Path

from ctr_nlp.cli import problems
from ctr_nlp.cli.arguments import add_file_options, add_problem_options, add_settings, read_start, settings_from
from ctr_nlp.cli.console import (
    INTERRUPTED,
    SOLVED,
    SOME_FAILED,
    console,
    guarded,
    print_table,
    progress_bar,
    shown,
)
from ctr_nlp.cli.output import check_folder, whole_folder
from ctr_nlp.figures import save_all
from ctr_nlp.formulations import FORMULATIONS
from ctr_nlp.metrics import by_frame, summary
from ctr_nlp.models import MODELS
from ctr_nlp.plan import Plan
from ctr_nlp.solvers import SOLVERS
from ctr_nlp.steer import DIRECTIONS, march
from ctr_nlp.steer.nlp_frames import NlpFrames


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
        "problem", metavar="PROBLEM", help=f"{', '.join(problems.names(folder))}, or a centreline file"
    )
    add_problem_options(parser)
    parser.add_argument("--formulation", choices=FORMULATIONS, default="joint", help="(default joint)")
    parser.add_argument("--model", choices=MODELS, default="dominant", help="(default dominant)")
    parser.add_argument("--solver", choices=SOLVERS, default="ipopt", help="(default ipopt)")
    parser.add_argument(
        "--direction", choices=DIRECTIONS, default="best", help="order in which frames are solved (default best)"
    )
    parser.add_argument("--start", metavar="Q.json", help="configuration at time 0, from which the motion leads")
    parser.add_argument("--lock-tilt", action="store_true", help="no arm: the tilt stays 0")
    parser.add_argument("--out", metavar="DIR", help="(default runs/PROBLEM-FORMULATION-MODEL)")
    add_file_options(parser)
    add_settings(parser)
    return parser


def _run(folder: Path, arguments: argparse.Namespace) -> int:
    settings = settings_from(arguments)
    problem = problems.load(arguments.problem, folder, arguments)
    if arguments.lock_tilt:
        problem = replace(problem, robot=problem.robot.with_locked_tilt())
    start = None if arguments.start is None else read_start(arguments.start)
    out = Path(arguments.out or f"runs/{problem.name}-{arguments.formulation}-{arguments.model}")
    check_folder(out)
    solver = NlpFrames(problem, arguments.formulation, arguments.solver, arguments.model, settings)
    with progress_bar() as labelled:
        plan = march(problem, solver, arguments.direction, start, labelled(problem.name))
    with whole_folder(out) as staging:
        write(plan, staging)
    _print(plan, out)
    if plan.meta["interrupted"]:
        return INTERRUPTED
    return SOLVED if plan.complete else SOME_FAILED


def write(plan: Plan, folder: Path) -> None:
    """plan.npz, errors.csv, summary.json and the pictures."""
    plan.save(folder / "plan.npz")
    columns = by_frame(plan)
    with open(folder / "errors.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
    text = json.dumps(summary(plan), indent=2, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    save_all(plan, folder)


def _print(plan: Plan, out: Path) -> None:
    found = summary(plan)
    steps, times = found["max_step"], found["solve_ms"]
    print_table(
        f"{found['problem']}, {found['formulation']} on {found['solver']}, {found['direction']}",
        ("", "value", "unit"),
        [
            ("e3, RMS over frames of e2", found["e3"], "mm"),
            ("e4, median over frames of e2", found["e4"], "mm"),
            ("largest error, at equal arc length", found["e_max"], "mm"),
            ("largest distance to the target", found["nearest_max"], "mm"),
            ("largest tip error", found["tip_max"], "mm"),
            ("largest step of alpha, beta, theta", " / ".join(map(shown, steps.values())), "rad / mm / rad"),
            ("time a frame, median and 99 %", f"{shown(times['median'])} / {shown(times['p99'])}", "ms"),
            ("frames, and of these not solved", f"{found['frames']} / {found['failed']}", ""),
        ],
    )
    if plan.meta["problem"]["deviation"]:
        console().print(f"smoothing moved the target by up to {plan.meta['problem']['deviation']:.3f} mm")
    if found["acceleration_used"] > 1:
        console().print(
            f"the motion needs {found['acceleration_used']:.1f} times the acceleration that limits allow"
        )
    for frame, why in plan.meta["failures"].items():
        console().print(f"frame {frame} not solved: {why}")
    if plan.meta["interrupted"]:
        console().print("interrupted: the plan holds what was solved until then")
    console().print(
        f"wrote {out}: {', '.join(sorted(path.name for path in out.iterdir() if path.name[0] != '.'))}"
    )
