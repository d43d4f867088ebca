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
        parent = next(ancestor for ancestor in folder.absolute().parents if ancestor.exists())
        with tempfile.TemporaryDirectory(dir=parent):
            pass
    except OSError as error:
        raise OutputError(f"output folder {folder} cannot be written: {error}") from error


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
