"""What every program shares: how it is called and ends, its progress, its tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from ctr_nlp.exceptions import CtrError, meant
from ctr_nlp.support.interrupt import deferred_interrupt

SOLVED, SOME_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes of every program."""

PIPED_WIDTH = 160
"""Columns assumed where output does not go to a terminal."""


def console(stderr: bool = False) -> Console:
    """A console on stdout or stderr, wide enough for tables where it is not a terminal."""
    found = Console(stderr=stderr, highlight=False)
    return found if found.is_terminal else Console(stderr=stderr, highlight=False, width=PIPED_WIDTH)


@contextmanager
def progress_bar() -> Iterator[Callable[[str], Callable[[int, int, str], None]]]:
    """A bar on stderr; what it yields turns a label into a callback (done, total, note)."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)

        def labelled(label: str) -> Callable[[int, int, str], None]:
            bar.reset(task, description=label, total=None)

            def report(done: int, total: int, note: str) -> None:
                if done < bar.tasks[0].completed:
                    bar.reset(task)
                bar.tasks[0].total = total  # update(total=...) would forget how fast it went
                bar.update(task, description=f"{label} ({note})", completed=done)

            return report

        yield labelled


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], text: Collection[str] = ()
) -> None:
    """A table with a left-aligned first column and columns of text; numbers are cut to what is worth reading."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for i, column in enumerate(columns):
        table.add_column(
            column, justify="left" if i == 0 or column in text else "right", no_wrap=i == 0, overflow="fold"
        )
    for row in rows:
        table.add_row(*(cell if isinstance(cell, str) else _text(cell) for cell in row))
    console().print(table)


def _text(cell: Any) -> str:
    from ctr_nlp.plan.account import shown  # brings numerics, without which `doctor` must work

    return shown(cell)


class Command(NamedTuple):
    """A subcommand that can be called with arguments, and returns its exit status."""

    name: str
    """What usage calls it."""
    parser: Callable[[str], argparse.ArgumentParser]
    """From that name."""
    run: Callable[[argparse.Namespace], int]

    def __call__(self, argv: list[str] | None = None, prog: str | None = None) -> int:
        """Run with argv, or with what the process was given; prog: another name for usage."""
        return guarded(lambda: self.run(parsed(self.parser(prog or self.name), argv)))


def parsed(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> argparse.Namespace:
    """What a parser makes of argv; where an option is unknown, its error tells what was probably meant."""
    found, unknown = parser.parse_known_args(argv)
    if unknown:
        options = [option for option in parser._option_string_actions if option.startswith("--")]
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{meant(unknown[0].partition('=')[0], options)}")
    return found


def guarded(program: Callable[[], int]) -> int:
    """Run a program; bad input becomes one line and exit code 2, Ctrl-C exit code 130.

    The first Ctrl-C is left to the program, which ends early and writes what it has; a second ends it at once.
    """
    try:
        with deferred_interrupt():
            return program()
    except CtrError as error:
        sys.stderr.write(f"error: {error}\n")
        return BAD_INPUT
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; nothing was written\n")
        return INTERRUPTED
