"""Output of programs: tables, lines and files on stdout, or with --json one object; progress on stderr."""

from __future__ import annotations

import io
import json
import math
import shlex
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from ctr_nlp.exceptions import escape_control_characters

PIPED_WIDTH = 160
"""Columns assumed where output does not go to a terminal."""
MAX_UNBROKEN_WORD = 20
"""Longest word that a table does not break, such as a file's name."""
PROGRESS_LINE_INTERVAL_S = 1.0
"""Seconds between lines of progress with --verbose."""
Labelled = Callable[[str], Callable[[int, int, str], None]]
"""Turns a label into a callback (done, total, note)."""


class StdoutError(Exception):
    """Standard output cannot be written, as on a full disk. No OSError, which is what writing files raises."""


@dataclass(frozen=True)
class JsonOutput:
    """Output of a program that is called with --json: tables, files that were written, and lines of text."""

    tables: list[dict[str, Any]] = field(default_factory=list)
    files: list[str] = field(default_factory=list)
    text: io.StringIO = field(default_factory=io.StringIO)

    def as_json(self, **more: Any) -> str:
        """Return the output as one JSON object, after the entries `more`; numbers that are not finite are null."""
        lines = self.text.getvalue().splitlines()
        return json.dumps(_plain({**more, "tables": self.tables, "lines": lines, "files": self.files}), indent=2)


_json_output: ContextVar[JsonOutput | None] = ContextVar("told", default=None)
_verbose: ContextVar[bool] = ContextVar("verbose", default=False)


@contextmanager
def collect_output(as_json: bool, verbose: bool) -> Iterator[JsonOutput | None]:
    """Collect a program's output within the block and yield it, where it is for JSON; else yield None.

    as_json: whether --json was given. verbose: whether progress is reported line by line on stderr.
    """
    told = JsonOutput() if as_json else None
    before = (_json_output.get(), _verbose.get())
    _json_output.set(told)
    _verbose.set(verbose)
    try:
        yield told
    finally:
        _json_output.set(before[0])
        _verbose.set(before[1])


