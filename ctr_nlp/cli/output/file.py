"""Single output files, written whole or not at all, and their names."""

from __future__ import annotations

import hashlib
import re
import secrets
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ctr_nlp.cli.output.manifest import MARK
from ctr_nlp.exceptions import OutputError
from ctr_nlp.support.atomic_write import write_atomically


def check_file(file: Path, opening: str, at: int = 0) -> None:
    """Raise OutputError unless a file can be written and is new, empty or ours: it has opening at byte `at`."""
    try:
        if file.is_symlink() or (file.exists() and not file.is_file()):
            raise OutputError(f"output file {file} is a folder or a link; it must be new or one of ours")
        if file.exists():
            with open(file, "rb") as known:
                held = known.read(at + len(opening))
                if held and (len(held) <= at or not opening.encode().startswith(held[at:])):
                    raise OutputError(f"output file {file} exists and is not one of ours; name another with --out")
        check_writable(file)
    except OSError as error:
        raise OutputError(f"output file {file} cannot be written: {error}") from error


def check_writable(path: Path) -> None:
    """Make a folder beside where `path` is to be, and remove it, to see that this can be done; raises OSError.

    It has the name of a staging folder: a run that is killed meanwhile leaves what the next one tidies away, and
    another run that begins meanwhile may tidy it away, too.
    """
    trial = next(p for p in path.absolute().parents if p.exists()) / f"{MARK}-{secrets.token_hex(4)}"
    trial.mkdir()
    with suppress(FileNotFoundError):
        trial.rmdir()


@contextmanager
def output_file(file: Path) -> Iterator[Path]:
    """Yield a path to write to; once the block ends, what was written there becomes the file, whole or not at all.
    Raises OutputError.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(file) as partial:
            yield partial
    except OSError as error:
        raise OutputError(f"output file {file} cannot be written: {error}") from error


def write_text(file: Path, text: str) -> None:
    """Write text to a file in UTF-8, whole or not at all; characters that UTF-8 cannot encode are escaped. Raises
    OutputError.
    """
    write_bytes(file, text.encode(errors="backslashreplace"))


def write_bytes(file: Path, content: bytes) -> None:
    """Write a file whole or not at all; raises OutputError."""
    with output_file(file) as partial:
        partial.write_bytes(content)


MAX_PATH_COMPONENT_BYTES = 80
"""Bytes of UTF-8 that a name may take in a path, well below the 255 that file systems allow."""
RESERVED = re.compile(r"(con|prn|aux|nul|(com|lpt)\w)(\..*)?", re.IGNORECASE)
"""Names that Windows keeps for devices, whatever their suffix."""


def path_component(name: str) -> str:
    """A name as one component of a path: a name that is safe as it stands, anything else changed and marked.

    Safe are letters, digits and the characters - _ . and space, with a letter, a digit or _ at the beginning and
    no dot or space at the end, up to MAX_PATH_COMPONENT_BYTES bytes. In other names everything else becomes _, and
    ~ with eight digits of the whole name's SHA-256 follows, so that names that differ stay different.
    """
    if _safe(name):
        return name
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    kept = re.sub(r"[^\w .-]", "_", unicodedata.normalize("NFC", name)).lstrip("-. ")
    prefix = "_" if RESERVED.fullmatch(kept) or not kept else ""
    short = f"{prefix}{kept}".encode()[: MAX_PATH_COMPONENT_BYTES - 9].decode(errors="ignore")
    return f"{short.rstrip('. ')}~{digest}"


def _safe(name: str) -> bool:
    return (
        re.fullmatch(r"\w[\w .-]*(?<![. ])", name) is not None
        and unicodedata.is_normalized("NFC", name)
        and len(name.encode()) <= MAX_PATH_COMPONENT_BYTES
        and RESERVED.fullmatch(name) is None
    )
