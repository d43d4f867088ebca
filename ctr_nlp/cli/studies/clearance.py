"""`ctr-nlp clearance`: what clearance costs and brings in many airways."""

from __future__ import annotations

import argparse
from pathlib import Path

from ctr_nlp.cli.arguments import add_frames_option, add_out_option, whole
from ctr_nlp.cli.console import INTERRUPTED, SOLVED, SOME_FAILED, Command, console, progress_bar
from ctr_nlp.cli.output.folder import check_folder, place_of, published
from ctr_nlp.exceptions import OptionError
from ctr_nlp.studies.clearance import Source, study
from ctr_nlp.studies.clearance.report import findings, write


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Plan airways without clearance, with it and with clearance first, find what clearance alone "
        "could have, and write clearance.md, clearance.csv and clearance.png.",
        epilog="Exit status: 0 every frame solved, 1 some not, 2 bad input, 130 interrupted (what was done goes "
        "into DIR/interrupted, and DIR's own files stay).",
    )
    parser.add_argument("files", metavar="FILE", nargs="*", help="centreline files with radii")
    parser.add_argument("--seeds", metavar="N", type=whole, default=100, help="synthetic airways (default 100)")
    add_frames_option(parser)
    parser.add_argument("--jobs", metavar="N", type=whole, default=1, help="processes side by side (default 1)")
    add_out_option(parser, "runs/clearance")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    out, sources = Path(arguments.out), _sources(arguments.files, arguments.seeds)
    check_folder(out, "clearance")
    with progress_bar() as labelled:
        report = labelled("airways")
        cases = study(
            sources, arguments.frames, arguments.jobs, lambda done, name: report(done, len(sources), name)
        )
    if not cases:
        raise KeyboardInterrupt
    interrupted = len(cases) < len(sources)
    place = place_of(out, interrupted)
    with published(place, "clearance") as staging:
        write(cases, staging)
    for sentence in findings(cases):
        console().print(f"- {sentence}")
    console().print(f"wrote {place}: clearance.md, clearance.csv, clearance.png")
    if interrupted:
        return INTERRUPTED
    return SOLVED if all(case.solved for case in cases) else SOME_FAILED


def _sources(files: list[str], seeds: int) -> list[Source]:
    """Files and seeds; raises OptionError where there is nothing to study."""
    missing = [name for name in files if not Path(name).is_file()]
    if missing:
        raise OptionError(f"{missing[0]} is not a file; give centreline files")
    if seeds < 0 or not (seeds or files):
        raise OptionError(f"seeds is {seeds} beside {len(files)} files; give at least one airway")
    return [*map(Path, files), *range(seeds)]


main = Command("ctr-nlp clearance", _parser, _run)
