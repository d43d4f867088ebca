"""Output of programs: tables, lines and files on stdout, or with --json one object; progress on stderr."""

from __future__ import annotations

import io
import json
import math
import shlex
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Column, Table
from rich.text import Text

from ctr_nlp.exceptions import escape_control_characters

PIPED_TABLE_WIDTH = 100
"""Columns that tables may take where output does not go to a terminal."""
UNBROKEN_LINE_WIDTH = 1_000_000
"""Columns of a console that breaks no line."""
MAX_UNBROKEN_WORD = 20
"""Longest word that a table does not break, such as a file's name."""
PROGRESS_LINE_INTERVAL_S = 1.0
"""Seconds between lines of progress with --verbose."""
LONGEST_SILENCE_S = 10.0
"""Seconds without a line after which a command whose stderr is no terminal says what it is doing."""
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


@dataclass
class _LineTimes:
    """When a command began and when it last printed a line of progress, s of `time.monotonic`."""

    begin: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.last = self.begin

    def record_line(self, now: float) -> None:
        """Record that a line is printed at the time `now`, s of `time.monotonic`."""
        self.last = now


_line_times: ContextVar[_LineTimes | None] = ContextVar("line_times", default=None)


@contextmanager
def collect_output(as_json: bool, verbose: bool) -> Iterator[JsonOutput | None]:
    """Collect a program's output within the block and yield it, where it is for JSON; else yield None.

    as_json: whether --json was given. verbose: whether progress is reported line by line on stderr.
    """
    told = JsonOutput() if as_json else None
    before = (_json_output.get(), _verbose.get(), _line_times.get())
    _json_output.set(told)
    _verbose.set(verbose)
    _line_times.set(_LineTimes())
    try:
        yield told
    finally:
        _json_output.set(before[0])
        _verbose.set(before[1])
        _line_times.set(before[2])


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
    """Return a console on stdout or stderr; where it is not a terminal, a string is a line, however long."""
    told = _json_output.get()
    if told is not None and not stderr:
        return _Console(file=told.text, width=UNBROKEN_LINE_WIDTH)
    found = _Console(stderr=stderr)
    return found if found.is_terminal else _Console(stderr=stderr, width=UNBROKEN_LINE_WIDTH)


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
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    written = [[cell if isinstance(cell, str) else _text(cell) for cell in row] for row in rows]
    # Escaped characters are longer than those that they stand for.
    shown = [[escape_control_characters(cell) for cell in cells] for cells in written]
    terminal = console()
    width = terminal.width if terminal.is_terminal else PIPED_TABLE_WIDTH
    widths = _column_widths(list(map(escape_control_characters, columns)), shown, unbroken, width)
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
    # rich would wrap a title at the table's width, and break the name of a file in it.
    if title:
        terminal.print(Text(escape_control_characters(title), style="italic"), soft_wrap=True)
    terminal.print(table, width=width)


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


class _CountColumn(ProgressColumn):
    """Shows how many steps are done of how many; nothing of a single step, or where their number is not known."""

    def render(self, task: Task) -> Text:
        """Return the column's text for the state of a task."""
        return Text("" if _is_uncounted(task) else f"{task.completed:.0f}/{task.total:.0f}")


def _is_uncounted(task: Task) -> bool:
    """Tell whether a task is a single step, or one of an unknown number of steps."""
    return task.total is None or task.total <= 1


class _TimeColumn(ProgressColumn):
    """Shows the time that a step has taken and, where it can be estimated, the time left."""

    def render(self, task: Task) -> Text:
        """Return the column's text for the state of a task."""
        taken = timedelta(seconds=int(task.elapsed or 0))
        left = _seconds_left(task)
        return Text(str(taken) if left is None else f"{taken}, about {timedelta(seconds=math.ceil(left))} left")


def _seconds_left(task: Task) -> float | None:
    """Return the estimate of the seconds until a step is done; None where there is none, or it has run out."""
    if _is_uncounted(task) or task.finished or task.start_time is None or not task.completed:
        return None
    reported: float = task.fields["reported"]
    estimate = task.time_remaining
    if estimate is None:  # rich waits for a second report
        estimate = (reported - task.start_time) / task.completed * (task.remaining or 0.0)
    # The estimate is that of the last report: what was to take one second more would stand at one second for as
    # long as it takes.
    left = estimate - (time.monotonic() - reported)
    return left if left > 0 else None


