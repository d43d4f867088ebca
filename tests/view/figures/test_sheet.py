"""The drawing sheet shows every tube as it is made, and says its dimensions."""

from __future__ import annotations

import numpy as np
import pytest
from truth import FOUR

from ctr_nlp import Tube, table_i_robot
from ctr_nlp.exceptions import OutputError
from ctr_nlp.view.figures import save
from ctr_nlp.view.figures.sheet import TUBE_DIMENSION_COLUMNS, middle_line, sheet


def test_a_free_tube_is_the_arc_of_its_curvature():
    line = middle_line(Tube(202.0, 107.0, 1 / 60, 3.7, 2.9))
    curved, turn = line[1:], 107.0 / 60
    np.testing.assert_allclose(curved[-1], [60 * (1 - np.cos(turn)), 60 * np.sin(turn)], atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(np.diff(curved, axis=0), axis=1).sum(), 107.0, rtol=1e-9)
    np.testing.assert_array_equal(line[0], [0.0, -20.0])


@pytest.mark.parametrize("robot", [table_i_robot(), FOUR], ids=["three", "four"])
def test_the_table_tells_dimensions_of_every_tube(robot):
    figure = sheet(robot, "a robot")
    (table,) = [each for axes in figure.findobj(match=lambda a: hasattr(a, "tables")) for each in axes.tables]
    cells = {place: cell.get_text().get_text() for place, cell in table.get_celld().items()}
    assert [cells[0, k] for k in range(len(TUBE_DIMENSION_COLUMNS))] == list(TUBE_DIMENSION_COLUMNS)
    for i, tube in enumerate(robot.tubes, start=1):
        assert cells[i, 1] == f"{tube.outer_diameter:.3f} mm"
        assert cells[i, 3] == f"{(tube.outer_diameter - tube.inner_diameter) / 2:.3f} mm"
        assert cells[i, 5] == f"{tube.curved_length:.1f} mm"
        root = "straight" if tube.root_curvature == 0 else f"{1 / tube.root_curvature:.1f} mm"
        assert cells[i, 6] == root


def test_a_sheet_is_written_as_vectors(tmp_path):
    figure = sheet(table_i_robot(), "a robot")
    written = [save(figure, tmp_path / name) for name in ("sheet.svg", "sheet.pdf")]
    assert [path.name for path in written] == ["sheet.svg", "sheet.pdf"]
    assert b"<svg" in written[0].read_bytes()[:500]
    assert written[1].read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("name", ["sheet.svg", "sheet.pdf"])
def test_a_sheet_makes_the_same_file_again(tmp_path, name):
    first, again = (save(sheet(table_i_robot(), "a robot"), tmp_path / f"{k}-{name}") for k in range(2))
    assert first.read_bytes() == again.read_bytes()


def test_a_sheet_that_cannot_be_written_is_said(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        save(sheet(table_i_robot(), "a robot"), tmp_path / "nowhere" / "sheet.svg")
