"""Plan a whole motion in one nonlinear program, print its verdicts and save it.

python scripts/horizon.py cos --model dominant --out runs/cos.npz
"""

import argparse
from pathlib import Path

import ctr_nlp as ctr
from ctr_nlp.cli.console import run_with_exit_status
from ctr_nlp.problems import PROBLEM_NAMES


def main() -> int:
    """Plan the problem that the command line names; return 0 where every frame was solved."""
    parser = argparse.ArgumentParser(
        description="Plan a whole motion in one nonlinear program.",
        epilog="Exit status: 0 where every frame was solved, 1 where some were not, 2 where input is bad.",
    )
    parser.add_argument("problem", metavar="PROBLEM", choices=PROBLEM_NAMES, help=", ".join(PROBLEM_NAMES))
    parser.add_argument("--model", default="elastic", choices=("elastic", "dominant"))
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--out", type=Path, metavar="FILE.npz", help="where to save the plan (default: nowhere)")
    arguments = parser.parse_args()

    problem = ctr.named_problem(arguments.problem, arguments.frames)  # or ctr.problem_from_file(path)
    plan = ctr.solve_horizon(problem, model=arguments.model)
    print(f"e3 {ctr.summary(plan)['e3']:.3f} mm on the {arguments.model} model")

    plan = plan.check()  # moves the robot on the elastic model, with 200 samples of its tolerances
    for verdict in plan.verdicts:
        print(f"{verdict.matter:22} {verdict.word:12} {verdict.why}")
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        plan.save(arguments.out)
    return int(not plan.success.all())


if __name__ == "__main__":
    raise SystemExit(run_with_exit_status(main))
