"""Follow-the-leader deployment: which tubes follow which paths, and how near the others come."""

import dataclasses
import itertools

import leaders
import numpy as np
import pytest
import shooting
from common import named_problem
from methods.comparison import VARIANTS, parse_variant
from reference import reference_frames
from reference.follow_the_leader import find_deployment
from scipy.spatial import cKDTree

from ctr_nlp import Limits, Problem, Robot, Settings, Tube, curve_from_points, growing, solve_per_frame, summary
from ctr_nlp.exceptions import OptionError
from ctr_nlp.planning.per_frame import march

pytestmark = pytest.mark.interpreted
EXACT = 0.02
"""mm: what counts as exact."""
DEPTHS = 8
SIGMA = np.linspace(0.0, 1.0, 81)


def planned(problem, name="follow-the-leader"):
    return march(problem, reference_frames(problem, name, Settings()), "forward")


@pytest.mark.parametrize("name", leaders.ROBOTS)
def test_the_body_shot_from_the_base_is_on_the_path_at_every_depth(name):
    """The path is integrated from its curvatures, the body from the balance of moments."""
    problem, robot = leaders.problem(name, DEPTHS), leaders.ROBOTS[name]
    plan = planned(problem)
    nominal = shooting.tubes(robot, np.zeros((1, robot.d, 5)))
    motion = shooting.followed(nominal, plan.q, SIGMA, aligned=False)
    assert motion.snapped[0] == 0
    path = leaders.path(name)
    for depth, shape in zip(problem.target.lengths, motion.shapes[0], strict=True):
        expected = np.stack([np.interp(SIGMA * depth, path.s, column) for column in path.points.T], axis=1)
        assert np.linalg.norm(shape - expected, axis=1).max() < EXACT


@pytest.mark.parametrize("name", leaders.ROBOTS)
def test_the_elastic_model_says_the_same_and_is_stable(name):
    plan = planned(leaders.problem(name, DEPTHS))
    found = summary(plan)
    assert found["failed"] == 0
    assert found["e_max"] < EXACT
    assert not plan.verdicts.failed_names


@pytest.mark.parametrize("name", ["helix left", pytest.param("three tubes", marks=pytest.mark.slow)])
def test_our_planner_finds_such_paths(name):
    problem = leaders.problem(name, DEPTHS)
    exact, own = (summary(plan)["e_max"] for plan in (planned(problem), solve_per_frame(problem, model="elastic")))
    assert abs(own - exact) < EXACT


def test_a_deployed_circle_is_one():
    """All points of the body are as far from the centre as the radius is, in closed form."""
    plan = planned(leaders.problem("circle", DEPTHS))
    whole = plan.shape[-1]
    centre, radius = _sphere(whole)
    assert radius == pytest.approx(60, abs=1e-3)
    np.testing.assert_allclose(np.linalg.norm(plan.shape.reshape(-1, 3) - centre, axis=1), 60, atol=1e-3)


def _sphere(points):
    """Centre and radius of the circle (n, 3) by least squares in its plane."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle)[2][:2]
    flat = (points - middle) @ axes.T
    x, y, rest = np.linalg.lstsq(
        np.column_stack([2 * flat, np.ones(len(flat))]), (flat**2).sum(axis=1), rcond=None
    )[0]
    return middle + np.array([x, y]) @ axes, np.sqrt(rest + x * x + y * y)


def test_tubes_stop_where_the_path_changes():
    np.testing.assert_allclose(
        find_deployment(leaders.problem("three tubes", 2)).depths, leaders.ENDS["three tubes"], atol=1e-3
    )


def test_tubes_turned_by_pi_straighten_each_other():
    """Where two equal circles oppose each other the path is straight; beyond them it is the inner one's."""
    outer = Tube(60, 30, 0.01, 2.4, 2.0)
    inner = Tube(120, 80, 0.01, 1.9, 1.5)
    ratio = outer.bending_stiffness / inner.bending_stiffness
    inner = dataclasses.replace(inner, youngs_modulus=ratio)
    robot = Robot((outer, inner))
    path = leaders.frenet([(20.0, 0.0), (50.0, 0.01)], 0.0)
    found = find_deployment(Problem("straight first", robot, growing(curve_from_points(path), 2)))
    assert found.opposed.tolist() == [False, True]
    np.testing.assert_allclose(found.depths, [20, 70], atol=1e-3)


LINEAR = Robot((Tube(200, 110, (0.01, 0.02), 2.0, 1.6),))
UNLIKE = Robot((leaders.ROBOTS["three tubes"].tubes[0], leaders.ROBOTS["two tubes"].tubes[1]))
SHORT = Robot((Tube(200, 60, 0.012, 2.0, 1.6, pre_torsion=leaders.TORSION),), Limits(beta=[(0, 150)]))


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (LINEAR, r"constant curvatures, and that of tube 1 changes"),
        (UNLIKE, r"one torsion, and those of tubes 1 and 2 are 0.012 and 0 rad/mm"),
        (SHORT, r"straight parts inside"),
        (leaders.ROBOTS["helix left"], r"away from the nearest such path"),
    ],
)
def test_what_does_not_fulfil_a_condition_is_refused_by_its_name(robot, message):
    problem = dataclasses.replace(leaders.problem("helix right", 2), robot=robot)
    with pytest.raises(OptionError, match=message):
        planned(problem)


@pytest.mark.parametrize("method", ["follow-the-leader", "follow-the-leader-approximate"])
def test_a_target_that_is_no_growing_path_is_refused(method):
    with pytest.raises(OptionError, match="one path that grows"):
        planned(named_problem("synthesis", 3), method)
    assert method not in VARIANTS
    assert parse_variant(method).model == "elastic"


@pytest.mark.slow
def test_the_approximate_method_keeps_to_an_exact_path():
    found = summary(planned(leaders.problem("two tubes", 20), "follow-the-leader-approximate"))
    assert found["failed"] == 0
    assert found["e_max"] < 0.1


@pytest.mark.slow
def test_the_approximate_method_keeps_nearer_to_the_path_of_its_tip_than_a_plan_of_tips_alone():
    """Measured at every depth as the distance of the body from the polyline through all tips so far."""
    problem = named_problem("arc", 20)
    away = {}
    for method in ("follow-the-leader-approximate", "tip-resolved"):
        plan = planned(problem, method)
        tips = np.vstack([np.zeros(3), plan.shape[:, -1]])
        dense = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(tips)])
        away[method] = cKDTree(dense).query(plan.shape[5:].reshape(-1, 3))[0].max()
    assert away["follow-the-leader-approximate"] < 0.5 * away["tip-resolved"]
