"""Single output files, written whole or not at all."""

from __future__ import annotations

import secrets
from pathlib import Path

from ctr_nlp.cli.output.manifest import MARK
from ctr_nlp.exceptions import OutputError
from ctr_nlp.support.whole_file import whole_file


def check_file(file: Path, opening: str) -> None:
    """Raise OutputError unless a file can be written and is new, empty or ours: it begins with opening."""
    try:
        if file.is_symlink() or (file.exists() and not file.is_file()):
            raise OutputError(f"output file {file} is a folder or a link; it must be new or one of ours")
        if file.exists():
            with open(file, "rb") as known:
                if not opening.encode().startswith(known.read(len(opening))):
                    raise OutputError(f"output file {file} exists and is not one of ours; name another with --out")
        try_beside(file)
    except OSError as error:
        raise OutputError(f"output file {file} cannot be written: {error}") from error


def try_beside(path: Path) -> None:
    """Make something where path is to be, and take it away; raises OSError.

    It has the name of a staging folder: a run that is killed meanwhile leaves what the next one tidies away.
    """
    trial = next(p for p in path.absolute().parents if p.exists()) / f"{MARK}-{secrets.token_hex(4)}"
    trial.mkdir()
    trial.rmdir()


def write_text(file: Path, text: str) -> None:
    """Write a file whole or not at all; raises OutputError."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(file) as partial:
            partial.write_text(text, encoding="utf-8", newline="")
    except OSError as error:
        raise OutputError(f"output file {file} cannot be written: {error}") from error
