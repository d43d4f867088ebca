"""Which way up pictures of patients are, and titles that fit their figures."""

from dataclasses import replace

import numpy as np
import pytest
from common import named_problem
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import proj3d
from scipy.spatial.transform import Rotation

from ctr_nlp import solve_per_frame
from ctr_nlp.view.figures.film import _stage
from ctr_nlp.view.figures.overlay import shapes
from ctr_nlp.view.figures.parts.orientation import matplotlib_view, picture_axes
from ctr_nlp.view.figures.parts.page import TITLE_MARGIN_IN, add_title, wrap_line
from ctr_nlp.view.report.camera import cameras

DOWNWARDS = Rotation.from_euler("xz", [170.0, 30.0], degrees=True).as_matrix()
"""Axes of a scan in the frame of a robot that is inserted from above, in LPS: its z axis points to the feet."""


@pytest.fixture(scope="module")
def plan():
    return solve_per_frame(named_problem("arc", frames=3), model="dominant")


def placed(plan, space):
    """The plan as one in a scan whose axes have these letters."""
    signs = np.diag([1.0 if space[0] == "L" else -1.0, 1.0 if space[1] == "P" else -1.0, 1.0])
    to_robot = np.eye(4)
    to_robot[:3, :3] = DOWNWARDS @ signs
    problem = plan.meta["problem"] | {"space": space}
    return replace(plan, to_robot=to_robot, meta=plan.meta | {"problem": problem})


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_pictures_of_patients_have_the_head_up(plan, space):
    right, away, up = picture_axes([placed(plan, space)])
    np.testing.assert_allclose(right, DOWNWARDS[:, 0], atol=1e-12)  # the patient's left, as in radiology
    np.testing.assert_allclose(away, DOWNWARDS[:, 1], atol=1e-12)  # posterior
    np.testing.assert_allclose(up, DOWNWARDS[:, 2], atol=1e-12)  # superior
    assert up[2] < -0.9  # against the insertion


def test_without_a_patient_the_insertion_axis_points_up(plan):
    np.testing.assert_array_equal(picture_axes([plan]), np.eye(3))
    np.testing.assert_array_equal(picture_axes([placed(plan, "xyz")]), np.eye(3))
    np.testing.assert_array_equal(picture_axes([plan, placed(plan, "LPS")]), np.eye(3))


@pytest.mark.parametrize("seed", range(3))
def test_matplotlib_draws_superior_up_and_anterior_in_front(seed):
    axes = Rotation.random(random_state=seed).as_matrix()
    drawn = Figure().add_subplot(projection="3d")
    drawn.set_proj_type("ortho")
    for name in "xyz":
        getattr(drawn, f"set_{name}lim")(-1, 1)
    drawn.set_box_aspect((1, 1, 1))
    drawn.view_init(*matplotlib_view(axes, 10.0, -90.0))
    ends = np.array([proj3d.proj_transform(*end, drawn.get_proj()) for end in (np.zeros(3), *axes)])
    right, away, up = ends[1:] - ends[0]
    assert right[0] > 10 * abs(right[1])
    assert up[1] > 10 * abs(up[0])
    assert abs(away[:2]).max() < up[1] / 2


def test_the_page_begins_in_front_of_the_patient(plan):
    turned = picture_axes([placed(plan, "LPS")])
    numbers = np.array(cameras(np.array([-100.0, -10.0, -50.0]), np.array([100.0, 10.0, 100.0]), turned)["side"])
    place, target, up = np.split(numbers, 3)
    np.testing.assert_allclose(up, DOWNWARDS[:, 2], atol=1e-12)
    assert (place - target) @ DOWNWARDS[:, 1] < 0  # anterior of what it looks at


def test_films_of_patients_are_rolled(plan):
    _, (column,) = _stage([placed(plan, "LPS")])
    assert abs(abs(column.space.roll) - 180) < 30
    _, (column,) = _stage([plan])
    assert column.space.roll == 0


def test_titles_are_wrapped_to_the_width_of_their_figure():
    figure = Figure(figsize=(4.0, 3.0), dpi=100)
    add_title(figure, "short", "words of a title that are far too many for a figure of this width " * 2)
    lines = figure.get_suptitle().split("\n")
    assert lines[0] == "short"
    assert len(lines) > 3
    figure.draw_without_rendering()
    assert figure.texts[0].get_window_extent().width <= 100 * (4.0 - 2 * TITLE_MARGIN_IN) * 1.02
    assert wrap_line("unbreakable" * 20, 1.0, 10.0) == "unbreakable" * 20


def test_a_long_title_does_not_cover_shapes(plan):
    long = replace(plan, meta=plan.meta | {"problem": plan.meta["problem"] | {"name": "long name " * 40}})
    figure, usual = shapes(long), shapes(plan)
    figure.draw_without_rendering()
    title = figure.texts[0].get_window_extent()
    assert title.y0 > max(axes.title.get_window_extent().y1 for axes in figure.axes)
    heights = [each.axes[0].get_position().height * each.get_figheight() for each in (figure, usual)]
    assert heights[0] == pytest.approx(heights[1])
