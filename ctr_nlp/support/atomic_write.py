"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield a new empty file that takes the place of `path` when the block ends well, and is removed otherwise.

    The file lies beside `path`, with its suffix and a random name. Raises OSError where it cannot be made or
    moved.
    """
    partial = path.with_name(f".{path.stem[:40]}-{secrets.token_hex(4)}{path.suffix}")
    partial.touch(exist_ok=False)
    try:
        yield partial
        # A rename within one file system is atomic, hence the file beside `path`: readers find the old file or the
        # whole new one.
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
