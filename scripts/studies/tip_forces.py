"""Plans under forces at the tip, known ones and such as may come from any side: two tables a problem.

python scripts/studies/tip_forces.py [PROBLEM ...] [--robot FILE] [--planned N] [--forces N ...] [--known N]
    [--most-lost SHARE]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from force_robustness import FORCE_STUDY_SAMPLES, evaluate_under_forces, plan_with_known_force

from ctr_nlp import CtrError, Problem, Robot, problem_from_file
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.paths.named_problems import PROBLEM_NAMES, named_problem
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.support.tables import markdown


def main() -> None:
    """Read options, and print a row for every problem and force as it is known."""
    parser = argparse.ArgumentParser(description="What plans do under forces at the tip.")
    told = "names and centreline files (default: all names)"
    parser.add_argument("problems", metavar="PROBLEM", nargs="*", default=list(PROBLEM_NAMES), help=told)
    parser.add_argument("--robot", metavar="FILE.toml", help="(default: that of Table I, 2 %% and 0.02 rad off)")
    parser.add_argument("--modulus", metavar="MPA", type=float, default=60_000.0, help="(default 60000)")
    parser.add_argument("--frames", type=int, default=100, help="(default 100)")
    parser.add_argument(
        "--draws",
        type=int,
        default=FORCE_STUDY_SAMPLES,
        help=f"robots a plan is tried on (default {FORCE_STUDY_SAMPLES})",
    )
    told = "N that robust plans are made for, and N that they are tried under (default 0.1 and 0.1)"
    parser.add_argument("--planned", type=float, default=0.1, help=told)
    parser.add_argument(
        "--forces", type=float, nargs="*", default=[0.1], help="with none, no robust plans are made"
    )
    told = "share of all robots that robust plans may lose, each with a force from one side (default 0.01)"
    parser.add_argument("--most-lost", type=float, default=MOST_LOST, help=told)
    told = "N of a force across the robot that is known to the plan; 0 for no such plans (default 0.1)"
    parser.add_argument("--known", type=float, default=0.1, help=told)
    asked = parser.parse_args()
    robot = with_modulus(Robot.from_toml(asked.robot or "examples/robot.toml"), asked.modulus)
    problems = [_problem(name, asked.frames, robot) for name in asked.problems]
    for problem in problems:
        try:
            if asked.known:
                _print([asdict(plan_with_known_force(problem, asked.known))])
            if asked.forces:
                given = asked.planned, asked.forces, asked.draws, asked.most_lost
                _print([asdict(row) for row in evaluate_under_forces(problem, *given)])
        except CtrError as error:
            print(f"{problem.name}: {error}", flush=True)


def _problem(name: str, frames: int, robot: Robot) -> Problem:
    """Without a wall, whose cost would stand beside that of the force."""
    if name in PROBLEM_NAMES:
        problem = named_problem(name, frames, robot=robot)
    else:
        problem = problem_from_file(name, frames=frames, robot=robot)
    return replace(problem, lumen=None)


def _print(rows: Sequence[dict[str, Any]]) -> None:
    """As a table."""
    told = [[f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()] for row in rows]
    print(markdown(list(rows[0]), told), flush=True)


if __name__ == "__main__":
    main()
