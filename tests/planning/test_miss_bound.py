"""The lower bound on the distance of the tip from the end of the path."""

import numpy as np
import pytest

import ctr_nlp as ctr
from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.paths.curve import curve_from_points
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import growing
from ctr_nlp.planning.miss_bound import bound_miss

ROBOT = ctr.Robot(
    (
        ctr.Tube(160, 50, 1 / 90, outer_diameter=2.4, inner_diameter=2.0),
        ctr.Tube(300, 90, 1 / 50, outer_diameter=1.6, inner_diameter=1.2),
    )
)
SIGMA = np.linspace(0.0, 1.0, 21)


def bend(radius_of_bend, angle_deg, lumen=2.0, straight=25.0):
    """A lumen that is straight and then bends, as a problem."""
    turn = np.radians(np.linspace(0, angle_deg, 60))
    arc = np.column_stack(
        [radius_of_bend * (1 - np.cos(turn)), 0 * turn, straight + radius_of_bend * np.sin(turn)]
    )
    points = np.vstack([np.column_stack([np.zeros(25), np.zeros(25), np.linspace(0, straight, 25)]), arc[1:]])
    curve = curve_from_points(points, np.full(len(points), lumen))
    return Problem("bend", ROBOT, growing(curve, 2), lumen=curve)


def find_least_miss(problem, count, seed, contact=0.5):
    """The least miss of random configurations, near the length of the path, with at most some contact, mm."""
    random = np.random.default_rng(seed)
    d = problem.robot.d
    x = np.zeros((count, 2 * d + 2))
    x[:, :d] = random.uniform(-np.pi, np.pi, (count, d))
    length = problem.target_frames[-1].length
    x[:, 2 * d - 1] = np.minimum(random.uniform(0.8 * length, 1.1 * length, count), problem.robot.reach)
    x[:, d] = random.uniform(0, 1, count) * np.minimum(50.0, x[:, 2 * d - 1])
    x[:, -2:] = random.normal(0, 0.25, (count, 2))
    body = KINEMATIC_MODELS["elastic"].points(problem.robot, x, SIGMA)
    near = problem.wall.project(body)
    outer = SIGMA * x[:, 2 * d - 1, None] <= x[:, d, None]
    depth = (np.where(outer, 1.2, 0.8) - (near.radius - near.distance)).max(axis=1)
    miss = np.linalg.norm(body[:, -1] - problem.target_frames[-1].points[-1], axis=1)
    return miss[depth <= contact].min(initial=np.inf)


def test_end_of_a_straight_lumen_is_not_excluded():
    assert bound_miss(bend(60.0, 20.0, lumen=4.0), time_limit=0.2).miss == 0.0


@pytest.mark.parametrize(
    ("contact", "count"), [(3.0, 6_000), *(pytest.param(c, 200_000, marks=pytest.mark.slow) for c in (2.0, 4.0))]
)
def test_no_random_configuration_beats_the_bound(contact, count):
    problem = bend(10.0, 150.0, lumen=3.0)
    found = bound_miss(problem, contact=contact, time_limit=0.5 if count < 10_000 else 10.0)
    assert found.miss > 0.5
    least = find_least_miss(problem, count, seed=0, contact=contact)
    assert found.miss < least
    # Some configurations are allowed, so that this says something.
    assert least < np.inf


def test_bound_grows_with_time_and_falls_with_contact():
    problem = bend(10.0, 120.0)
    short, long = (bound_miss(problem, time_limit=limit) for limit in (0.01, 0.4))
    assert short.miss <= long.miss
    assert short.cells < long.cells
    assert bound_miss(problem, contact=3.0, time_limit=0.01).miss <= long.miss


def test_search_ends_where_the_bound_is_enough():
    found = bound_miss(bend(10.0, 120.0), time_limit=60.0, enough=0.5)
    assert found.complete
    assert found.miss == 0.5
    assert found.seconds < 60.0


def test_path_longer_than_the_robot_is_missed_by_the_rest():
    curve = curve_from_points(np.column_stack([np.zeros(91), np.zeros(91), np.arange(91.0)]), np.full(91, 5.0))
    # Almost straight, so that the robot could come as far as it is long.
    tube = ctr.Tube(300, 90, 1 / 5000, outer_diameter=1.6, inner_diameter=1.2)
    short = ctr.Robot((tube,), ctr.Limits(beta=((0, 89.6),)))
    found = bound_miss(Problem("line", short, growing(curve, 2), lumen=curve), time_limit=0.3)
    assert 0.3 < found.miss <= 0.41


def test_problem_without_a_wall_is_refused():
    curve = curve_from_points(np.column_stack([np.zeros(31), np.zeros(31), np.arange(31.0)]))
    with pytest.raises(ProblemError, match="no wall"):
        bound_miss(Problem("line", ROBOT, growing(curve, 2)))


@pytest.mark.parametrize("asked", [{"contact": -1.0}, {"time_limit": 0.0}])
def test_numbers_out_of_range_are_named(asked):
    with pytest.raises(OptionError, match=next(iter(asked))):
        bound_miss(bend(60.0, 20.0), **asked)
