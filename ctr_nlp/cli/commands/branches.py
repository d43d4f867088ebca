"""`ctr-nlp branches`: the branches of a centreline file, listed and drawn."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.anatomy.branch import Branch, Branches, name_source_in_errors, transform_points
from ctr_nlp.anatomy.files import CENTRELINE_SUFFIXES, read_branches
from ctr_nlp.anatomy.plausibility import widens
from ctr_nlp.cli.arguments import add_entry_option
from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.output.file import check_file, output_file
from ctr_nlp.cli.plan_options import add_piece_arguments, add_reading_options, pieces_from, read_options_from
from ctr_nlp.cli.terminal_output import print_stderr, print_table, progress_bar, report_written_files
from ctr_nlp.exceptions import OptionError, OutputError, escape_control_characters
from ctr_nlp.paths.curve import curve_from_points
from ctr_nlp.paths.lumen_fit import JAGGED_CURVATURE_PER_MM, sharpest_bend
from ctr_nlp.view.figures import save
from ctr_nlp.view.figures.branches import tree

PNG = b"\x89PNG"
BRANCH_TABLE_COLUMNS = (
    "branch",
    "name",
    "length",
    "tightest bend",
    "radius at start",
    "least",
    "at end",
    "tip",
    "remark",
)
BRANCH_CHECK_SPACING_MM = 0.1
"""Spacing of the points along a branch at which its bends and its lumen are measured."""
MIN_BEND_CURVATURE_PER_MM = 1e-4
"""Curvature below which a branch has no bend worth a number."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="List the branches of a centreline file, in mm, so that one can be chosen by its number, "
        "its name or a point that it passes; and draw them.",
        epilog="Exit status: 0 where branches were listed, 2 where input is bad and nothing is written.",
    )
    parser.add_argument("file", metavar="FILE", help=f"centreline file ({', '.join(CENTRELINE_SUFFIXES)})")
    add_piece_arguments(parser)
    parser.add_argument("--reverse", action="store_true", help="take each branch from its last point to its first")
    add_entry_option(parser, "as the file tells it")
    add_reading_options(parser)
    parser.add_argument("--out", metavar="FILE.png", help="draw the branches; a picture of that name is replaced")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if arguments.out:
        _check_out(Path(arguments.out))
    branches = read_branches(
        arguments.file,
        arguments.entry,
        options=read_options_from(arguments),
        pieces=pieces_from(arguments),
    )
    for note in branches.facts.notes:
        print_stderr(f"note: {note}")
    if arguments.reverse:
        branches = branches.reverse_direction()
    rows = []
    count = len(branches.branches)
    with progress_bar() as bar:
        report = bar("branches")
        for number in range(1, count + 1):
            rows.append(_row(arguments.file, number, branches))
            report(number, count, branches.branches[number - 1].name)
    if arguments.out:
        _draw(branches, Path(arguments.file).name, Path(arguments.out))
    print_table(f"{arguments.file}, in mm; coordinates {branches.space}", BRANCH_TABLE_COLUMNS, rows)
    if arguments.out:
        report_written_files(arguments.out)
    return EXIT_SOLVED


def _check_out(out: Path) -> None:
    if out.suffix.lower() != ".png":
        raise OptionError(f"--out is {out}; the picture's name must end in .png")
    check_file(out, "")
    if out.exists() and not out.read_bytes().startswith(PNG):
        raise OutputError(f"output file {out} exists and is not a picture; choose another with --out")


def _row(file: str, number: int, branches: Branches) -> list[Any]:
    branch = branches.branches[number - 1]
    with name_source_in_errors(f"{file}, {branch.name}"):
        curve = curve_from_points(branch.points, branch.radius)
    s = np.linspace(0, curve.length, max(2, round(curve.length / BRANCH_CHECK_SPACING_MM)))
    sharpest = float(curve.curvature(s).max())
    bend = 1 / sharpest if sharpest > MIN_BEND_CURVATURE_PER_MM else None
    radius = None if curve.radius is None else curve.radius(s)
    radii = [None] * 3 if radius is None else [float(radius[0]), float(radius.min()), float(radius[-1])]
    tip = transform_points(branch.points[-1], branches.from_lps)
    at = " ".join(f"{coordinate:.1f}" for coordinate in tip)
    remark = _remark(branch, sharpest_bend(curve, curve.length)[0])
    return [number, branch.name, float(curve.length), bend, *radii, at, remark]


def _remark(branch: Branch, sharpest: float) -> str:
    remarks = ["jagged: --smoothing helps"] if sharpest > JAGGED_CURVATURE_PER_MM else []
    if branch.radius is None:
        return ", ".join([*remarks, "radius unknown"])
    if widens(branch):
        remarks.append("widens, as if from tip to root")
    return ", ".join(remarks)


def _draw(branches: Branches, name: str, out: Path) -> None:
    """Write the picture, whole or not at all."""
    every = branches.branches
    title = (
        f"{escape_control_characters(name)}\n{len(every)} {'branches' if len(every) > 1 else 'branch'}, in "
        f"the file's coordinates"
    )
    paths = [transform_points(branch.points, branches.from_lps) for branch in every]
    with output_file(out) as partial:
        save(tree(paths, [branch.name for branch in every], title, branches.space), partial)


main = Command("ctr-nlp branches", _parser, _run)
