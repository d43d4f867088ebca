"""`ctr-nlp report`: write plans as one page for a browser."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ctr_nlp.cli.arguments import add_film_option, add_out_option, film_file
from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.output.file import write_text
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.output.manifest import read_manifest
from ctr_nlp.cli.plan_report import write_film
from ctr_nlp.cli.second_opinion import form_opinions
from ctr_nlp.cli.terminal_output import busy, report_written_files
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.plan import Plan
from ctr_nlp.view.figures import VECTOR_FORMATS, save_all
from ctr_nlp.view.report import page

PAGE = "report.html"
OTHER_FOLDER = "runs/report"
"""Folder of pages that have no plan's folder of their own."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description=f"Write {PAGE}: the moving robot in three dimensions, plots and numbers of a plan, or of "
        "several side by side in step. It is one file, which opens in a browser without a network. The page of "
        "one plan lies beside it if ctr-nlp wrote its folder, and is deleted when a new plan is written there.",
        epilog="Exit status: 0 where the page was written, 2 where input is bad and nothing is written.",
    )
    parser.add_argument("plans", metavar="PLAN.npz", nargs="+")
    add_out_option(parser, f"the folder of PLAN.npz, or {OTHER_FOLDER}")
    add_film_option(parser)
    what = "also write the plan's figures for print, as files of this format beside the page; for one plan"
    parser.add_argument("--figures", choices=VECTOR_FORMATS, help=what)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out) if arguments.out else _default_folder(arguments.plans)
    film = film_file(arguments)
    if arguments.figures is not None and len(arguments.plans) > 1:
        raise OptionError(
            f"--figures goes with one plan, and {len(arguments.plans)} were given; write the figures of each by a "
            "command of its own"
        )
    check_folder(out, "report", film)
    plans = [Plan.load(path) for path in arguments.plans]
    with busy("plans are checked a second time"):
        opinions = [form_opinions(path) for path in arguments.plans]
    with busy("the page is made"):
        text = page(plans, arguments.plans, opinions)
    drawn: list[str] = []
    with output_folder(out, "report") as staging:
        write_text(staging / PAGE, text)
        if arguments.figures is not None:
            with busy("figures are drawn"):
                drawn = sorted(path.name for path in save_all(plans[0], staging, arguments.figures))
        if film is not None:
            write_film(plans, film, out, out, staging)
    report_written_files(out / PAGE, more=f" ({len(text) / 1e6:.1f} MB); open it in a browser")
    if drawn:
        report_written_files(out, drawn)
    if film is not None:
        report_written_files(film)
    return EXIT_SOLVED


def _default_folder(plans: Sequence[str]) -> Path:
    """Return the folder of the only plan where a run wrote it; else one that no plan of another run is in."""
    beside = Path(plans[0]).parent
    return beside if len(plans) == 1 and read_manifest(beside) is not None else Path(OTHER_FOLDER)


main = Command("ctr-nlp report", _parser, _run)
