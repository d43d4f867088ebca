"""What a person sees: progress while a program works, tables at its end."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

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
