"""`python scripts/studies/reproduce.py`: remake the paper's figures and its Table II."""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Sequence
from pathlib import Path

from paper import SECTIONS, PaperResults, run_tasks
from paper.page import section_seconds, write
from paper.section import PaperSection

from ctr_nlp.cli.arguments import add_frames_option, add_out_option, whole
from ctr_nlp.cli.console import EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.terminal_output import console, print_table, progress_bar, report_written_files
from ctr_nlp.paths.named_problems import named_problem
from ctr_nlp.paths.target import check_frames
from ctr_nlp.support.interrupt import deferred_interrupt


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Remake the paper's Figs. 3 to 8, 9 (d) and 10 and its Table II beside what it printed, and "
        "write seed.md with pictures and the numbers behind them.",
        epilog="Exit status: 0 where every frame of our methods was solved, 1 where some were not, 2 where "
        "input is bad, 130 after an interruption (nothing is written then).",
    )
    parser.add_argument(
        "--only", metavar="NAME", nargs="+", choices=SECTIONS, help=f"of {', '.join(SECTIONS)} (default all)"
    )
    add_frames_option(parser)
    parser.add_argument("--jobs", metavar="N", type=whole, default=2, help="processes side by side (default 2)")
    add_out_option(parser, "runs/seed")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    wanted = arguments.only or SECTIONS
    sections = [section for name, section in SECTIONS.items() if name in wanted]
    check_frames(arguments.frames)
    check_folder(out, "seed")
    load = functools.partial(named_problem, frames=arguments.frames)
    tasks = [task for section in sections for task in section.tasks]
    with deferred_interrupt() as interrupted, progress_bar() as labelled:
        found = run_tasks(load, tasks, arguments.frames, arguments.jobs, labelled("runs"))
        report = labelled("pictures and tables")
        with output_folder(out, "seed") as staging:
            for number, name in enumerate(write(found, sections, staging), 1):
                report(number, len(sections), name)
                if interrupted():
                    raise KeyboardInterrupt
            files = sorted(path.name for path in staging.iterdir())
    _print(found, sections)
    for failure in found.failures():
        console().print(f"not solved: {failure}")
    times = ", ".join(f"{section.name} {section_seconds(found, section):.0f}" for section in sections)
    console().print(f"runs took {found.seconds:.0f} s; by part, in s of one process: {times}")
    report_written_files(out, files)
    return EXIT_SOME_FAILED if found.failures() else EXIT_SOLVED


def _print(found: PaperResults, sections: Sequence[PaperSection]) -> None:
    """Print Table II, where it is among the sections, and the result of every check, without marks of Markdown."""
    for table in SECTIONS["table2"].tables(found) if SECTIONS["table2"] in sections else ():
        lines = ([_plain(cell) for cell in line] for line in (table.header, *table.body))
        print_table(f"Table II, {table.caption}", next(lines), list(lines))
    for section in sections:
        for check in section.checks(found):
            console().print(_plain(f"{section.name}: {check.verdict}. {check.source}: {check.statement}"))


def _plain(text: str) -> str:
    return text.replace("**", "").replace("`", "")


main = Command("reproduce.py", _parser, _run)

if __name__ == "__main__":
    sys.exit(main())
