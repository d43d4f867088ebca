"""A small interpreter of URScript: what a program commands, sample by sample."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

OPENING = re.compile(r"(def|while|if) .*:$")


@dataclass
class Played:
    """What a program has commanded, in order: names of calls, and where movej and servoj go, rad."""

    calls: list[str] = field(default_factory=list)
    movej: list[Any] = field(default_factory=list)
    servoj: list[Any] = field(default_factory=list)
    periods: list[float] = field(default_factory=list)

    @property
    def samples(self) -> np.ndarray:
        """Targets of servoj, (N, 6) rad."""
        return np.array(self.servoj)

    @property
    def seconds(self) -> float:
        """Time that all servoj take, s."""
        return float(sum(self.periods))


def as_python(program: str) -> str:
    """The program in Python: blocks are indented by what opens and ends them, not by how they are written."""
    depth, lines = 0, []
    for row in program.splitlines():
        text = row.partition("#")[0].strip()
        if not text:
            continue
        if text == "end":
            depth -= 1
            assert depth >= 0
            continue
        lines.append("    " * depth + text)
        depth += OPENING.match(text) is not None
    assert depth == 0
    return "\n".join(lines)


def play(program: str) -> Played:
    """Run a program that defines one function without arguments, and return what it commands."""
    found = Played()

    def called(name):
        def call(*args, **options):
            found.calls.append(name)
            if name == "movej":
                found.movej.append(args[0])
            if name == "servoj":
                assert len(args[0]) == 6
                found.servoj.append(args[0])
                found.periods.append(options["t"])

        return call

    names = {name: called(name) for name in ("movej", "servoj", "popup", "stopj")}
    (main,) = re.findall(r"^def (\w+)\(\):$", program, re.M)
    exec(compile(as_python(program), "program", "exec"), names)
    names[main]()
    return found
