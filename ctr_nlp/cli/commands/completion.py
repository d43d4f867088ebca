"""`ctr-nlp completion`: print the script with which a shell completes subcommands, options and problem names."""

from __future__ import annotations

import argparse
from typing import Any

from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.main import parser as whole_parser
from ctr_nlp.cli.terminal_output import write_stdout
from ctr_nlp.paths.named_problems import PROBLEM_NAMES
from ctr_nlp.support.extras import import_extra

SHELLS = ("bash", "zsh", "fish")
_PROBLEM_NAMES_TEXT = " ".join(PROBLEM_NAMES)
PROBLEM = {
    "bash": "_ctr_nlp_problem",
    "zsh": "_ctr_nlp_problem",
    "fish": f"(string split ' ' '{_PROBLEM_NAMES_TEXT}'; __fish_complete_path (commandline -ct))",
}
"""What completes a problem in each shell: names, and files."""
PREAMBLE = {
    "bash": f"_ctr_nlp_problem() {{ compgen -W '{_PROBLEM_NAMES_TEXT}' -- $1; compgen -f -- $1; }}",
    "zsh": f"_ctr_nlp_problem() {{ _values problem {_PROBLEM_NAMES_TEXT}; _files }}",
}
"""Definitions, by shell, that the completion of a problem needs."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Print what makes a shell complete subcommands, options, their values, names of problems and "
        'files. For bash, put this into ~/.bashrc: eval "$(ctr-nlp completion bash)"; for zsh, write it into a '
        "file _ctr-nlp in a folder of fpath; for fish, into ~/.config/fish/completions/ctr-nlp.fish.",
        epilog="Exit status: 0 where the text was printed, 2 where input is bad.",
    )
    parser.add_argument("shell", choices=SHELLS)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    shtab = import_extra("shtab")
    parser = whole_parser(every_option=True)
    (subparsers,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for command in subparsers.choices.values():
        for action in command._actions:
            _complete(action, shtab)
    write_stdout(shtab.complete(parser, shell=arguments.shell, preamble=PREAMBLE))
    return EXIT_SOLVED


def _complete(action: argparse.Action, shtab: Any) -> None:
    """Let an argument be completed according to its metavar."""
    meta = action.metavar if isinstance(action.metavar, str) else ""
    if isinstance(action.choices, dict):  # shtab takes these for subcommands
        action.choices = tuple(action.choices)
    how = PROBLEM if meta == "PROBLEM" else shtab.DIRECTORY if "DIR" in meta else shtab.FILE
    if meta in ("PROBLEM", "FILE", "DIR") or "." in meta:
        action.complete = how  # type: ignore[attr-defined]


main = Command("ctr-nlp completion", _parser, _run)
