"""Single output files, written whole or not at all, and names that are safe in paths."""

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
    """Raise OutputError unless `file` can be written and is new, empty or ours: with the text `opening` at byte
    `at`.
    """
    try:
        if file.is_symlink() or (file.exists() and not file.is_file()):
            raise OutputError(
                f"output file {file} is a folder or a link; choose a new file, or one that ctr-nlp wrote"
            )
        if file.exists():
            with open(file, "rb") as known:
                held = known.read(at + len(opening))
                # A file of ours that was cut short within its opening still counts as ours.
                if held and (len(held) <= at or not opening.encode().startswith(held[at:])):
                    raise OutputError(
                        f"output file {file} exists and was not written by ctr-nlp; choose another with --out"
                    )
        check_writable(file)
    except OSError as error:
        raise OutputError(f"output file {file} cannot be written: {error}") from error


def check_writable(path: Path) -> None:
    """Make a folder beside `path` and remove it, to see whether `path` can be written; raises OSError.

    It has the name of a staging folder: what a run leaves that is killed meanwhile, the next one removes. Another
    run that begins meanwhile may remove it, too.
    """
    trial = next(p for p in path.absolute().parents if p.exists()) / f"{MARK}-{secrets.token_hex(4)}"
    trial.mkdir()
    with suppress(FileNotFoundError):
        trial.rmdir()


@contextmanager
def output_file(file: Path) -> Iterator[Path]:
    """Yield a path to write to; when the block ends, it replaces `file`, whole or not at all. Raises
    OutputError.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(file) as partial:
            yield partial
    except OSError as error:
        raise OutputError(f"output file {file} cannot be written: {error}") from error


def write_text(file: Path, text: str) -> None:
    """Write text to a file in UTF-8, whole or not at all, with lone surrogates escaped; raises OutputError."""
    write_bytes(file, text.encode(errors="backslashreplace"))


def write_bytes(file: Path, content: bytes) -> None:
    """Write `content` to a file, whole or not at all; raises OutputError."""
    with output_file(file) as partial:
        partial.write_bytes(content)


MAX_PATH_COMPONENT_BYTES = 80
"""Most bytes of UTF-8 of a name in a path, well below the 255 that file systems allow."""
RESERVED = re.compile(r"(con|prn|aux|nul|(com|lpt)\w)(\..*)?", re.IGNORECASE)
"""Names that Windows keeps for devices, whatever their suffix."""


def path_component(name: str) -> str:
    """Return a name as one component of a path: as it is where that is safe, else changed and marked.

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
    """Tell whether a name is safe as a component of a path on every system."""
    return (
        re.fullmatch(r"\w[\w .-]*(?<![. ])", name) is not None
        and unicodedata.is_normalized("NFC", name)
        and len(name.encode()) <= MAX_PATH_COMPONENT_BYTES
        and RESERVED.fullmatch(name) is None
    )
