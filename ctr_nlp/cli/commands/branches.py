"""`ctr-nlp branches`: the branches of a centreline file or a mask, listed, drawn and saved."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.anatomy.branch import Branch, Branches, name_source_in_errors, transform_points
from ctr_nlp.anatomy.branch_measures import BranchMeasures, count_bifurcations, measure_branches
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.anatomy.formats.vtk import write_vtk
from ctr_nlp.anatomy.plausibility import widens
from ctr_nlp.anatomy.segmentation.widths import find_leak
from ctr_nlp.anatomy.suffixes import ANATOMY_SUFFIXES
from ctr_nlp.cli.arguments import add_entry_option
from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.output.file import check_file, output_file
from ctr_nlp.cli.plan_options import add_piece_arguments, add_reading_options, pieces_from, read_options_from
from ctr_nlp.cli.terminal_output import (
    busy,
    print_stderr,
    print_table,
    progress_bar,
    report_written_files,
    suggest_next,
)
from ctr_nlp.exceptions import OptionError, OutputError, escape_control_characters
from ctr_nlp.paths.lumen_fit import JAGGED_CURVATURE_PER_MM
from ctr_nlp.paths.points import cumulative_arc_length

PNG = b"\x89PNG"
VTP = b"<?xml"
"""First bytes of an XML file of VTK."""
BRANCH_TABLE_COLUMNS = (
    "branch",
    "name",
    "generation",
    "length",
    "tightest bend",
    "radius at start",
    "least",
    "at end",
    "tip",
    "remark",
)
LEAK_SEARCH_SPACING_MM = 1.0
MIN_BEND_CURVATURE_PER_MM = 1e-4
"""Curvature below which a branch has no bend worth a number."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="List the branches of a centreline file or of the lumen in a mask, in mm, so that one can be "
        "chosen by its number, its name or a point that it passes; draw them, and save them.",
        epilog="Exit status: 0 where branches were listed, 2 where input is bad and nothing is written.",
    )
    parser.add_argument("file", metavar="FILE", help=f"file of anatomy ({', '.join(ANATOMY_SUFFIXES)})")
    add_piece_arguments(parser)
    parser.add_argument("--reverse", action="store_true", help="take each branch from its last point to its first")
    add_entry_option(parser, "as the file has it; in a mask the widest end")
    add_reading_options(parser)
    parser.add_argument("--out", metavar="FILE.png", help="draw the branches; a picture of that name is replaced")
    parser.add_argument(
        "--save", metavar="FILE.vtp", help="save the branches as centrelines in LPS; such a file is replaced"
    )
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if arguments.out:
        _check_out("--out", Path(arguments.out), ".png", PNG, "picture")
    if arguments.save:
        _check_out("--save", Path(arguments.save), ".vtp", VTP, "VTK file")
    with busy(f"{arguments.file} is read"):
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
    rows = list[list[Any]]()
    count = len(branches.branches)
    generations = count_bifurcations(branches.branches)
    with progress_bar() as bar, name_source_in_errors(arguments.file):
        report = bar("branches")
        for measures in measure_branches(branches.branches):
            rows.append(_row(len(rows) + 1, branches, measures, generations[len(rows)]))
            report(len(rows), count, branches.branches[len(rows) - 1].name)
    if arguments.out:
        _draw(branches, Path(arguments.file).name, Path(arguments.out))
    columns = list(BRANCH_TABLE_COLUMNS)
    if all(generation is None for generation in generations):  # known in trees alone
        _drop_column(columns, rows, "generation")
    if all(name == f"branch {number}" for number, name, *_ in rows):  # names that masks give repeat the number
        _drop_column(columns, rows, "name")
    if not any(row[-1] for row in rows):
        _drop_column(columns, rows, "remark")
    title = f"{arguments.file}, in mm; coordinates {branches.space}"
    print_table(title, columns, rows, text=("name", "remark"), unbroken=("tip",))
    if arguments.save:
        with output_file(Path(arguments.save)) as partial:
            write_vtk(partial, branches)
    for file in filter(None, (arguments.out, arguments.save)):
        report_written_files(file)
    suggest_next(("a plan to the tip of a branch", _plan_words(arguments, count)))
    return EXIT_SOLVED


def _drop_column(columns: list[str], rows: Sequence[list[Any]], name: str) -> None:
    """Delete a column from the names and the rows of a table, in place."""
    place = columns.index(name)
    for row in (columns, *rows):
        del row[place]


def _plan_words(arguments: argparse.Namespace, count: int) -> list[object]:
    """Return the words of a command that plans along one of `count` branches of the file."""
    words: list[object] = ["plan", arguments.file, *pieces_from(arguments)]
    if arguments.entry is not None:
        words += ["--entry", *arguments.entry]
    return words if count == 1 else [*words, "--branch", "NUMBER"]


def _check_out(option: str, out: Path, suffix: str, start: bytes, kind: str) -> None:
    """Raise OptionError or OutputError where an output file has another suffix, or is not of the kind to replace.

    option: that names it. start: first bytes of such files. kind: in words.
    """
    if out.suffix.lower() != suffix:
        raise OptionError(f"{option} is {out}; the {kind}'s name must end in {suffix}")
    check_file(out, "")
    if out.exists() and not out.read_bytes().startswith(start):
        raise OutputError(f"output file {out} exists and is not a {kind}; choose another with {option}")


def _row(number: int, branches: Branches, measures: BranchMeasures, generation: int | None) -> list[Any]:
    """Return the table's row of a branch.

    number: of the branch, from 1. branches: those of the file. measures: of the branch. generation: number of
    bifurcations that it passes, None where that is unknown.
    """
    branch = branches.branches[number - 1]
    bend = 1 / measures.curvature if measures.curvature > MIN_BEND_CURVATURE_PER_MM else None
    radius = branch.radius
    radii = [None] * 3 if radius is None else [float(radius[0]), float(radius.min()), float(radius[-1])]
    tip = transform_points(branch.points[-1], branches.from_lps)
    at = " ".join(f"{coordinate:.1f}" for coordinate in tip)
    return [number, branch.name, generation, measures.length, bend, *radii, at, _remark(branch, measures.sharpest)]


def _remark(branch: Branch, sharpest: float) -> str:
    remarks = ["jagged: --smoothing helps"] if sharpest > JAGGED_CURVATURE_PER_MM else []
    if branch.radius is None:
        return ", ".join([*remarks, "radius unknown"])
    if widens(branch):
        remarks.append("widens, as if from tip to root")
    along = cumulative_arc_length(branch.points)
    # About a point a millimetre: the search for leaks compares all of them.
    some = np.unique(np.searchsorted(along, np.arange(0.0, along[-1], LEAK_SEARCH_SPACING_MM)))
    if find_leak(branch.points[some], branch.radius[some]) is not None:
        remarks.append("widens suddenly: a leak?")
    return ", ".join(remarks)


def _draw(branches: Branches, name: str, out: Path) -> None:
    """Write the picture, whole or not at all."""
    from ctr_nlp.view.figures import save  # brings matplotlib, which takes long to load
    from ctr_nlp.view.figures.branches import tree

    every = branches.branches
    title = (
        f"{escape_control_characters(name)}\n{len(every)} {'branches' if len(every) > 1 else 'branch'}, in "
        f"the file's coordinates"
    )
    paths = [transform_points(branch.points, branches.from_lps) for branch in every]
    with output_file(out) as partial:
        save(tree(paths, [branch.name for branch in every], title, branches.space), partial)


main = Command("ctr-nlp branches", _parser, _run)
