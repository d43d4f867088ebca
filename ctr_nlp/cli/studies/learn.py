"""`ctr-nlp learn`: a network that gives configurations for shapes, trained for a robot."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ctr_nlp.cli.arguments import add_out_option, whole
from ctr_nlp.cli.console import SOLVED, Command
from ctr_nlp.cli.output.folder import check_folder, published
from ctr_nlp.cli.telling import console, print_table, progress_bar, wrote
from ctr_nlp.models import MODELS
from ctr_nlp.reference.learned.network import Network, place
from ctr_nlp.reference.learned.samples import drawn
from ctr_nlp.reference.learned.training import HELD_OUT, Training, train
from ctr_nlp.robot import Robot
from ctr_nlp.robot.paper import table_i_robot
from ctr_nlp.studies.learning.shapes import Recovered, recovered
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.tables import write_csv

COLUMNS = "error", "mean", "median", "95 %", "largest"
COUNTS = {
    "shapes": "shapes of the robot that are drawn to train on",
    "steps": "steps of training",
    "batch": "shapes in a step",
    "seed": "of the shapes and of the first weights",
}
"""What of a Training can be asked for, and what it is."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Train a network that gives a robot's configuration for the points of a shape (S2J-IK), and "
        "keep it in the folder of compiled code, where the methods s2j, s2j-projected and s2j-horizon of `ctr-nlp "
        f"compare` find it. Tell its errors on {HELD_OUT} shapes that were not trained on. Write learn.csv and "
        "the learning curve, learn.png. Training needs PyTorch (pip install ctr_nlp[learning]); what is trained "
        "is used without.",
        epilog="Exit status: 0 where the network was trained, 2 where input is bad, 130 after an interruption "
        "(nothing is kept then).",
    )
    parser.add_argument("--robot", metavar="FILE.toml", help="robot file (default: the paper's robot)")
    parser.add_argument("--model", choices=("dominant", "elastic"), default="dominant", help="(default dominant)")
    default = Training()
    for name, what in COUNTS.items():
        known = getattr(default, name)
        parser.add_argument(f"--{name}", metavar="N", type=whole, default=known, help=f"{what} (default {known})")
    add_out_option(parser, "runs/learn")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    robot = table_i_robot() if arguments.robot is None else Robot.from_toml(arguments.robot)
    model, out = MODELS[arguments.model], Path(arguments.out)
    training = Training(**{name: getattr(arguments, name) for name in COUNTS})
    check_folder(out, "learn")
    with deferred_interrupt() as interrupted, progress_bar() as labelled:
        network = train(robot, model, training, labelled("training"), interrupted)
    path = place(robot, model.name)
    network.save(path)
    found = recovered(network, robot, model, drawn(robot, model, HELD_OUT, training.seed + 1))
    with published(out, "learn") as staging:
        _write(network, staging)
    print_table(f"{HELD_OUT} shapes that were not trained on", list(COLUMNS), _rows(found))
    share = 1 - found.kept.mean()
    console().print(f"answers that left the limits before they were projected: {share:.1%}")
    console().print(f"kept in {path}")
    wrote(out, ("learn.csv", "learn.png"))
    return SOLVED


def _rows(found: Recovered) -> list[list[str]]:
    rows = []
    for name, errors in (("root mean square over the shape", found.rms), ("at the tip", found.tip)):
        for unit, values in (("mm", errors), ("% of the shape's length", 100 * errors / found.length)):
            numbers = values.mean(), *np.quantile(values, (0.5, 0.95)), values.max()
            rows.append([f"{name}, {unit}", *(f"{value:.2f}" for value in numbers)])
    return rows


def _write(network: Network, folder: Path) -> None:
    from ctr_nlp.figures import save  # brings matplotlib, which takes long to load
    from ctr_nlp.studies.learning.picture import learning_curve

    steps = [dict(zip(("step", "trained_mm", "held_out_mm"), row, strict=True)) for row in network.curve.tolist()]
    write_csv(folder / "learn.csv", steps)
    save(learning_curve(network), folder / "learn.png")


main = Command("ctr-nlp learn", _parser, _run)
