"""Measure how long things take, and whether that differs from another commit."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.growth import draw_growths, measure_growths
from benchmarks.operations import measure_roof
from benchmarks.peers import race_solvers
from benchmarks.tree_comparison import (
    LEAST_BLOCKS,
    MAX_RELATIVE_TIME_CHANGE,
    RowComparison,
    Worker,
    compare_trees,
    measure_row,
)
from benchmarks.trees import ROOT, tree_of
from benchmarks.uncompiled_time import measure_uncompiled_shares
from benchmarks.work import BENCHMARK_ROWS

from ctr_nlp.cli.arguments import whole
from ctr_nlp.cli.console import EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.output.file import write_text
from ctr_nlp.cli.terminal_output import console, print_table, report_written_files
from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import OptionError
from ctr_nlp.paths.named_problems import named_problem

Entries = list[dict[str, Any]]
BENCHMARK_ROW_DURATION_S = 5.0
"""Time for which a row is repeated."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Measure what time of the thread steps, frames, motions and whole programs take, each in a "
        "process of its own; how these times grow, what other methods take, and what is spent "
        "outside compiled code. With --against, compare the rows with those of another commit of "
        "this clone, in turns. A C compiler is needed.",
        epilog="Exit status: 0 where all was measured, 1 where a row is slower, or faster without --explained, "
        "2 where input is bad.",
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="(default all)")
    parser.add_argument(
        "--rows",
        nargs="+",
        metavar="ROW",
        choices=BENCHMARK_ROWS,
        default=list(BENCHMARK_ROWS),
        help=", ".join(BENCHMARK_ROWS),
    )
    parser.add_argument(
        "--against", metavar="COMMIT", help="compare the rows, and nothing else, with this commit's"
    )
    parser.add_argument(
        "--explained", nargs="+", metavar="ROW", choices=BENCHMARK_ROWS, default=[], help="rows that may be faster"
    )
    parser.add_argument(
        "--blocks", metavar="N", type=whole, default=12, help="of four turns, to compare (default 12)"
    )
    parser.add_argument(
        "--tolerance",
        metavar="PART",
        type=float,
        default=MAX_RELATIVE_TIME_CHANGE,
        help=f"part by which a row may differ either way (default {MAX_RELATIVE_TIME_CHANGE:g})",
    )
    parser.add_argument("--json", metavar="FILE", help="also write what was measured to a file")
    parser.add_argument("--picture", metavar="FILE.png", help="also draw growth")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if why := cache.unavailable_reason():
        raise OptionError(f"there is nothing to compare: {why}")
    targets = {option: _target(option, getattr(arguments, option)) for option in ("json", "picture")}
    if arguments.blocks < LEAST_BLOCKS:
        raise OptionError(f"--blocks is {arguments.blocks}; it must be at least {LEAST_BLOCKS}")
    if not 0 < arguments.tolerance < np.inf:
        raise OptionError(f"--tolerance is {arguments.tolerance:g}; it must be above 0")
    found: dict[str, Entries] = {}
    status = EXIT_SOLVED
    if arguments.against is None:
        for part in arguments.parts:
            found[part] = PARTS[part](arguments, targets["picture"])
    else:
        rows = _compare_with_commit(arguments)
        found["against"] = [{**vars(row), "verdict": row.verdict} for row in rows]
        status = EXIT_SOME_FAILED if unexplained_rows(rows, arguments.explained) else EXIT_SOLVED
    if targets["json"] is not None:
        write_text(targets["json"], json.dumps(found, indent=1) + "\n")
        report_written_files(targets["json"])
    return status


def _target(option: str, given: str | None) -> Path | None:
    target = None if given is None else Path(given)
    if target is not None and (target.is_dir() or not target.parent.is_dir()):
        raise OptionError(f"--{option} is {target}; it must be a file in a folder that exists")
    return target


def unexplained_rows(rows: list[RowComparison], explained: list[str]) -> list[RowComparison]:
    """Return rows that are slower, or faster and not among `explained`, names of rows with a known reason."""
    return [r for r in rows if r.verdict == "slower" or (r.verdict == "faster" and r.row not in explained)]


