"""Notebooks: each runs from top to bottom, and shows again what is kept in it, but for rounding."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

nbformat = pytest.importorskip("nbformat", reason='needs Jupyter: pip install -e ".[notebooks]"')
nbclient = pytest.importorskip("nbclient", reason='needs Jupyter: pip install -e ".[notebooks]"')

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.ipynb"))
LONG = {"4_robust_and_designed_tubes.ipynb", "5_calibration_and_closed_loop.ipynb"}
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]?\d+)?")


def run(name: str) -> tuple[Any, Any]:
    """A notebook as it is kept, and as it is after all of its cells have run anew."""
    kept, new = (nbformat.read(FOLDER / name, as_version=4) for _ in range(2))
    nbclient.NotebookClient(new, timeout=1800, resources={"metadata": {"path": str(FOLDER)}}).execute()
    return kept, new


def kinds(cell: Any) -> list[tuple[str, list[str]]]:
    """What a cell shows: text that it prints, pictures, pages."""
    return [(output.output_type, sorted(output.get("data", {}))) for output in cell.get("outputs", [])]


def printed(cell: Any) -> str:
    return "".join(output.text for output in cell.get("outputs", []) if output.output_type == "stream")


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LONG)) for n in NOTEBOOKS])
def test_a_notebook_runs_and_shows_what_is_kept_in_it(name: str) -> None:
    kept, new = run(name)
    for before, after in zip(kept.cells, new.cells, strict=True):
        assert kinds(before) == kinds(after), before.source
        words, again = (re.findall(r"[^\W\d]+", NUMBER.sub("", printed(cell))) for cell in (before, after))
        assert words == again
        numbers, found = ([float(n) for n in NUMBER.findall(printed(cell))] for cell in (before, after))
        np.testing.assert_allclose(found, numbers, rtol=0.1, atol=0.05, err_msg=before.source)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_was_kept_as_it_ran(name: str) -> None:
    """Every cell in order, none in vain, and no path of a machine in what it printed."""
    cells = [cell for cell in nbformat.read(FOLDER / name, as_version=4).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert any(kinds(cell) for cell in cells)
    assert not any(re.search(r"/(home|root|tmp|Users)/", str(cell)) for cell in cells)
    assert (FOLDER / name).stat().st_size < 400e3
