"""Films that programs write beside, or into, their output folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctr_nlp.cli.console import progress_bar
from ctr_nlp.cli.output.folder import name_within
from ctr_nlp.figures.film import film
from ctr_nlp.plan.plan import Plan


def write_film(plans: Sequence[Plan], file: Path, out: Path, place: Path, staging: Path) -> Path:
    """Write a film of plans and show how far it is; returns where it will be. Raises OptionError, OutputError.

    out: the output folder that was asked for; place: the one that takes staging's files, another where the run was
    interrupted, which then takes all films. Otherwise a file that is not within out is written where it is to be.
    """
    inner = name_within(out, file)
    if inner is None and place == out:
        target = found = file
    else:
        target, found = staging / (inner or file.name), place / (inner or file.name)
    with progress_bar() as labelled:
        film(plans, target, labelled(file.name))
    return found