class _Console(Console):
    """A console that shows strings as text: neither it nor the terminal obeys anything in them."""

    def __init__(self, **options: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as rich does; raises StdoutError where standard output takes no more."""
        try:
            super().print(*objects, **options)
        except OSError as error:
            if self.stderr:
                raise
            raise StdoutError(error.strerror) from error

    def render_str(self, text: str, **options: Any) -> Text:
        """Turn a string into text; rich calls this for every string that is printed, those of tables too."""
        return super().render_str(escape_control_characters(text), **options)


def console(stderr: bool = False) -> Console:
    """Return a console on stdout or stderr, wide enough for tables where it is not a terminal; a string is
    a line.
    """
    told = _json_output.get()
    if told is not None and not stderr:
        return _Console(file=told.text, width=1_000_000)
    found = _Console(stderr=stderr)
    return found if found.is_terminal else _Console(stderr=stderr, width=PIPED_WIDTH)


def print_stderr(line: str) -> None:
    """Print a line on stderr at its full length, without a part in what --json prints.

    Parameters
    ----------
    line : str
        The line, without its line break.
    """
    sys.stderr.write(f"{escape_control_characters(line)}\n")


def write_stdout(text: str) -> None:
    """Write text as it is on standard output; raises StdoutError."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        raise StdoutError(error.strerror) from error


def announce(line: str) -> None:
    """Print `line` at once for somebody who waits; with --json, whose object comes at the end, on stderr
    as well.
    """
    console().print(line, soft_wrap=True)
    if _json_output.get() is not None:
        console(stderr=True).print(line, soft_wrap=True)


def report_written_files(place: str | Path, files: Sequence[str] = (), more: str = "") -> None:
    """Report that the file `place` was written, or files in the folder `place`; `more` is added to the line."""
    told = _json_output.get()
    if told is not None:
        told.files.extend([str(Path(place) / name) for name in files] or [str(place)])
    else:
        named = f": {', '.join(files)}" if files else ""
        console().print(f"wrote {place}{named}{more}", soft_wrap=True)


def suggest_next(*commands: tuple[str, Sequence[object]]) -> None:
    """Print commands that a person may want next; with --json nothing.

    commands: what each does, and its words after ``ctr-nlp``.
    """
    if _json_output.get() is not None:
        return
    for purpose, words in commands:
        line = " ".join(["ctr-nlp", *(shlex.quote(str(word)) for word in words)])
        console().print(f"next, {purpose}: {line}", soft_wrap=True)


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    text: Collection[str] = (),
    styles: Mapping[str, str] | None = None,
    unbroken: Collection[str] = (),
) -> None:
    """Print a table with a left-aligned first column, which breaks lines between words.

    Parameters
    ----------
    title : str
        Title above the table.
    columns : sequence of str
        Names of the columns.
    rows : sequence of sequences
        Cells; numbers are cut to what is worth reading, text is shown as it is.
    text : collection of str
        Further columns that are left-aligned.
    styles : mapping, optional
        Colours of cells that are just such a word.
    unbroken : collection of str
        Columns whose cells stay on one line, such as coordinates, which are copied.
    """
    told = _json_output.get()
    if told is not None:
        told.tables.append({"title": title, "columns": list(columns), "rows": [list(row) for row in rows]})
        return
    table = Table(
        title=Text(escape_control_characters(title)),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    written = [[cell if isinstance(cell, str) else _text(cell) for cell in row] for row in rows]
    # Escaped characters are longer than those that they stand for.
    shown = [[escape_control_characters(cell) for cell in cells] for cells in written]
    terminal = console()
    widths = _column_widths(list(map(escape_control_characters, columns)), shown, unbroken, terminal.width)
    for i, column in enumerate(columns):
        table.add_column(
            column,
            justify="left" if i == 0 or column in text else "right",
            no_wrap=i == 0,
            overflow="fold",
            width=None if widths is None else widths[i],
        )
    for cells, texts in zip(written, shown, strict=True):
        styled = (Text(text, (styles or {}).get(cell, "")) for cell, text in zip(cells, texts, strict=True))
        table.add_row(*styled)
    terminal.print(table)


def _column_widths(
    columns: Sequence[str], rows: Sequence[Sequence[str]], unbroken: Collection[str], width: int
) -> list[int] | None:
    """Return widths of a table's columns that break no short word and together fill at most `width`; None where
    there are none.

    Left to itself, rich breaks words of narrow columns although wide ones could wrap between words.
    """
    cells = [[column, *(row[i] for row in rows)] for i, column in enumerate(columns)]
    whole = [i == 0 or column in unbroken for i, column in enumerate(columns)]
    found = [max(map(len, some)) for some in cells]
    least = [
        max(map(len, [*some[0].split(), *some[1:]]))
        if keep
        else min(max((len(word) for cell in some for word in cell.split()), default=0), MAX_UNBROKEN_WORD)
        for some, keep in zip(cells, whole, strict=True)
    ]
    # Two spaces follow each column, and one begins the line.
    room = width - 2 * len(columns) - 1
    if sum(least) > room:
        return None
    while sum(found) > room:
        widest = max(range(len(found)), key=lambda i: found[i] - least[i])
        found[widest] -= 1
    return found


@contextmanager
def progress_bar() -> Iterator[Labelled]:
    """Show a bar on stderr, and with --verbose lines beside it; yield what turns a label into a callback."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)
        begin = time.monotonic()

        def labelled(label: str) -> Callable[[int, int, str], None]:
            bar.reset(task, description=escape_control_characters(label), total=None)
            last = -math.inf
            if _verbose.get():
                bar.console.print(f"{time.monotonic() - begin:8.1f} s  {label}")

            def report(done: int, total: int, note: str) -> None:
                nonlocal last
                if done < bar.tasks[0].completed:
                    bar.reset(task)
                bar.tasks[0].total = total  # update(total=...) would forget how fast it went
                bar.update(task, description=escape_control_characters(f"{label} ({note})"), completed=done)
                now = time.monotonic() - begin
                if _verbose.get() and (now - last >= PROGRESS_LINE_INTERVAL_S or done == total):
                    last = now
                    left = bar.tasks[0].time_remaining
                    until = "" if left is None or done == total else f", about {left:.0f} s left"
                    bar.console.print(f"{now:8.1f} s  {label}: {note}, {done} of {total}{until}")

            return report

        yield labelled


@contextmanager
def busy(label: str) -> Iterator[None]:
    """Show a bar with `label` while a step runs whose progress is not known; elsewhere than on a terminal a line
    with --verbose, and nothing without.
    """
    if not (console(stderr=True).is_terminal or _verbose.get()):
        yield
        return
    with progress_bar() as labelled:
        labelled(label)
        yield


def _text(cell: Any) -> str:
    from ctr_nlp.plan.summary_text import format_cell  # brings numerics, without which `doctor` must work

    return format_cell(cell)


def _plain(value: Any) -> Any:
    """Return a value as JSON has it."""
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if hasattr(value, "tolist"):  # of numpy, which `doctor` must work without
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
