"""Plan frame by frame, as a robot must while its target moves, and print the error of each frame.

python scripts/per_frame.py cos --formulation joint --model dominant
"""

import argparse

import ctr_nlp as ctr
from ctr_nlp.cli.console import run_with_exit_status
from ctr_nlp.problems import PROBLEM_NAMES


def main() -> int:
    """Plan the problem that the command line names; return 0 where every frame was solved."""
    parser = argparse.ArgumentParser(
        description="Plan frame by frame.",
        epilog="Exit status: 0 where every frame was solved, 1 where some were not, 2 where input is bad.",
    )
    parser.add_argument("problem", metavar="PROBLEM", choices=PROBLEM_NAMES, help=", ".join(PROBLEM_NAMES))
    parser.add_argument("--formulation", default="joint", choices=("joint", "two-stage", "two-stage-exact"))
    parser.add_argument(
        "--model", choices=("elastic", "dominant"), help="(default: elastic, with two stages dominant)"
    )
    parser.add_argument("--frames", type=int, default=100)
    arguments = parser.parse_args()

    problem = ctr.named_problem(arguments.problem, arguments.frames)  # or ctr.problem_from_file(path)
    plan = ctr.solve_per_frame(problem, arguments.formulation, model=arguments.model)

    print("frame  e2 (mm)  alpha (rad), beta (mm), theta (rad)")
    for frame, (error, q) in enumerate(zip(ctr.by_frame(plan)["e2"], plan.q, strict=True), 1):
        print(f"{frame:5}  {error:7.3f}  {' '.join(f'{value:8.3f}' for value in q)}")
    print(f"e3 {ctr.summary(plan)['e3']:.3f} mm")
    return int(not plan.success.all())


if __name__ == "__main__":
    raise SystemExit(run_with_exit_status(main))