def _compare_with_commit(arguments: argparse.Namespace) -> list[RowComparison]:
    def told(row: RowComparison) -> None:
        console(stderr=True).print(f"{row.row}: {row.ratio:.3f}, {row.verdict}", style="dim")

    with tempfile.TemporaryDirectory(prefix="ctr_nlp-") as folder, tree_of(arguments.against) as before:
        libraries = Path(folder) / "before", Path(folder) / "after"
        blocks = arguments.blocks
        tolerance = arguments.tolerance
        rows = compare_trees(arguments.rows, (before, ROOT), libraries, blocks, tolerance, told)
    lines = [
        (r.row, _format_seconds(r.before), _format_seconds(r.after), f"{r.ratio:.3f}", _between(r), r.verdict)
        for r in rows
    ]
    columns = ("", arguments.against, "this tree", "ratio", "98 % interval", "verdict")
    print_table(f"against {arguments.against}, in turns", columns, lines)
    return rows


def _between(row: RowComparison) -> str:
    return f"{row.low:.3f} to {row.high:.3f}"


def _format_seconds(seconds: float) -> str:
    for factor, unit in ((1.0, "s"), (1e3, "ms")):
        if seconds * factor >= 1:
            return f"{seconds * factor:.3g} {unit}"
    return f"{1e6 * seconds:.3g} µs"


def _spread(seconds: Any) -> dict[str, float]:
    return {
        "least": float(np.min(seconds)),
        "median": float(np.median(seconds)),
        "p99": float(np.quantile(seconds, 0.99)),
    }


def _table(title: str, entries: Entries) -> Entries:
    keys = ("least", "median", "p99")
    rows = [(e["row"], *(_format_seconds(e[key]) for key in keys), str(e["times"])) for e in entries]
    print_table(title, ("", *keys, "times"), rows)
    return entries


def _rows(arguments: argparse.Namespace, picture: Path | None) -> Entries:
    entries: Entries = []
    for row in arguments.rows:
        with Worker(ROOT, row) as worker:
            seconds = measure_row(worker, BENCHMARK_ROW_DURATION_S)
        entries.append({"row": row, "times": len(seconds), **_spread(seconds)})
        console(stderr=True).print(f"{row}: {_format_seconds(entries[-1]['median'])}", style="dim")
    return _table("rows, in time of the thread", entries)


def _peers(arguments: argparse.Namespace, picture: Path | None) -> Entries:
    times = race_solvers(named_problem("cos"))
    entries: Entries = [{"row": k, "times": len(v.seconds), **_spread(v.seconds)} for k, v in times.items()]
    return _table("a frame of cos, by several methods", entries)


def _growth(arguments: argparse.Namespace, picture: Path | None) -> Entries:
    found = list(measure_growths())
    rows = [
        (g.what, f"{g.exponent:.2f} ± {g.error:.2f}", _pairs(zip(g.sizes, g.seconds, strict=True))) for g in found
    ]
    print_table("growth", ("", "exponent", "times"), rows, text=("times",))
    if picture is not None:
        report_written_files(draw_growths(found, picture))
    return [
        {"row": g.what, "exponent": g.exponent, "error": g.error, "seconds": g.seconds.tolist()} for g in found
    ]


def _pairs(pairs: Iterator[tuple[float, float]]) -> str:
    return ", ".join(f"{size:g}: {_format_seconds(seconds)}" for size, seconds in pairs)


def _shares(arguments: argparse.Namespace, picture: Path | None) -> Entries:
    found = measure_uncompiled_shares()
    print_table("spent outside compiled code", ("", "part"), [(k, f"{v:.0%}") for k, v in found.items()])
    return [{"row": name, "part": part} for name, part in found.items()]


def _roof(arguments: argparse.Namespace, picture: Path | None) -> Entries:
    found = measure_roof()
    rows = [
        ("floating-point operations", f"{found.operations:,.0f}"),
        ("time on one core", _format_seconds(found.seconds)),
        ("operations a second", f"{found.operations / found.seconds / 1e9:.1f} billion"),
        ("the core's peak", f"{found.peak / 1e9:.1f} billion"),
        ("share of the peak", f"{found.share:.0%}"),
        (
            "memory read and written",
            f"{found.bytes / 1e3:.1f} kB, {found.bytes / found.seconds / 1e9:.2f} GB a second",
        ),
        *((f"calls of {name}", f"{count:.2f}") for name, count in found.calls.items()),
    ]
    print_table("an elastic shape with its margin, at rest", ("", "a shape"), rows)
    return [vars(found) | {"share": found.share}]


PARTS: dict[str, Callable[[argparse.Namespace, Path | None], Entries]] = {
    "rows": _rows,
    "peers": _peers,
    "growth": _growth,
    "shares": _shares,
    "roof": _roof,
}


main = Command("benchmark.py", _parser, _run)

if __name__ == "__main__":
    sys.exit(main())
