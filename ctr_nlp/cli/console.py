"""Parts of every program: calling it, printing its help, and its exit status."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import ctr_nlp
from ctr_nlp.cli.terminal_output import StdoutError, collect_output, print_stderr, write_stdout
from ctr_nlp.exceptions import CtrError, escape_control_characters, suggest_names
from ctr_nlp.support.interrupt import deferred_interrupt

EXIT_SOLVED, EXIT_SOME_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130
"""Exit codes of every program."""
EXAMPLES = Path(__file__).parent / "templates" / "examples.txt"
"""File of example calls: after a line `[NAME]`, for each example a line on what it does and one with its
arguments.
"""
INDENT = "  "
STDOUT = 1
"""The descriptor of standard output."""


class Command(NamedTuple):
    """Subcommand that can be called with arguments, and returns its exit status."""

    name: str
    """Name in usage messages."""
    options: Callable[[str], argparse.ArgumentParser]
    """Makes the parser of the subcommand's own options, given the name of the program."""
    run: Callable[[argparse.Namespace], int]

    def parser(self, prog: str) -> argparse.ArgumentParser:
        """Make the parser of the program's own options and those of every program; prog: its name in usage
        messages and examples.
        """
        own = self.options(prog)
        told = [""]
        given = examples(self.name.rpartition(" ")[2])
        if given:
            told += ["examples:", *(f"{INDENT}{what}\n{2 * INDENT}{prog} {call}".rstrip() for what, call in given)]
        parser = argparse.ArgumentParser(
            prog=prog,
            description=own.description,
            epilog=f"{own.epilog}\n" + "\n".join(told),
            parents=[own],
            add_help=False,
            formatter_class=_Formatter,
        )
        group = parser.add_argument_group("output")
        if "--json" not in own._option_string_actions:  # benchmark's names a file
            what = "print tables, lines and the names of files that were written as one JSON object on stdout"
            group.add_argument("--json", action="store_true", dest="as_json", help=what)
        what = "report progress on stderr, line by line: the step, how far it is and the time left"
        group.add_argument("-v", "--verbose", action="store_true", help=what)
        return parser

    def __call__(self, argv: list[str] | None = None, prog: str | None = None) -> int:
        """Run the subcommand, and return its exit status.

        argv: arguments, by default those of the process. prog: another name for usage messages.
        """
        return run_with_exit_status(
            lambda: self._run_and_report(parse_arguments(self.parser(prog or self.name), argv))
        )

    def _run_and_report(self, arguments: argparse.Namespace) -> int:
        """Run the program; with --json print its output, or the message of its error, as one JSON object."""
        with collect_output(getattr(arguments, "as_json", False), arguments.verbose) as told:
            if told is None:
                return self.run(arguments)
            known = {"command": self.name, "version": ctr_nlp.__version__}
            try:
                status = self.run(arguments)
            except CtrError as error:
                write_stdout(told.as_json(**known, exit_status=EXIT_BAD_INPUT, error=str(error)) + "\n")
                raise
            write_stdout(told.as_json(**known, exit_status=status, error=None) + "\n")
            return status


def examples(name: str) -> list[tuple[str, str]]:
    """Return the examples of the subcommand called `name`: for each what it does, and its arguments."""
    blocks = dict(block.split("]\n", 1) for block in EXAMPLES.read_text(encoding="utf-8").split("[")[1:])
    lines = blocks.get(name, "").splitlines()
    return [(what, call.strip()) for what, call in zip(lines[::2], lines[1::2], strict=True)]


class _Formatter(argparse.HelpFormatter):
    """Wraps the paragraphs of a help text, and leaves those with indented lines as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        filled = []
        for paragraph in text.split("\n\n"):
            as_it_is = f"\n{INDENT}" in paragraph
            filled.append(paragraph if as_it_is else super()._fill_text(paragraph, width, indent))
        return "\n\n".join(filled)


def parse_arguments(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse arguments; the error on an unknown option names the one that was probably meant.

    parser: of the program. argv: arguments, None for those of the process.
    """
    found, unknown = parser.parse_known_args(argv)
    if unknown:
        options = [option for option in parser._option_string_actions if option.startswith("--")]
        near = suggest_names(unknown[0].partition("=")[0], options)
        parser.error(f"unrecognized arguments: {escape_control_characters(' '.join(unknown))}{near}")
    return found


def run_with_exit_status(program: Callable[[], int]) -> int:
    """Run a program; bad input becomes one line and exit status 2, Ctrl-C exit status 130.

    The first Ctrl-C is left to the program, which ends early and writes what it has; a second ends it at once.
    """
    try:
        with deferred_interrupt():
            return program()
    except CtrError as error:
        print_stderr(f"error: {error}")
        return EXIT_BAD_INPUT
    except StdoutError as error:
        print_stderr(f"error: standard output cannot be written: {error}")
        _forget_stdout()
        return EXIT_SOME_FAILED
    except KeyboardInterrupt:
        print_stderr("interrupted; nothing was written")
        return EXIT_INTERRUPTED


def _forget_stdout() -> None:
    """Redirect standard output to nowhere once it has failed."""
    # Python flushes standard output when it ends, and would report the same failure again.
    if sys.stdout is sys.__stdout__:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, STDOUT)
        os.close(nowhere)
