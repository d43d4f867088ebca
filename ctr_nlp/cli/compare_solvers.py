"""The program behind scripts/compare_solvers.py."""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

from ctr_nlp.cli import problems
from ctr_nlp.cli.arguments import add_problem_options, add_settings, settings_from
from ctr_nlp.cli.console import (
    INTERRUPTED,
    SOLVED,
    SOME_FAILED,
    console,
    guarded,
    print_table,
    progress_bar,
    shown,
)
from ctr_nlp.cli.output import check_folder, whole_folder
from ctr_nlp.study import VARIANTS, compare, parse_variant

COLUMNS = {
    "variant": "variant",
    "e3": "e3",
    "e4": "e4",
    "e_max": "max",
    "seed_e3": "seed e3",
    "seed_e4": "seed e4",
    "step_alpha": "step alpha",
    "step_beta": "step beta",
    "step_theta": "step theta",
    "median_ms": "median ms",
    "p99_ms": "p99 ms",
    "seed_t_s": "seed s",
    "build_s": "build s",
    "failed": "failed",
}
"""Columns of the printed table and of Markdown, by the row's key."""


def main(folder: Path, argv: list[str] | None = None) -> int:
    """Solve problems with every variant and print the results side by side; folder holds the named problems."""
    return guarded(lambda: _run(folder, _parser(folder).parse_args(argv)))


def _parser(folder: Path) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="compare_solvers.py",
        description="Solve problems with every variant, one after the other, and print errors, steps and times "
        "beside the seed's Table II; write comparison.md, .csv and .json.",
        epilog="Exit status: 0 every frame of ours solved, 1 some not, 2 bad input, 130 interrupted.",
    )
    names = ", ".join(problems.names(folder))
    parser.add_argument(
        "problems", metavar="PROBLEM", nargs="*", help=f"{names}, or centreline files (default all)"
    )
    parser.add_argument(
        "--variants",
        metavar="NAME",
        nargs="+",
        default=list(VARIANTS),
        help=f"(default all: {', '.join(VARIANTS)})",
    )
    parser.add_argument("--out", metavar="DIR", default="runs/comparison", help="(default runs/comparison)")
    add_problem_options(parser)
    add_settings(parser)
    return parser


def _run(folder: Path, arguments: argparse.Namespace) -> int:
    settings, out = settings_from(arguments), Path(arguments.out)
    variants = [parse_variant(name) for name in arguments.variants]
    chosen = [problems.load(name, folder, arguments) for name in arguments.problems or problems.names(folder)]
    check_folder(out)
    with progress_bar() as labelled:
        rows = compare(chosen, variants, settings, lambda problem, variant: labelled(f"{problem}, {variant}"))
    with whole_folder(out) as staging:
        _write(rows, staging)
    for name in dict.fromkeys(row["problem"] for row in rows):
        cells = [[row[key] for key in COLUMNS] for row in rows if row["problem"] == name]
        print_table(f"{name} (mm, rad)", list(COLUMNS.values()), cells)
    console().print(f"wrote {out}: comparison.md, comparison.csv, comparison.json")
    if any(row["interrupted"] for row in rows):
        return INTERRUPTED
    return SOME_FAILED if any(row["failed"] for row in rows if ":" in row["variant"]) else SOLVED


def _write(rows: list[dict[str, Any]], folder: Path) -> None:
    text = json.dumps(rows, indent=1, allow_nan=False)
    (folder / "comparison.json").write_text(text + "\n", encoding="utf-8")
    with open(folder / "comparison.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    lines = [["problem", *COLUMNS.values()], ["---"] * (len(COLUMNS) + 1)]
    lines += [[row["problem"], *(shown(row[key]) for key in COLUMNS)] for row in rows]
    markdown = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    (folder / "comparison.md").write_text(markdown, encoding="utf-8")
