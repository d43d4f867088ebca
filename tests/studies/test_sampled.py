"""Sampling-based planning: a path through a lumen that touches nothing, and what cannot have one."""

from dataclasses import replace

import numpy as np
import pytest
from methods.comparison import parse_variant
from methods.rrt_connect import SearchSpace, rrt_connect

from ctr_nlp import Problem, Settings, curve_from_points, growing, table_i_robot
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.problems import named_problem

FRAMES, MARGIN = 40, 0.1
STRICT = Settings(stability_margin=MARGIN, contact_allowed=0.0)
ROBOT, ELASTIC = table_i_robot(), KINEMATIC_MODELS["elastic"]


def bent(radius, length=90.0):
    """A lumen along an arc of 80 mm radius."""
    s = np.linspace(0.0, 130.0, 60) / 80
    lumen = curve_from_points(80 * np.column_stack([1 - np.cos(s), 0 * s, np.sin(s)]), np.full(60, radius))
    return Problem("bent", ROBOT, growing(lumen.part(0, length), FRAMES), lumen=lumen)


def test_a_path_leads_to_the_last_frame_and_touches_nothing_on_the_way():
    """As the plan's own simulation says: it is moved frame by frame, and its wall is looked at anew."""
    pytest.importorskip("ompl")
    problem = bent(5.0, 60.0)
    plan = rrt_connect(problem, STRICT, seconds=60)
    assert plan.complete
    assert plan.meta["snaps"] == []
    assert np.nanmin(plan.clearance) > 0
    assert plan.stability_between.min() > MARGIN - 0.02
    assert np.linalg.norm(plan.shape[-1, -1] - problem.target_frames[-1].points[-1]) < 1.0
    again = parse_variant("rrt-connect").plan(problem, STRICT, (), None)
    np.testing.assert_array_equal(again.q, plan.q)


def test_points_and_unknowns_are_inverse_and_keep_the_order_of_tubes():
    room, rng = SearchSpace(bent(5.0), STRICT), np.random.default_rng(0)
    low, high = room.bounds(np.zeros((1, 8)))
    for place in rng.uniform(low, high, (50, 8)):
        x = room.unknowns(place)
        assert (np.diff(x[3:6]) >= -1e-9).all()
        assert (x[3:6] >= ROBOT.lower[3:6] - 1e-9).all()
        assert (x[3:6] <= ROBOT.upper[3:6] + 1e-9).all()
        np.testing.assert_allclose(room.unknowns(room.to_point(x)), x, atol=1e-9)


def test_what_touches_the_wall_or_is_near_the_snap_is_not_valid():
    straight = ELASTIC.rest(ROBOT, np.array([0.0, 0, 0, 30, 60, 90, 0, 0]))
    assert SearchSpace(bent(60.0), STRICT).is_valid_robot(straight)
    assert not SearchSpace(bent(4.0), STRICT).is_valid_robot(straight + np.pi / 2 * (np.arange(8) == 2))
    opposed = ELASTIC.rest(ROBOT, np.array([3.1, 0.0, 0.0, 40.0, 90.0, 140.0, 0.0, 0.0]))
    assert ELASTIC.margins(ROBOT, opposed[None])[0] < 0.3
    assert SearchSpace(bent(200.0), STRICT).is_valid_robot(opposed)
    assert not SearchSpace(bent(200.0), replace(STRICT, stability_margin=0.3)).is_valid_robot(opposed)


def test_a_problem_without_a_wall_is_refused():
    with pytest.raises(OptionError, match="within a lumen, and arc has none"):
        rrt_connect(named_problem("arc", 3))


def test_a_lumen_that_the_robot_does_not_fit_is_refused():
    pytest.importorskip("ompl")
    with pytest.raises(OptionError, match=r"no valid robot for frame 1 of bent: in the lumen but for 0\.5 mm"):
        rrt_connect(bent(1.5), seconds=1)


def test_bad_times_are_refused():
    with pytest.raises(OptionError, match="seconds is -1"):
        rrt_connect(bent(5.0), seconds=-1)
