"""Forward models of other laboratories beside the elastic one: how far they agree, and how long they take.

python scripts/studies/peer_models.py NAME=PROGRAM [NAME=PROGRAM ...] [--configurations N] [--forces N ...]

A PROGRAM wraps a peer's model that was built elsewhere; what it reads and writes, and how conventions differ,
stands in scripts/studies/peers/program.py. A program that is not there is skipped.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import asdict

from peers.agreement import compare_models, sample_configurations

from ctr_nlp import Robot, table_i_robot
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.support.tables import markdown


def main(arguments: list[str] | None = None) -> None:
    """Read options, and print a row for every peer and force."""
    parser = argparse.ArgumentParser(description="Other laboratories' forward models beside the elastic one.")
    parser.add_argument("peers", metavar="NAME=PROGRAM", nargs="+", type=_named)
    parser.add_argument("--robot", metavar="FILE.toml", help="(default: that of Table I)")
    parser.add_argument("--modulus", metavar="MPA", type=float, default=60_000.0, help="(default 60000)")
    parser.add_argument("--configurations", metavar="N", type=int, default=200, help="random ones (default 200)")
    parser.add_argument("--seed", type=int, default=0, help="of the configurations (default 0)")
    what = "N across the robot at its tip, towards +x; a row for each (default 0)"
    parser.add_argument("--forces", metavar="N", type=float, nargs="+", default=[0.0], help=what)
    asked = parser.parse_args(arguments)
    robot = with_modulus(Robot.from_toml(asked.robot) if asked.robot else table_i_robot(), asked.modulus)
    q = sample_configurations(robot, asked.configurations, asked.seed)
    rows = []
    for name, program in asked.peers:
        if shutil.which(program) is None:
            print(f"{name} is skipped: there is no program {program}")
            continue
        rows += [asdict(compare_models(name, program, robot, q, (force, 0.0, 0.0))) for force in asked.forces]
    if rows:
        told = [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
        print(markdown(list(rows[0]), told))


def _named(text: str) -> tuple[str, str]:
    name, separator, program = text.partition("=")
    if not (name and separator and program):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=PROGRAM")
    return name, program


if __name__ == "__main__":
    main()
