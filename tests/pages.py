"""The parts of a Markdown page that tests look at."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

FENCE = re.compile(r"^( *)```(.*)$")


@dataclass(frozen=True)
class Block:
    """A fenced block: line of its fence, its language ("" where none is given), and its text."""

    line: int
    language: str
    text: str


@dataclass(frozen=True)
class Page:
    """A page's fenced blocks, and its lines with these left empty."""

    blocks: tuple[Block, ...]
    prose: tuple[str, ...]

    @classmethod
    def read(cls, path: Path) -> Page:
        """Raises ValueError where a fence is not closed."""
        blocks, prose, inside = list[Block](), list[str](), None
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            fence = FENCE.match(line)
            if inside is None and fence is None:
                prose.append(line)
                continue
            prose.append("")
            if inside is None and fence is not None:
                inside, indent, kept = (number, fence[2].strip()), len(fence[1]), list[str]()
            elif inside is not None and fence is not None and not fence[2]:
                blocks.append(Block(*inside, "\n".join(kept) + "\n"))
                inside = None
            else:
                kept.append(line[indent:] if line[:indent].isspace() else line)
        if inside is not None:
            raise ValueError(f"{path}: the fence of line {inside[0]} is not closed")
        return cls(tuple(blocks), tuple(prose))

    def sections(self) -> Iterator[str]:
        """The page's text, blocks included, from heading to heading."""
        blocks = {block.line: block.text for block in self.blocks}
        kept: list[str] = []
        for number, line in enumerate(self.prose, start=1):
            if line.startswith("#") and kept:
                yield "\n".join(kept)
                kept = []
            kept.append(blocks.get(number, line))
        yield "\n".join(kept)

    def links(self) -> list[str]:
        """Where links and pictures lead."""
        return re.findall(r"\]\(([^()\s]+)\)", "\n".join(self.prose))

    def anchors(self) -> set[str]:
        """What headings can be linked to by, as GitHub names them."""
        titles = [line.lstrip("#").strip().lower() for line in self.prose if re.match("#+ ", line)]
        return {re.sub(r"[^\w\- ]", "", title).replace(" ", "-") for title in titles}
