"""Reports that some studies end with, made from their rows."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ctr_nlp.exceptions import OptionError

REPORTS = ("reached", "survival")
"""Names of the reports; each is made by the package of ctr_nlp.studies of that name."""


def write_report(report: str, rows: Sequence[Mapping[str, Any]], folder: Path) -> list[str]:
    """Write the page, the table and the figure of a report into a folder.

    Parameters
    ----------
    report : str
        Which report, of REPORTS.
    rows : sequence of mapping
        The rows of the study.
    folder : Path
        The folder.

    Returns
    -------
    list of str
        The findings, a sentence each.

    Raises
    ------
    OptionError
        No problem of the study has all plans that the report compares.
    """
    room = f"ctr_nlp.studies.{report}"
    # Imported by name: studies without a report load none of it.
    found = importlib.import_module(f"{room}.cases").from_rows(rows)
    if not found:
        raise OptionError(
            f"no problem of the study has all the plans that a {report} report sets beside each other"
        )
    page = importlib.import_module(f"{room}.report")  # brings matplotlib, which takes long to load
    page.write(found, folder)
    sentences: list[str] = page.findings(found)
    return sentences
