"""A command: how its arguments are read, and what it does with them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import NamedTuple

from ctr_nlp.cli.console import BAD_INPUT, INTERRUPTED
from ctr_nlp.exceptions import CtrError
from ctr_nlp.support.interrupt import deferred_interrupt


class Command(NamedTuple):
    """A subcommand that can be called with arguments, and returns its exit status."""

    name: str
    """What usage calls it."""
    parser: Callable[[str], argparse.ArgumentParser]
    """From that name."""
    run: Callable[[argparse.Namespace], int]

    def __call__(self, argv: list[str] | None = None, prog: str | None = None) -> int:
        """Run with argv, or with what the process was given; prog: another name for usage."""
        return guarded(lambda: self.run(self.parser(prog or self.name).parse_args(argv)))


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
