"""`ctr-nlp force`: find the tip forces that a plan withstands, or the forces that measured shapes show."""

from __future__ import annotations

import argparse
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ctr_nlp.cli.arguments import add_figures_option, add_out_option, whole
from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.loads.force_files import write_forces
from ctr_nlp.cli.loads.measured_forces import add_measured_options, estimate_measured_forces
from ctr_nlp.cli.loads.options import add_modulus_option, read_plan
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder
from ctr_nlp.cli.terminal_output import busy, console, print_table, report_written_files
from ctr_nlp.exceptions import OptionError
from ctr_nlp.loads.tip import DEFAULT_MAX_TIP_FORCE_N, FORCE_DIRECTION_COUNTS, Forces, WorstForce, forces
from ctr_nlp.plan.plan import Plan

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_FORCE_TABLE_FRAMES = 5
"""Most frames that the table shows."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Of a plan, find the largest tip force that each frame withstands before the robot snaps or "
        "leaves its lumen, in many directions of the base frame, on the elastic model, and the compliance of the "
        "tip to a small force. Of measured shapes, find the forces that act: at the tip, at a place along the "
        "body or both, with standard deviations. Write forces.json and forces.csv, and a picture of a plan's.",
        epilog="Exit status: 0 where forces were found, 1 where no force explains a measured shape, 2 where input "
        "is bad and nothing is written. Forces act beside the load that the plan is evaluated under "
        "(`ctr-nlp under`). Columns of measured shapes are those of `ctr-nlp calibrate`, in the axes of the "
        "robot's base; forces that are known (force_x, force_y, force_z) are taken off.",
    )
    parser.add_argument("plan", metavar="PLAN.npz|MEASURED.csv", help="a plan, or measured shapes of a robot")
    add_measured_options(parser)
    parser.add_argument("--every", metavar="N", type=whole, default=1, help="look at every Nth frame (default 1)")
    told = "6: along the axes; 14: also to the corners of a cube; 26: also to its edges (default 26)"
    parser.add_argument("--directions", type=int, choices=FORCE_DIRECTION_COUNTS, default=26, help=told)
    told = f"force up to which is looked, N (default {DEFAULT_MAX_TIP_FORCE_N:g})"
    parser.add_argument("--most", metavar="N", type=float, default=DEFAULT_MAX_TIP_FORCE_N, help=told)
    told = "also find the force that presses the robot by more than so many mm beyond its lumen's wall"
    parser.add_argument("--off", metavar="MM", type=float, help=told)
    add_modulus_option(parser)
    add_out_option(parser, "runs/PROBLEM-force")
    add_figures_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if Path(arguments.plan).suffix.lower() != ".npz":
        return estimate_measured_forces(arguments)
    if arguments.robot is not None:
        raise OptionError("--robot is for measured shapes; a plan has its robot")
    plan = read_plan(arguments)
    name = str(plan.meta["problem"]["name"])
    out = Path(arguments.out or f"runs/{path_component(name)}-force")
    check_folder(out, "force")
    asked = {key: getattr(arguments, key) for key in ("every", "directions", "most", "off")}
    with busy(f"{name}: tip forces that each frame withstands"):
        found = forces(plan, **asked)
    draws = None if arguments.no_figures else partial(_picture, found, name)
    files = write_forces(found, out, "force", "forces", draws)
    _print(found, plan)
    report_written_files(out, files)
    return EXIT_SOLVED


def _picture(found: Forces, name: str) -> Figure:
    from ctr_nlp.loads.tip_picture import draw_tip_forces  # brings matplotlib, which takes long to load

    return draw_tip_forces(found, name)


def _print(found: Forces, plan: Plan) -> None:
    """Print the weakest frames, and the weakest of all in sentences."""
    order = found.critical_forces.min(axis=1).argsort(kind="stable")[:MAX_FORCE_TABLE_FRAMES]
    every = found.rows()
    columns = (
        "frame",
        "snaps at N",
        *(["leaves lumen at N"] if found.allowed_depth is not None else []),
        "towards",
        "compliance mm/N",
    )
    rows = []
    for row in (every[k] for k in order):
        leaves = [row["leaves_N"]] if found.allowed_depth is not None else []
        towards = " ".join(f"{row[axis]:.2f}" for axis in "xyz")
        rows.append([str(row["frame"]), row["snaps_N"], *leaves, towards, row["softest_mm_per_N"]])
    beside = "" if plan.evaluated_load is None else f", beside {plan.evaluated_load}"
    title = f"{plan.meta['problem']['name']}, largest tip forces, the weakest of {len(every)} frames{beside}"
    print_table(title, columns, rows)
    console().print(_describe_worst_force(found.least_snapping_force, "snaps the robot", found))
    if found.least_lumen_exit_force is not None:
        console().print(
            _describe_worst_force(
                found.least_lumen_exit_force,
                f"presses it more than {found.allowed_depth:g} mm beyond the wall",
                found,
            )
        )
    console().print(f"A small tip force moves the tip by up to {found.largest_compliance.max():.3g} mm per N.")


def _describe_worst_force(worst: WorstForce, does: str, found: Forces) -> str:
    if math.isinf(worst.force):
        return f"No tip force of up to {found.max_force:g} N, in {len(found.directions)} directions, {does}."
    towards = ", ".join(f"{part:.2f}" for part in worst.direction)
    looked = f"any of the {len(found.directions)} directions and {len(found.frames)} frames"
    told = f"A tip force of {worst.force:.3g} N towards ({towards}) {does} in frame {worst.frame}"
    return f"{told}; no smaller one does so in {looked}."


main = Command("ctr-nlp force", _parser, _run)
