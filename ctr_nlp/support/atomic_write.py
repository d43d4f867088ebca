"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """A new empty file beside path, which takes path's place when the block ends well and vanishes otherwise.

    It has path's suffix and a name that nothing else has. Raises OSError where it cannot be made or moved.
    """
    partial = path.with_name(f".{path.stem[:40]}-{secrets.token_hex(4)}{path.suffix}")
    partial.touch(exist_ok=False)
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
