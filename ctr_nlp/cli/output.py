"""Output folders, written whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ctr_nlp.errors import OutputError

MARK = ".ctr_nlp"
"""A file of this name marks a folder as ours to replace."""


def check_folder(folder: Path) -> None:
    """Raise OutputError unless folder can be written and is new, empty or ours."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise OutputError(f"output folder {folder} is a file or a link; it must be new, empty or one of ours")
    try:
        if folder.is_dir() and any(folder.iterdir()) and not (folder / MARK).is_file():
            raise OutputError(f"output folder {folder} is not empty and not one of ours; name another with --out")
        _try_beside(folder)
    except OSError as error:
        raise OutputError(f"output folder {folder} cannot be written: {error}") from error


def _try_beside(path: Path) -> None:
    """Make something where path is to be, and take it away; raises OSError."""
    with tempfile.TemporaryDirectory(dir=next(p for p in path.absolute().parents if p.exists())):
        pass


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that takes folder's place when the block ends well, and vanishes otherwise."""
    check_folder(folder)
    target = folder.absolute()
    staging = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        mask = os.umask(0)
        os.umask(mask)
        staging.chmod(0o777 & ~mask)
        yield staging
        (staging / MARK).write_text("Written by ctr_nlp, which replaces this folder whole.\n", encoding="utf-8")
        if target.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
            os.replace(target, old / target.name)
            os.replace(staging, target)
            shutil.rmtree(old)
        else:
            os.replace(staging, target)
    except OSError as error:
        raise OutputError(f"output folder {folder} cannot be written: {error}") from error
    finally:
        if staging is not None:
            shutil.rmtree(staging, ignore_errors=True)


def check_file(file: Path, opening: str) -> None:
    """Raise OutputError unless a file can be written and is new, empty or one of ours."""
    try:
        if file.is_symlink() or (file.exists() and not file.is_file()):
            raise OutputError(f"output file {file} is a folder or a link; it must be new or one of ours")
        if file.exists():
            with open(file, "rb") as known:
                if not opening.encode().startswith(known.read(len(opening))):
                    raise OutputError(f"output file {file} exists and is not one of ours; name another with --out")
        _try_beside(file)
    except OSError as error:
        raise OutputError(f"output file {file} cannot be written: {error}") from error


def write_text(file: Path, text: str) -> None:
    """Write a file whole or not at all; raises OutputError."""
    partial = file.with_name(f".{file.name}.partial")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8", newline="")
        os.replace(partial, file)
    except OSError as error:
        raise OutputError(f"output file {file} cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)
