"""Solve one problem with several formulations and solvers, and print errors and times side by side.

python scripts/compare.py cos
python scripts/compare.py bronchus --robot examples/bronchus_tubes.toml --variants horizon:banded:elastic
"""

import argparse
import time

import ctr_nlp as ctr
from ctr_nlp.cli.console import run_with_exit_status
from ctr_nlp.problems import PROBLEM_NAMES
from ctr_nlp.studies.variants import SOLVER_VARIANTS, parse_solver_variant


def main() -> int:
    """Compare solver variants on the problem that the command line names."""
    parser = argparse.ArgumentParser(
        description="Compare formulations and solvers on one problem.",
        epilog="Exit status: 0, 2 where input is bad.",
    )
    parser.add_argument("problem", metavar="PROBLEM", choices=PROBLEM_NAMES, help=", ".join(PROBLEM_NAMES))
    what = f"FORMULATION:SOLVER[:MODEL] (default: {', '.join(SOLVER_VARIANTS)})"
    parser.add_argument("--variants", nargs="+", default=SOLVER_VARIANTS, metavar="VARIANT", help=what)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--robot", metavar="FILE.toml", help="robot file (default: the paper's robot)")
    arguments = parser.parse_args()

    robot = None if arguments.robot is None else ctr.Robot.from_toml(arguments.robot)
    problem = ctr.named_problem(arguments.problem, arguments.frames, robot=robot)  # or ctr.problem_from_file(path)
    variants = {name: parse_solver_variant(name) for name in arguments.variants}
    print("variant                    e3 (mm)  solved  seconds")
    for name, variant in variants.items():
        begin = time.process_time()
        plan = variant.plan(problem, ctr.Settings(), (), None)
        seconds = time.process_time() - begin
        print(f"{name:26} {ctr.summary(plan)['e3']:7.3f}  {plan.success.sum():6}  {seconds:7.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_with_exit_status(main))
