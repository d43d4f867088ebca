"""`ctr-nlp inspect`: what is read from a file of anatomy, and what was assumed, left out or repaired."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from ctr_nlp.anatomy.branch import Branch, Branches, format_point, transform_points
from ctr_nlp.anatomy.files import is_mask, read_branches
from ctr_nlp.anatomy.formats.images import read_image
from ctr_nlp.anatomy.plausibility import widens
from ctr_nlp.anatomy.problem_files import SURFACE_NOTE
from ctr_nlp.anatomy.reading import ReadOptions
from ctr_nlp.anatomy.suffixes import ANATOMY_SUFFIXES
from ctr_nlp.cli.arguments import add_entry_option, add_triple
from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.plan_options import add_piece_arguments, add_reading_options, pieces_from, read_options_from
from ctr_nlp.cli.terminal_output import announce, print_table

BRANCH_COLUMNS = ("branch", "name", "points", "length", "first point", "last point", "radius", "remark")
MAX_LISTED_VALUES = 20


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Say what is read from a file of anatomy: its kind, its unit and coordinates and how they are "
        "known, its branches or labels, and what was assumed, left out or repaired.",
        epilog="Exit status: 0 where the file was read, 2 where it is refused; the message says why.",
    )
    parser.add_argument("file", metavar="FILE", help=f"file of anatomy ({', '.join(ANATOMY_SUFFIXES)})")
    add_piece_arguments(parser)
    add_entry_option(parser, "as the file has it")
    add_triple(parser, "target", "point at which a path in a mask ends, to inspect the path between both")
    add_reading_options(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if is_mask(arguments.file) and arguments.entry is None and arguments.target is None:
        _inspect_voxels(arguments.file, read_options_from(arguments))
        return EXIT_SOLVED
    branches = read_branches(
        arguments.file,
        arguments.entry,
        arguments.target,
        read_options_from(arguments),
        pieces_from(arguments),
    )
    facts = branches.facts
    default = "mask of a lumen" if is_mask(arguments.file) else "centrelines"
    rows = [
        ["kind", facts.kind or default, ""],
        ["unit", facts.units, facts.units_known],
        ["coordinates", branches.space, facts.space_known if branches.space != "xyz" else "the file's own axes"],
    ]
    print_table(arguments.file, ("what", "value", "how it is known"), rows, text=("value", "how it is known"))
    every = [_branch_row(k, branch, branches) for k, branch in enumerate(branches.branches, start=1)]
    text = ("name", "first point", "last point", "radius", "remark")
    print_table(f"branches, in mm; coordinates {branches.space}", BRANCH_COLUMNS, every, text=text)
    for note in (*facts.notes, *([SURFACE_NOTE] if is_mask(arguments.file) else [])):
        announce(f"note: {note}")
    return EXIT_SOLVED


def _branch_row(number: int, branch: Branch, branches: Branches) -> list[Any]:
    """Return the cells of a branch in the table of `_run`; number: from 1. branches: all of its file."""
    ends = transform_points(branch.points[[0, -1]], branches.from_lps).round(1) + 0.0
    first, last = (format_point(end) for end in ends)
    radius = "unknown"
    if branch.radius is not None:
        radius = f"{branch.radius.min():.2f} to {branch.radius.max():.2f}"
    remark = "widens, as if from tip to root" if widens(branch) else ""
    return [number, branch.name, len(branch.points), branch.length, first, last, radius, remark]


def _inspect_voxels(file: str, options: ReadOptions) -> None:
    """Print the size, spacing, values and segments of the voxels of the mask `file`.

    options: what a person states about the file.
    """
    image = read_image(file, options)
    values, counts = np.unique(image.voxels, return_counts=True)
    # A reader has the axes of its arrays in the order of memory, a person the first axis first.
    spacing = " x ".join(f"{side:.3g}" for side in image.spacing[::-1])
    rows = [
        ["kind", image.facts.kind],
        ["voxels", " x ".join(str(size) for size in image.voxels.shape[::-1])],
        ["spacing, mm", spacing],
        ["coordinates", f"{image.space}, {image.facts.space_known}"],
        ["unit", f"{image.facts.units}, {image.facts.units_known}"],
        *(["segment", f"{each.name}: value {each.label} in layer {each.layer}"] for each in image.segments),
    ]
    print_table(file, ("what", "value"), rows, text=("value",))
    listed = [[f"{value:g}", int(count)] for value, count in zip(values, counts, strict=True)]
    print_table("values", ("value", "voxels"), listed[:MAX_LISTED_VALUES])
    if len(listed) > MAX_LISTED_VALUES:
        announce(f"note: {len(listed) - MAX_LISTED_VALUES} more values are not listed")
    for note in image.facts.notes:
        announce(f"note: {note}")
    announce(
        "note: ctr-nlp branches lists the branches of the lumen; --entry X Y Z and --target X Y Z inspect the "
        "path between two points"
    )


main = Command("ctr-nlp inspect", _parser, _run)
