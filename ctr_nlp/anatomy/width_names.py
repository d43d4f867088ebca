"""Names that programs give to the size of the lumen along a centreline."""

from __future__ import annotations

import re

WIDTH_NAMES = {
    **dict.fromkeys(("radius", "lumenradius", "inscribedradius", "maximuminscribedsphereradius", "misr"), 1.0),
    **dict.fromkeys(("diameter", "lumendiameter", "maximuminscribedspherediameter"), 0.5),
}
"""Names without punctuation in lower case, and the factor from each to the radius."""
PERHAPS_WIDTH = re.compile(
    r"rad|diam|width|caliber|calibre|thick|bore|size|^[rd](?:min|max|mean|avg|med|fit|hyd|eq|inscribed|lumen)?[0-9]?$"
)
NO_WIDTH = re.compile(r"curv|radian|bend|grad")


def may_be_width(name: str) -> bool:
    """Return whether `name`, without punctuation and in lower case, may mean the lumen's size."""
    return name in WIDTH_NAMES or bool(PERHAPS_WIDTH.search(name) and not NO_WIDTH.search(name))
