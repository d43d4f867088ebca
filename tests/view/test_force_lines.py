"""Forces of a wall on a robot, as pages and films show them: lines that end at the body."""

from dataclasses import replace

import numpy as np
import pytest
from lumens import straight
from matplotlib.figure import Figure

from ctr_nlp import Problem, Robot, Target, Tube
from ctr_nlp.plan.plan import plan_from_configurations
from ctr_nlp.view.figures.film import _stage
from ctr_nlp.view.figures.parts.palette import CONTACT
from ctr_nlp.view.figures.parts.wall_forces import LONGEST_FORCE_LINE_MM, describe_force_lines, wall_force_lines
from ctr_nlp.view.report import page
from ctr_nlp.view.report.scene import SCENE_FORCES_PART, _force_objects

ROBOT = Robot((Tube(90, 70, 0.0, 1.6, 1.2), Tube(150, 90, 0.0, 1.0, 0.6)))
FRAMES, PIECES = 2, 3


@pytest.fixture(scope="module")
def free():
    """A straight robot of 60 and 80 mm in a straight lumen."""
    lengths = np.linspace(60.0, 80.0, FRAMES)
    problem = Problem("line", ROBOT, Target((straight(2.0, 80.0),) * FRAMES, tuple(lengths.tolist())))
    q = np.zeros((FRAMES, 6))
    q[:, 2], q[:, 3] = 40.0, lengths
    each = dict.fromkeys(("solve_time", "objective", "kkt"), np.zeros(FRAMES))
    meta = {"model": "elastic", "failures": {}, "options": {"motion_weight": 1e-6}, "interrupted": False}
    return plan_from_configurations(problem, q, meta, success=np.full(FRAMES, True), **each)


@pytest.fixture(scope="module")
def pressed(free):
    """The same robot with forces along x and against y at 10, 30 and 50 mm, none at the last in frame 1."""
    direction = np.zeros((FRAMES, PIECES, 3))
    direction[:, :2, 0], direction[:, 2, 1] = 1.0, -1.0
    return replace(
        free,
        wall_force=np.array([[0.02, 0.01, 0.0], [0.01, 0.04, 0.02]]),
        wall_force_along=np.tile([10.0, 30.0, 50.0], (FRAMES, 1)),
        wall_force_direction=direction,
        place_force=np.array([0.02, 0.04]),
        place_force_between=np.array([0.02, 0.04]),
        stability_without_wall=np.ones(FRAMES),
        meta=free.meta | {"wall_contact": {"limit_N": 0.05}},
    )


def test_lines_end_at_the_body_and_come_from_where_the_wall_presses(pressed):
    lines = wall_force_lines(pressed)
    assert lines.shape == (FRAMES, PIECES, 2, 3)
    np.testing.assert_allclose(lines[:, :, 1], np.tile([[0, 0, 10], [0, 0, 30], [0, 0, 50]], (FRAMES, 1, 1)))
    scale = LONGEST_FORCE_LINE_MM / 0.04
    away = lines[1, :, 0] - lines[1, :, 1]
    np.testing.assert_allclose(away, scale * np.array([[-0.01, 0, 0], [-0.04, 0, 0], [0, 0.02, 0]]))
    np.testing.assert_array_equal(lines[0, 2, 0], lines[0, 2, 1])
    assert describe_force_lines(pressed) == "force of the wall, 15 mm for 0.04 N"


def test_no_force_has_lines_without_length(pressed):
    lines = wall_force_lines(replace(pressed, wall_force=np.zeros((FRAMES, PIECES))))
    np.testing.assert_array_equal(lines[:, :, 0], lines[:, :, 1])


class Kept:
    """Stands for k3d, and keeps what it is asked to draw."""

    @staticmethod
    def lines(vertices, indices, **told):
        return {"vertices": vertices, "indices": indices} | told


def test_the_scene_moves_a_line_for_each_piece(free, pressed):
    (told,) = _force_objects(Kept, pressed)
    assert told["custom_data"] == {"part": SCENE_FORCES_PART}
    assert told["indices"].tolist() == [[0, 1], [2, 3], [4, 5]]
    for j in range(FRAMES):
        np.testing.assert_allclose(
            told["vertices"][str(j)].reshape(PIECES, 2, 3), wall_force_lines(pressed)[j], rtol=1e-6
        )
    assert _force_objects(Kept, free) == []


def test_the_page_explains_the_lines_where_there_are_any(free, pressed):
    assert "force of the wall, 15 mm for 0.04 N" in page([pressed])
    assert f'data-part="{SCENE_FORCES_PART.replace(chr(39), "&#39;")}"' in page([pressed])
    assert "force of the wall" not in page([free])


def test_a_film_draws_them_in_every_picture(pressed):
    figure, (column,) = _stage([pressed])
    assert isinstance(figure, Figure)
    for j in range(FRAMES):
        column.show((j + 1) / FRAMES)
        (line,) = [line for line in column.space.lines if line.get_color() == CONTACT]
        drawn = np.array(line.get_data_3d()).T.reshape(PIECES, 3, 3)[:, :2]
        np.testing.assert_allclose(drawn, wall_force_lines(pressed)[j])
    assert "wall's force" in [text.get_text() for text in figure.legends[0].get_texts()]
