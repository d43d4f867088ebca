"""The command `ctr-nlp`: its subcommands, each of which is imported when it is called, and no other."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from typing import TYPE_CHECKING, NamedTuple

import ctr_nlp
from ctr_nlp.exceptions import suggest_names

if TYPE_CHECKING:
    import argparse

    from ctr_nlp.cli.console import Command


class Entry(NamedTuple):
    """Where a subcommand is: its module in ctr_nlp.cli and its name there; summary: a line on what it does."""

    module: str
    name: str
    summary: str


COMMANDS = {
    "plan": Entry("commands.plan", "plan", "plan a motion whose whole shape follows a target"),
    "steer": Entry("commands.plan", "steer", "plan frame by frame, as a robot must while its target moves"),
    "live": Entry("steering.live", "main", "steer a robot in the browser, and record what it does"),
    "branches": Entry("commands.branches", "main", "list the branches of a centreline file"),
    "reach": Entry("studies.reach", "main", "find which ends of a tree which robots reach"),
    "inspect": Entry("commands.inspect", "main", "say what is read from a file of anatomy, and what was assumed"),
    "robust": Entry("commands.robust", "main", "simulate a plan on robots within the tolerances"),
    "check": Entry("commands.check", "main", "check a plan with code that shares nothing with the planners"),
    "under": Entry("loads.under", "main", "simulate the robot of a plan under a load"),
    "force": Entry("loads.force", "main", "find the tip forces that a plan withstands"),
    "contact": Entry("loads.contact", "main", "find the forces with which a plan touches the wall of its lumen"),
    "design": Entry("studies.design", "main", "choose tubes together with motions along several targets"),
    "choose": Entry("studies.choose", "main", "compare robots on one path: which reaches its end"),
    "calibrate": Entry("measured.calibrate", "main", "find a robot's tubes from measurements of its shape"),
    "report": Entry("commands.report", "main", "write plans as one page for a browser"),
    "export": Entry("commands.export", "main", "write a plan as commands of machines or files of other programs"),
    "import": Entry("exchange.configurations", "main", "make a plan of configurations from another program"),
    "play": Entry("commands.play", "main", "check a plan for some hardware and play it there"),
    "commission": Entry("commands.commission", "main", "read a controller, try its axes and keep its settings"),
    "study": Entry("studies.study", "main", "make thousands of plans, on this machine or on a cluster"),
    "trade": Entry("studies.trade", "main", "study error against robustness"),
    "new": Entry("commands.new", "main", "write a problem, robot, hardware, load or study file to start from"),
    "warm": Entry("commands.warm", "main", "compile what problems need before it is needed"),
    "doctor": Entry("commands.doctor", "main", "check what is installed, what is missing and how to install it"),
    "completion": Entry("commands.completion", "main", "print what completes commands in a shell"),
}
"""Every subcommand by its name, in the order in which --help lists them."""


def main(argv: list[str] | None = None) -> int:
    """Run the subcommand that `argv` names, and return its exit status."""
    if argv is None:
        _hold_interrupts()
        # Matrices are small: on a busy machine, one of 150 rows takes hundreds of times as long with two threads.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    given = sys.argv[1:] if argv is None else argv
    if given and given[0] in COMMANDS:
        return load(COMMANDS[given[0]])(given[1:])
    top = parser()
    if not given:
        top.print_help(sys.stderr)
        top.exit(2, f"\n{top.prog}: error: no command was given; the list above says what each one does\n")
    if not given[0].startswith("-"):
        top.error(
            f"no command is called {given[0]!r}; there are "
            f"{', '.join(COMMANDS)}{suggest_names(given[0], COMMANDS)}"
        )
    top.parse_args(given)
    return 0


def load(entry: Entry) -> Command:
    """Import the subcommand at `entry`, and return it."""
    command: Command = getattr(importlib.import_module(f"ctr_nlp.cli.{entry.module}"), entry.name)
    return command


def parser(every_option: bool = False) -> argparse.ArgumentParser:
    """Make the parser of all subcommands; every_option: with all their options, for which they must be
    imported.
    """
    import argparse  # not before Ctrl-C is held back

    made = argparse.ArgumentParser(
        prog="ctr-nlp",
        description="Steer concentric tube robots so that their whole shape follows a target.",
        epilog="`ctr-nlp COMMAND --help` lists the options of a command, with examples. With --json, a command "
        "prints its results as one JSON object; with --verbose, it reports progress. Exit status of every "
        "command: 0 where all is well, 1 where something is not, 2 where input is bad and nothing is written, 130 "
        "after an interruption.",
    )
    made.add_argument("--version", action="version", version=f"ctr-nlp {ctr_nlp.__version__}")
    commands = made.add_subparsers(metavar="COMMAND", required=True, title="commands")
    for name, entry in COMMANDS.items():
        options = [load(entry).parser(f"ctr-nlp {name}")] if every_option else []
        commands.add_parser(name, help=entry.summary, parents=options, add_help=not options)
    return made


def _hold_interrupts() -> None:
    """Block Ctrl-C while a program is imported; deferred_interrupt unblocks it."""
    if hasattr(signal, "pthread_sigmask"):
        # Otherwise it would raise KeyboardInterrupt amid imports of large libraries, with a traceback. Once
        # unblocked it is delivered, and so is not lost.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
