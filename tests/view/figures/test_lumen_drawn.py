"""The lumen in pictures of shapes: its outline covers what is within it, and nothing that is far outside."""

import dataclasses

import numpy as np
import pytest
from lumens import wandering
from matplotlib.collections import PolyCollection
from matplotlib.colors import same_color
from matplotlib.path import Path

from ctr_nlp import Problem, growing, solve_per_frame, table_i_robot
from ctr_nlp.view.figures import shapes
from ctr_nlp.view.figures.parts.palette import LUMEN_COLOUR


@pytest.fixture(scope="module")
def plan():
    path = wandering(3, bend=1 / 40, length=60.0)
    problem = Problem("wandering", table_i_robot(), growing(path, 8), lumen=path)
    return solve_per_frame(problem, model="dominant", direction="forward")


def covered(axes, points):
    """Which of the points (n, 2) are drawn as inside of the lumen."""
    (inside,) = (each for each in axes.collections if isinstance(each, PolyCollection) and drawn_as_inside(each))
    paths = [Path(path.vertices) for path in inside.get_paths()]
    return np.any([path.contains_points(points) for path in paths], axis=0)


def drawn_as_inside(collection):
    return same_color(collection.get_facecolor()[0], LUMEN_COLOUR)


@pytest.mark.parametrize("view", [0, 1])
def test_the_outline_covers_the_lumen_and_no_more(plan, view):
    """Seen from the side, a place is within it where some point of the path is nearer than the radius there."""
    figure = shapes(plan, [8])
    axes = figure.axes[view]
    centre, radius = plan.lumen[:, [view, 2]], plan.lumen[:, 3]
    points = np.random.default_rng(5).uniform(*np.transpose([axes.get_xlim(), axes.get_ylim()]), (4000, 2))
    gaps = np.linalg.norm(points[:, None] - centre, axis=-1) - radius
    between = (points[:, 1] > centre[0, 1] + radius[0]) & (points[:, 1] < centre[-1, 1] - radius[-1])
    found = covered(axes, points)
    assert found[between & (gaps.min(axis=1) < -1.0)].all()
    assert not found[gaps.min(axis=1) > 0.3].any()
    assert 200 < found.sum() < 3800


def test_the_key_names_the_lumen_only_where_there_is_one(plan):
    def named(some):
        return [text.get_text() for text in shapes(some).legends[0].get_texts()]

    bare = dataclasses.replace(plan, lumen=None, lumen_radius=None, clearance=None)
    assert named(plan) == [*named(bare), "lumen"]


def test_the_worst_frame_is_shown_and_named(plan):
    """Also where it is none of those that are evenly spread."""
    away = np.array(plan.shape)
    away[5] += 3.0
    figure = shapes(dataclasses.replace(plan, shape=away))
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    worst = [title for title in titles if "worst" in title]
    assert len(worst) == 1
    assert worst[0].startswith("frame 6\n")
    assert len(titles) == 7
