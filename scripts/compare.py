"""Solve one problem with several formulations and solvers, and print errors and times side by side.

python scripts/compare.py cos
"""

import argparse
import time

import ctr_nlp as ctr
from ctr_nlp.problems import PROBLEM_NAMES
from ctr_nlp.studies.variants import SOLVER_VARIANTS, parse_solver_variant


def main() -> int:
    """Compare solver variants on the problem that the command line names."""
    parser = argparse.ArgumentParser(
        description="Compare formulations and solvers on one problem.", epilog="Exit status: 0."
    )
    parser.add_argument("problem", metavar="PROBLEM", choices=PROBLEM_NAMES, help=", ".join(PROBLEM_NAMES))
    what = f"FORMULATION:SOLVER[:MODEL] (default: {', '.join(SOLVER_VARIANTS)})"
    parser.add_argument("--variants", nargs="+", default=SOLVER_VARIANTS, metavar="VARIANT", help=what)
    parser.add_argument("--frames", type=int, default=100)
    arguments = parser.parse_args()

    problem = ctr.named_problem(arguments.problem, arguments.frames)  # or ctr.problem_from_file(path)
    print("variant                    e3 (mm)  solved  seconds")
    for name in arguments.variants:
        variant = parse_solver_variant(name)
        begin = time.process_time()
        plan = variant.plan(problem, ctr.Settings(), (), None)
        seconds = time.process_time() - begin
        print(f"{name:26} {ctr.summary(plan)['e3']:7.3f}  {plan.success.sum():6}  {seconds:7.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
