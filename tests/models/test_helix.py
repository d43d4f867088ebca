"""Tubes whose pre-curvature turns along them: helices, alone and twisting each other."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from truth import Shot

from ctr_nlp import Limits, Load, Loaded, Robot, Tube
from ctr_nlp.exceptions import CtrError, RobotError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.elastic.equilibria import Equilibria

pytestmark = pytest.mark.interpreted
SIGMA = np.linspace(0.0, 1.0, 31)
K, TORSION = 0.012, 0.015
OUTER, INNER = Tube(120, 60, 0.008, 2.6, 2.2, pre_torsion=-0.02), Tube(200, 110, K, 2.0, 1.5, pre_torsion=TORSION)
LONE = Robot((INNER,))
PAIR = Robot((OUTER, INNER))
SHOWN = Robot((OUTER, Tube(160, 70, 0.015, 2.18, 2.02), INNER), Limits(beta=[(0, 80), (0, 100), (0, 150)]))
POSES = {
    "two helices": (PAIR, (1.2, -0.3, 50, 90, 0.3, -0.2)),
    "an arc between them": (SHOWN, (0.8, -0.6, 0.2, 75, 90, 140, 0.0, 0.2)),
}


def wound(k, torsion, s):
    """A helix (n, 3) along z at first and bent to x, from its closed form about its own axis."""
    w = np.hypot(k, torsion)
    radius, rise = k / w**2, torsion / w
    about = np.stack([radius * (1 - np.cos(w * s)), radius * np.sin(w * s), rise * s], axis=1)
    axis = np.array([0.0, k, torsion]) / w  # that of the helix, where it is bent to x and goes on along z
    return about @ np.stack([[1.0, 0.0, 0.0], np.cross([1.0, 0.0, 0.0], axis), axis])


@pytest.mark.parametrize("name", ["dominant", "elastic"])
@pytest.mark.parametrize("torsion", [TORSION, -TORSION])
def test_a_lone_helix_is_one_through_the_opening(name, torsion):
    robot, model = Robot((dataclasses.replace(INNER, pre_torsion=torsion),)), KINEMATIC_MODELS[name]
    q = np.array([0.4, 80.0, 0.3, -0.2])
    turned = Rotation.from_euler("y", q[3]) * Rotation.from_euler("x", q[2])
    turned *= Rotation.from_euler("z", q[0] + torsion * (110 - 80))
    expected = turned.apply(wound(K, torsion, 80 * SIGMA))
    np.testing.assert_allclose(model.points(robot, model.rest(robot, q)[None], SIGMA)[0], expected, atol=3e-3)


@pytest.mark.parametrize("name", ["two helices", pytest.param("an arc between them", marks=pytest.mark.slow)])
def test_shapes_and_angles_are_those_of_the_equations_shot_from_the_base(name):
    robot, q = POSES[name]
    q, elastic = np.array(q), KINEMATIC_MODELS["elastic"]
    shot, x = Shot(robot, q), elastic.rest(robot, q)
    np.testing.assert_allclose(x, shot.x, atol=1e-3)
    np.testing.assert_allclose(elastic.points(robot, x[None], SIGMA)[0], shot.points(SIGMA), atol=0.01)


def test_the_margin_is_that_of_finite_elements():
    robot, q = POSES["two helices"]
    q = np.array(q)
    margin = KINEMATIC_MODELS["elastic"].margins(robot, KINEMATIC_MODELS["elastic"].rest(robot, q)[None])[0]
    assert margin == pytest.approx(Shot(robot, q).margin(12), abs=3e-3)


def test_tubes_that_cannot_twist_and_outweigh_each_other_are_those_of_the_dominant_model():
    stiff = Robot(
        tuple(
            dataclasses.replace(tube, youngs_modulus=1e-7**i, poisson_ratio=-1 + 1e-9)
            for i, tube in enumerate(SHOWN.tubes)
        ),
        SHOWN.limits,
    )
    q = np.array([0.8, -0.6, 0.2, 75, 90, 140, 0.0, 0.2])
    x = KINEMATIC_MODELS["elastic"].rest(stiff, q)[None]
    expected = KINEMATIC_MODELS["dominant"].points(stiff, q[None], SIGMA)
    np.testing.assert_allclose(KINEMATIC_MODELS["elastic"].points(stiff, x, SIGMA), expected, atol=0.01)


def test_a_left_and_a_right_helix_are_mirrored():
    robot, q = POSES["two helices"]
    mirrored = Robot(tuple(dataclasses.replace(t, pre_torsion=-t.pre_torsion) for t in robot.tubes))
    elastic, other = KINEMATIC_MODELS["elastic"], q * np.array([-1, -1, 1, 1, 0, 0])
    q = q * np.array([1, 1, 1, 1, 0, 0])
    points = elastic.points(robot, elastic.rest(robot, q)[None], SIGMA)[0]
    image = elastic.points(mirrored, elastic.rest(mirrored, other)[None], SIGMA)[0]
    np.testing.assert_allclose(image, points * [1, -1, 1], atol=1e-9)


def test_a_helix_that_snaps_falls_to_where_it_would_be_settled_from_the_other_side():
    """Past its fold a pair of long helices falls, by its energy, to where motors turned back by 2 pi settle it."""
    tubes = (Tube(260, 120, 0.014, 2.6, 2.2, pre_torsion=0.01), Tube(300, 120, 0.014, 2.0, 1.5, pre_torsion=0.01))
    robot, turned = Robot(tubes), np.array([0.2, 0, 0, 0, 0, 0])
    goal = np.array([0.0, 0.0, 110.0, 120.0, 0.0, 0.0])
    equilibria, jumps = Equilibria(robot.structure, robot.numbers), []
    state = equilibria.nearest(goal, KINEMATIC_MODELS["elastic"].rest(robot, goal))
    while not jumps and goal[0] < 12:
        goal = goal + turned
        state, jumps = equilibria.follow_to_goal(state, goal)
    assert len(jumps) == 1
    back = goal - np.array([2 * np.pi, 0, 0, 0, 0, 0])
    settled = KINEMATIC_MODELS["elastic"].rest(robot, back)
    np.testing.assert_allclose((state.x - settled)[:2], [2 * np.pi, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"curvature": (0.01, 0.02)}, "one curvature"),
        ({"curvature": 0.0}, "neither is 0"),
        ({"pre_torsion": 0.1}, r"must lie in \[-0.0182, 0.0182\] rad/mm"),
        ({"pre_torsion": float("nan")}, "pre_torsion"),
    ],
)
def test_helices_that_no_tube_is_are_refused(numbers, message):
    with pytest.raises(RobotError, match=message):
        dataclasses.replace(INNER, **numbers)


def test_a_robot_file_holds_the_torsion(tmp_path):
    (tmp_path / "robot.toml").write_text(PAIR.to_toml())
    assert Robot.from_toml(tmp_path / "robot.toml") == PAIR


def test_a_load_on_a_helix_is_refused():
    with pytest.raises(CtrError, match="helix"):
        Loaded(Load((0.1, 0, 0))).check(LONE)
