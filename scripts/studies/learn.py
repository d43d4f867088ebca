"""`python scripts/studies/learn.py`: train a network that gives a robot's configurations for shapes."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from learning.network_errors import NetworkErrors, evaluate_network
from reference.learned.network import InverseKinematicsNetwork, network_path
from reference.learned.samples import sample_stable_unknowns
from reference.learned.training import VALIDATION_SHAPE_COUNT, Training, train_network

from ctr_nlp.cli.arguments import add_out_option, whole
from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.terminal_output import console, print_table, progress_bar, report_written_files
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.robot import Robot
from ctr_nlp.robot.paper import table_i_robot
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.tables import write_csv

LEARNING_ERROR_COLUMNS = "error", "mean", "median", "95 %", "largest"
TRAINING_OPTION_HELP = {
    "shapes": "shapes of the robot that are drawn to train on",
    "steps": "steps of training",
    "batch": "shapes in a step",
    "seed": "of the shapes and of the first weights",
}
"""Options of a Training, and their help."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Train a network that gives a robot's configuration for the points of a shape (S2J-IK), and "
        "keep it in the folder of compiled code, where the methods s2j, s2j-projected and s2j-horizon of "
        f"scripts/studies/compare.py find it. Print its errors on {VALIDATION_SHAPE_COUNT} shapes that were not "
        "trained on. Write learn.csv and "
        "the learning curve, learn.png. Training needs PyTorch (pip install ctr_nlp[learning]); what is trained "
        "is used without.",
        epilog="Exit status: 0 where the network was trained, 2 where input is bad, 130 after an interruption "
        "(nothing is kept then).",
    )
    parser.add_argument("--robot", metavar="FILE.toml", help="robot file (default: the paper's robot)")
    parser.add_argument("--model", choices=("dominant", "elastic"), default="dominant", help="(default dominant)")
    default = Training()
    for name, what in TRAINING_OPTION_HELP.items():
        known = getattr(default, name)
        parser.add_argument(f"--{name}", metavar="N", type=whole, default=known, help=f"{what} (default {known})")
    add_out_option(parser, "runs/learn")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    robot = table_i_robot() if arguments.robot is None else Robot.from_toml(arguments.robot)
    model = KINEMATIC_MODELS[arguments.model]
    out = Path(arguments.out)
    training = Training(**{name: getattr(arguments, name) for name in TRAINING_OPTION_HELP})
    check_folder(out, "learn")
    with deferred_interrupt() as interrupted, progress_bar() as labelled:
        network = train_network(robot, model, training, labelled("training"), interrupted)
    path = network_path(robot, model.name)
    network.save(path)
    found = evaluate_network(
        network, robot, model, sample_stable_unknowns(robot, model, VALIDATION_SHAPE_COUNT, training.seed + 1)
    )
    with output_folder(out, "learn") as staging:
        _write(network, staging)
    print_table(
        f"{VALIDATION_SHAPE_COUNT} shapes that were not trained on", list(LEARNING_ERROR_COLUMNS), _rows(found)
    )
    share = 1 - found.unprojected_within_limits.mean()
    console().print(f"answers that left the limits before they were projected: {share:.1%}")
    console().print(f"kept in {path}")
    report_written_files(out, ("learn.csv", "learn.png"))
    return EXIT_SOLVED


def _rows(found: NetworkErrors) -> list[list[str]]:
    rows = []
    for name, errors in (("root mean square over the shape", found.rms), ("at the tip", found.tip)):
        for unit, values in (("mm", errors), ("% of the shape's length", 100 * errors / found.length)):
            numbers = values.mean(), *np.quantile(values, (0.5, 0.95)), values.max()
            rows.append([f"{name}, {unit}", *(f"{value:.2f}" for value in numbers)])
    return rows


def _write(network: InverseKinematicsNetwork, folder: Path) -> None:
    from learning.picture import learning_curve

    from ctr_nlp.view.figures import save  # brings matplotlib, which takes long to load

    steps = [dict(zip(("step", "trained_mm", "held_out_mm"), row, strict=True)) for row in network.curve.tolist()]
    write_csv(folder / "learn.csv", steps)
    save(learning_curve(network), folder / "learn.png")


main = Command("learn.py", _parser, _run)

if __name__ == "__main__":
    sys.exit(main())
