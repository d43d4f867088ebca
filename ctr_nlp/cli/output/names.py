"""Names from files and plans as parts of paths."""

from __future__ import annotations

import hashlib
import re
import unicodedata

LONGEST = 80
"""Bytes of UTF-8 that a name may take in a path, well below the 255 that file systems allow."""
RESERVED = re.compile(r"(con|prn|aux|nul|(com|lpt)\w)(\..*)?", re.IGNORECASE)
"""Names that Windows keeps for devices, whatever their suffix."""


def path_component(name: str) -> str:
    """A name as one component of a path: a name that is safe as it stands, anything else changed and marked.

    Safe are letters, digits and the characters - _ . and space, with a letter, a digit or _ at the beginning and
    no dot or space at the end, up to LONGEST bytes. In other names everything else becomes _, and ~ with eight
    digits of the whole name's SHA-256 follows, so that names that differ stay different.
    """
    if _safe(name):
        return name
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    kept = re.sub(r"[^\w .-]", "_", unicodedata.normalize("NFC", name)).lstrip("-. ")
    prefix = "_" if RESERVED.fullmatch(kept) or not kept else ""
    short = f"{prefix}{kept}".encode()[: LONGEST - 9].decode(errors="ignore")
    return f"{short.rstrip('. ')}~{digest}"


def _safe(name: str) -> bool:
    return (
        re.fullmatch(r"\w[\w .-]*(?<![. ])", name) is not None
        and unicodedata.is_normalized("NFC", name)
        and len(name.encode()) <= LONGEST
        and RESERVED.fullmatch(name) is None
    )
