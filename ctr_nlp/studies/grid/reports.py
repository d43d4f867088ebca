"""Pages of their own that some studies end with, made from their rows."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ctr_nlp.exceptions import OptionError

REPORTS = ("reached", "survival")
"""Their names, which are those of the rooms that make them."""


def reported(report: str, rows: Sequence[Mapping[str, Any]], folder: Path) -> list[str]:
    """Write the page, the table and the picture of a report of REPORTS into a folder; what they say, in sentences.

    Raises OptionError where plans that the report sets beside each other are missing for every problem.
    """
    room = f"ctr_nlp.studies.{report}"
    found = importlib.import_module(f"{room}.cases").from_rows(rows)
    if not found:
        raise OptionError(
            f"no problem of the study has all the plans that a {report} report sets beside each other"
        )
    page = importlib.import_module(f"{room}.report")  # brings matplotlib, which takes long to load
    page.write(found, folder)
    sentences: list[str] = page.findings(found)
    return sentences
