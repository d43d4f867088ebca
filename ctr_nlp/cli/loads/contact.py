"""`ctr-nlp contact`: find the forces between a plan's robot and the wall of its lumen."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ctr_nlp.cli.arguments import add_figures_option, add_out_option
from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.loads.force_files import write_forces
from ctr_nlp.cli.loads.options import add_modulus_option, read_plan
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder
from ctr_nlp.cli.terminal_output import busy, console, print_table, report_written_files
from ctr_nlp.loads.tissue import AIRWAY_WALL_STIFFNESS_N_PER_MM2
from ctr_nlp.loads.wall import WallForces, wall_forces

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_CONTACT_TABLE_FRAMES = 5
"""Most frames that the table shows."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Find the forces with which a plan's robot and the wall of its lumen press on each other, "
        "on the elastic model, where the wall gives in like an elastic foundation. Tell how large "
        "they are in every frame, where along the robot they act, how deep it is in the wall, and "
        "how much of each force another shape could avoid. Write contact.json, contact.csv and a "
        "picture.",
        epilog="Exit status: 0 where forces were found, 2 where input is bad and nothing is written. The wall "
        "acts beside the load that the plan is evaluated under (`ctr-nlp under`).",
    )
    parser.add_argument("plan", metavar="PLAN.npz")
    told = (
        f"of the wall, in N/mm for every mm of length (default {AIRWAY_WALL_STIFFNESS_N_PER_MM2:g}, of an airway)"
    )
    parser.add_argument(
        "--wall-stiffness", metavar="N/MM2", type=float, default=AIRWAY_WALL_STIFFNESS_N_PER_MM2, help=told
    )
    add_modulus_option(parser)
    add_out_option(parser, "runs/PROBLEM-contact")
    add_figures_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    plan = read_plan(arguments)
    name = str(plan.meta["problem"]["name"])
    out = Path(arguments.out or f"runs/{path_component(name)}-contact")
    check_folder(out, "contact")
    with busy(f"{name}: forces of the wall"):
        found = wall_forces(plan, arguments.wall_stiffness)
    draws = None if arguments.no_figures else partial(_picture, found, name)
    files = write_forces(found, out, "contact", "contact", draws)
    _print(found, name)
    report_written_files(out, files)
    return EXIT_SOLVED


def _picture(found: WallForces, name: str) -> Figure:
    from ctr_nlp.loads.wall_picture import draw_wall_forces  # brings matplotlib, which takes long to load

    return draw_wall_forces(found, name)


def _print(found: WallForces, name: str) -> None:
    """Print the frames with the largest forces, and sentences on all of them."""
    told = found.summary()
    rows = [row for row in found.rows() if row["total_N"] not in ("", 0.0)]
    rows.sort(key=lambda row: -float(row["total_N"]))
    if rows:
        columns = (
            *("frame", "force N", "avoidable N", "on one piece N", "depth mm", "depth without force mm"),
            "tip moved mm",
        )
        cells = [[str(row["frame"]), *list(row.values())[1:]] for row in rows[:MAX_CONTACT_TABLE_FRAMES]]
        title = f"{name}, forces of the wall, the largest of {len(rows)} frames in contact"
        print_table(title, columns, cells)
        most, avoidable = (f"{told[key]:.3g} N" for key in ("largest_total_N", "of_it_avoidable_N"))
        console().print(
            f"The wall presses most in frame {told['worst_frame']}, with {most} on the whole robot; of it another "
            f"shape could avoid {avoidable}, where the lumen is wider than the robot."
        )
    else:
        console().print(f"{name}: the robot touches the wall in no frame.")
    if told["snaps_in_frame"] is not None:
        console().print(
            f"From frame {told['snaps_in_frame']} on forces are not known: the robot snaps as the wall pushes it."
        )


main = Command("ctr-nlp contact", _parser, _run)
