"""Films that programs write beside, or into, their output folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctr_nlp.cli.console import progress_bar
from ctr_nlp.figures.film import film
from ctr_nlp.plan import Plan


def write_film(plans: Sequence[Plan], file: Path, out: Path, staging: Path) -> None:
    """Write a film of plans and show how far it is; raises OptionError, OutputError.

    A file within the folder out, whose place staging is to take, is written into that.
    """
    place, folder = file.absolute(), out.absolute()
    target = staging / place.relative_to(folder) if place.is_relative_to(folder) else file
    with progress_bar() as labelled:
        film(plans, target, labelled(file.name))
