"""Pages of their own that some studies end with, made from their rows."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ctr_nlp.exceptions import OptionError
from ctr_nlp.studies.grid.case import DONE

REPORTS = ("survival",)
"""Their names, which are those of the rooms that make them."""


def reported(report: str, rows: Sequence[Mapping[str, Any]], folder: Path) -> list[str]:
    """Write the page, the table and the picture of a report of REPORTS into a folder; what they say, in sentences.

    Rows that hold no plan are left out. Raises OptionError where plans that the report sets beside each other are
    missing for every problem.
    """
    room = f"ctr_nlp.studies.{report}"
    airways = importlib.import_module(f"{room}.cases").airways([row for row in rows if row["status"] == DONE])
    if not airways:
        raise OptionError(
            f"no problem of the study has all the plans that a {report} report sets beside each other"
        )
    page = importlib.import_module(f"{room}.report")  # brings matplotlib, which takes long to load
    page.write(airways, folder)
    sentences: list[str] = page.findings(airways)
    return sentences
