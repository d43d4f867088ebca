"""Films that programs write beside, or into, their output folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctr_nlp.cli.console import progress_bar
from ctr_nlp.figures.film import film
from ctr_nlp.plan import Plan


def write_film(plans: Sequence[Plan], file: Path) -> Path:
    """Write a film of plans and show how far it is; raises OptionError, OutputError."""
    with progress_bar() as labelled:
        return film(plans, file, labelled(file.name))


def staged(file: Path, out: Path, staging: Path) -> Path:
    """Where to write a file while staging is to take the place of the folder out: in there, if it lies in that."""
    place, folder = file.absolute(), out.absolute()
    return staging / place.relative_to(folder) if place.is_relative_to(folder) else file
