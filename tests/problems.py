"""The named problems, as the scripts load them."""

from __future__ import annotations

import runpy
from pathlib import Path

from ctr_nlp import Problem

FOLDER = Path(__file__).resolve().parents[1] / "problems"
NAMES = sorted(path.stem for path in FOLDER.glob("*.py"))


def named(name: str, frames: int = 100) -> Problem:
    """A problem of problems/."""
    problem: Problem = runpy.run_path(str(FOLDER / f"{name}.py"))["problem"](frames)
    return problem
