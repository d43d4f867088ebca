"""`ctr-nlp benchmark`: speed as ratios, all measured in one run."""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path

from ctr_nlp.cli.console import SOLVED, SOME_FAILED, Command, console, print_table
from ctr_nlp.cli.output.file import write_text
from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import OptionError
from ctr_nlp.problems import NAMES, named
from ctr_nlp.studies.benchmarks import RATIO, Record, regressions
from ctr_nlp.studies.benchmarks.builds import sizes, start_up
from ctr_nlp.studies.benchmarks.frames import forward, frames, planned
from ctr_nlp.studies.benchmarks.horizons import growth, horizons
from ctr_nlp.target.problem import Problem

SHAPES = ("cos", "arc", "line", "line_arc", "synthesis")
"""The five problems of the paper whose targets are known."""
SIZES = (100, 1000, 5000)
"""Frames over which the time and memory of an iteration are followed."""
BASELINE = Path(__file__).resolve().parents[3] / "scripts" / "benchmark_baseline.json"
"""In a clone of the repository; no wheel has it."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Times of single frames and of whole motions by all methods, alternating in one run; how they "
        "grow; what start-up takes. Needs a C compiler.",
        epilog="Exit status: 0 measured, 1 worse than the baseline, 2 bad input.",
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="(default all)")
    suiting = "(default all that suit a part)"
    parser.add_argument("--problems", nargs="+", metavar="NAME", choices=NAMES, help=suiting)
    parser.add_argument("--json", metavar="FILE", help="also write the records to a file")
    parser.add_argument("--check", action="store_true", help=f"compare the ratios with a clone's {BASELINE.name}")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if why := cache.missing():
        raise OptionError(f"nothing to compare: {why}")
    target = None if arguments.json is None else Path(arguments.json)
    if target is not None and (target.is_dir() or not target.parent.is_dir()):
        raise OptionError(f"--json is {target}; it must be a file in a folder that exists")
    chosen = arguments.problems or list(NAMES)
    records = []
    for part in arguments.parts:
        for record in PARTS[part](named, chosen):
            records.append(record)
            console(stderr=True).print(f"{record.name}: {record.value:.4g} {record.unit}", style="dim")
    rows = [(r.name, f"{r.value:.4g}", r.unit, r.better) for r in records]
    print_table("benchmark", ("", "value", "unit", "better"), rows)
    if target is not None:
        write_text(target, json.dumps([asdict(record) for record in records], indent=1) + "\n")
        console().print(f"wrote {target}")
    return _checked(records, BASELINE) if arguments.check else SOLVED


def _checked(records: list[Record], baseline: Path) -> int:
    try:
        known = {entry["name"]: entry["value"] for entry in json.loads(baseline.read_text(encoding="utf-8"))}
        if wrong := [name for name, value in known.items() if not isinstance(value, int | float)]:
            raise ValueError(f"{wrong[0]} has no number")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OptionError(f"baseline {baseline} cannot be read ({error}); --json writes one") from error
    found = regressions(records, known)
    for line in found:
        console().print(f"worse: {line}")
    compared = sum(record.tolerance is not None and record.name in known for record in records)
    console().print(f"{compared} figures compared with {baseline.name}, {len(found)} worse")
    return SOME_FAILED if found else SOLVED


Named = Callable[..., Problem]


def _each(
    measured: Callable[[Problem], Iterator[Record]], chosen: Iterable[Problem], kind: str
) -> Iterator[Record]:
    """What is measured of every problem, then the means of ratios of a kind."""
    found: list[Record] = []
    for problem in chosen:
        for record in measured(problem):
            found.append(record)
            yield record
    yield from _means(found, kind)


def _elastic(named: Named, chosen: list[str]) -> Iterator[Record]:
    yield from _each(planned, (named(name) for name in SHAPES if name in chosen), "an elastic frame: ")
    yield from forward(named("cos"))


def _means(records: list[Record], kind: str) -> Iterator[Record]:
    """Geometric means of ratios of the same kind over problems."""
    ratios: dict[str, list[float]] = {}
    for record in records:
        if record.tolerance == RATIO and kind in record.name and " / " in record.name:
            ratios.setdefault(record.name.split(", ", 1)[1], []).append(record.value)
    for name, values in ratios.items():
        yield Record(f"all problems, {name}, geometric mean", statistics.geometric_mean(values), "", "more", RATIO)


PARTS: dict[str, Callable[[Named, list[str]], Iterator[Record]]] = {
    "start-up": lambda named, chosen: start_up(),
    "frames": lambda named, chosen: _each(frames, (named(n) for n in SHAPES if n in chosen), "a frame: "),
    "horizons": lambda named, chosen: _each(horizons, map(named, chosen), "horizon: "),
    "elastic": _elastic,
    "growth": lambda named, chosen: growth([named("cos", count) for count in SIZES]),
    "sizes": lambda named, chosen: sizes(),
}


main = Command("ctr-nlp benchmark", _parser, _run)