class _ProgressLines:
    """Lines about progress for those who read them in a log.

    bar: whose task is reported. verbose: whether every step has a line, and further ones follow each other after
    PROGRESS_LINE_INTERVAL_S; otherwise a line comes where there was none for LONGEST_SILENCE_S. times: when the
    command began and last printed one.
    """

    def __init__(self, bar: Progress, verbose: bool, times: _LineTimes) -> None:
        self._bar = bar
        self._verbose = verbose
        self._times = times
        self._ended = threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._lock = threading.Lock()

    def __enter__(self) -> _ProgressLines:
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._watcher.join()

    def begin_step(self) -> None:
        """Print the line of a step that begins, if it is due."""
        self._print_after(0.0 if self._verbose else LONGEST_SILENCE_S)

    def report(self, done: bool) -> None:
        """Print a line on how far the step is, if it is due; done: whether the step is done."""
        interval = PROGRESS_LINE_INTERVAL_S if self._verbose else LONGEST_SILENCE_S
        self._print_after(0.0 if done and self._verbose else interval)

    def _watch(self) -> None:
        """Print a line whenever there was none for too long, until the block ends."""
        while not self._ended.wait(max(0.1, self._times.last + LONGEST_SILENCE_S - time.monotonic())):
            self._print_after(LONGEST_SILENCE_S)

    def _print_after(self, seconds: float) -> None:
        """Print the state of the task, unless the last line is less than some seconds old."""
        with self._lock:
            task = self._bar.tasks[0]
            now = time.monotonic()
            if now - self._times.last < seconds or not task.description:
                return
            self._times.record_line(now)
            count = "" if _is_uncounted(task) else f", {task.completed:.0f} of {task.total:.0f}"
            left = _seconds_left(task)
            until = "" if left is None else f", about {left:.0f} s left"
            line = f"{now - self._times.begin:8.1f} s  {task.description}{count}{until}"
            if self._bar.console.is_terminal:
                self._bar.console.print(line)
                return
            # A log that is not read any more must not end the work, least of all while motors run; rich would end
            # the process.
            with suppress(OSError):
                print_stderr(line)


@contextmanager
def progress_bar() -> Iterator[Labelled]:
    """Show a bar on stderr where it is a terminal, and lines otherwise or with --verbose; yield what turns a label
    into a callback.

    Where the number of steps is not known, the bar shows the time that has passed. A log gets a line whenever none
    was printed for LONGEST_SILENCE_S, with --verbose more.
    """
    columns = (
        TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis")),
        BarColumn(bar_width=20),
        _CountColumn(),
        _TimeColumn(),
    )
    terminal = console(stderr=True)
    bar = Progress(*columns, console=terminal, transient=True)
    task = bar.add_task("", total=None, visible=False)
    lines = None
    if _verbose.get() or not terminal.is_terminal:
        lines = _ProgressLines(bar, _verbose.get(), _line_times.get() or _LineTimes())

    def labelled(label: str) -> Callable[[int, int, str], None]:
        bar.tasks[0].total = None  # reset(total=None) would keep the last one
        bar.reset(task, description=escape_control_characters(label), visible=True)
        if lines is not None:
            lines.begin_step()

        def report(done: int, total: int, note: str) -> None:
            # What is reported as a single step takes its own time.
            if done < bar.tasks[0].completed or total <= 1:
                bar.reset(task)
            bar.tasks[0].total = total  # update(total=...) would forget how fast it went
            described = escape_control_characters(f"{label}: {note}" if note else label)
            bar.update(task, description=described, completed=done, reported=time.monotonic())
            if lines is not None:
                lines.report(done == total)

        return report

    # In a log, rich would print an empty line where the bar ends.
    with bar if terminal.is_terminal else nullcontext(), lines or nullcontext():
        yield labelled


@contextmanager
def busy(label: str) -> Iterator[None]:
    """Show a step whose progress is not known, with the time that it has taken; see `progress_bar`."""
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
