"""Plan a motion and write the timed commands of its motors as a table, or as G-code.

python scripts/export.py cos --to gcode
"""

import argparse
from pathlib import Path

import ctr_nlp as ctr
from ctr_nlp.cli.console import run_with_exit_status
from ctr_nlp.hardware.description import Hardware, simulated_hardware
from ctr_nlp.hardware.exports import MACHINE_TEXT_FORMATS
from ctr_nlp.hardware.playing.session import prepare_trajectory
from ctr_nlp.problems import PROBLEM_NAMES


def main() -> int:
    """Plan the problem that the command line names, and write its commands."""
    parser = argparse.ArgumentParser(
        description="Write the motor commands of a motion.",
        epilog="Exit status: 0 where the file was written, 2 where input is bad.",
    )
    parser.add_argument("problem", metavar="PROBLEM", choices=PROBLEM_NAMES, help=", ".join(PROBLEM_NAMES))
    parser.add_argument("--to", default="csv", choices=("csv", "gcode"))
    parser.add_argument("--hardware", type=Path, metavar="FILE.toml", help="the rig (default: a simulated one)")
    parser.add_argument("--model", default="elastic", choices=("elastic", "dominant"))
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--out", type=Path, metavar="FILE", help="(default: PROBLEM.csv or PROBLEM.gcode)")
    arguments = parser.parse_args()

    problem = ctr.named_problem(arguments.problem, arguments.frames)  # or ctr.problem_from_file(path)
    plan = ctr.solve_horizon(problem, model=arguments.model)
    rig = Hardware.from_toml(arguments.hardware) if arguments.hardware else simulated_hardware(plan.robot)
    trajectory, _ = prepare_trajectory(plan, rig)  # checked against the limits and accelerations of the rig

    form = MACHINE_TEXT_FORMATS[arguments.to]
    out = arguments.out or Path(f"{problem.name}{form.suffix}")
    out.write_text(form.of(trajectory, problem.name), encoding="utf-8")
    print(f"wrote {out}: {trajectory.duration:.1f} s on {len(rig.axes)} axes")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_with_exit_status(main))
