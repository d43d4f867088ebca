"""`ctr-nlp survival`: how plans of many airways survive robots that are not quite known."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ctr_nlp.cli.arguments import add_frames_option, add_out_option, whole
from ctr_nlp.cli.console import INTERRUPTED, SOLVED, SOME_FAILED, Command, console, progress_bar
from ctr_nlp.cli.output.folder import check_folder, published
from ctr_nlp.exceptions import OptionError
from ctr_nlp.studies.survival import Airway, study
from ctr_nlp.studies.survival.cases import DRAWS, read_rows, write_rows

TABLE = "survival.csv"


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Plan synthetic airways, far from any wall, for the robot as described at several stability "
        "margins and for its tolerances, and try all these plans on the same draws: how mean errors and shares of "
        "lost draws are distributed. Write survival.md, .csv, .png and .pdf. It takes half a minute an airway; "
        "the table is written after each, and a study that was stopped goes on where it was.",
        epilog="Exit status: 0 every plan was solved, 1 some not, 2 bad input, 130 interrupted.",
    )
    parser.add_argument("--seeds", metavar="N", type=whole, default=100, help="synthetic airways (default 100)")
    what = f"robots that the plans of an airway are tried on (default {DRAWS})"
    parser.add_argument("--draws", metavar="N", type=whole, default=DRAWS, help=what)
    add_frames_option(parser)
    parser.add_argument("--jobs", metavar="N", type=whole, default=1, help="processes side by side (default 1)")
    add_out_option(parser, "runs/survival")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    out, asked = Path(arguments.out), range(arguments.seeds)
    for name in ("seeds", "draws"):
        if getattr(arguments, name) < 1:
            raise OptionError(f"{name} is {getattr(arguments, name)}; it must be at least 1")
    check_folder(out, "survival")
    known = {airway.seed: airway for airway in read_rows(out / TABLE, arguments.frames, arguments.draws)}
    new = [seed for seed in asked if seed not in known]
    with progress_bar() as labelled:
        report = labelled("airways")
        total = len(known) + len(new)
        report(len(known), total, "known")
        for airway in study(new, arguments.frames, arguments.draws, arguments.jobs):
            known[airway.seed] = airway
            with published(out, "survival") as staging:
                write_rows(_in_order(known), staging / TABLE)
            report(len(known), total, f"synthetic {airway.seed}")
    if not known:
        raise KeyboardInterrupt
    _write(_in_order(known), out)
    if any(seed not in known for seed in asked):
        return INTERRUPTED
    return SOLVED if all(plan.solved for airway in known.values() for plan in airway.plans) else SOME_FAILED


def _in_order(known: dict[int, Airway]) -> list[Airway]:
    return [known[seed] for seed in sorted(known)]


def _write(airways: Sequence[Airway], out: Path) -> None:
    """All files, and what they say."""
    from ctr_nlp.studies.survival.report import findings, write  # brings matplotlib, which takes long to load

    with published(out, "survival") as staging:
        write(airways, staging)
        files = sorted(path.name for path in staging.iterdir())
    for sentence in findings(airways):
        console().print(f"- {sentence}")
    console().print(f"wrote {out}: {', '.join(files)}")


main = Command("ctr-nlp survival", _parser, _run)
