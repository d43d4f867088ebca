"""Films that programs write beside, or into, their output folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctr_nlp.cli.console import progress_bar
from ctr_nlp.figures.film import film
from ctr_nlp.plan import Plan


def write_film(plans: Sequence[Plan], file: Path, out: Path, place: Path, staging: Path) -> Path:
    """Write a film of plans and show how far it is; returns where it will be. Raises OptionError, OutputError.

    out: the output folder that was asked for; place: the one that takes staging's files, another where the run was
    interrupted. A file within out is written into staging; so is any other where out takes none.
    """
    if file.absolute().is_relative_to(out.absolute()):
        name = file.absolute().relative_to(out.absolute())
    elif place != out:
        name = Path(file.name)
    else:
        name = file.absolute()
    with progress_bar() as labelled:
        film(plans, staging / name, labelled(file.name))
    return file if name.is_absolute() or place == out else place / name
