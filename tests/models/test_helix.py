"""Tubes whose pre-curvature turns along them: helices, alone and twisting each other."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from truth import Shot

from ctr_nlp import Limits, Load, Loaded, Robot, Tube
from ctr_nlp.exceptions import CtrError, RobotError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.dominant.shape import columns_of
from ctr_nlp.models.elastic.equilibria import Equilibria
from ctr_nlp.models.elastic.shape import backbone
from ctr_nlp.models.elastic.torsion import motors, sections, twist

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
        ({"pre_torsion": 0.4}, r"must lie in \[-0.364, 0.364\] rad/mm, .* turns by 40 rad"),
        ({"pre_torsion": 3.0}, r"did you mean 0.0524 rad/mm \(3 degrees\)"),
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


def helix(turn, curvature, length, curved, outer, inner):
    return Tube(length, curved, curvature, outer, inner, pre_torsion=turn / curved)


@pytest.mark.parametrize("seed", range(6))
def test_helices_of_many_turns_are_integrated_finely(seed):
    """Elastic shapes, and angles of motors, are those of eight times as many pieces."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(2, 20, 2) * rng.choice([-1, 1], 2)
    robot = Robot((helix(turns[0], 0.02, 200, 120, 2.0, 1.6), helix(turns[1], 0.015, 400, 150, 1.4, 1.0)))
    assert max(robot.structure.pieces) == np.ceil(abs(turns).max() / 2)
    x = np.array([*rng.uniform(-3, 3, 2), *np.sort(rng.uniform(20, 120, 2)), 0.1, -0.2])
    finer = [tube._replace(pieces=8 * tube.pieces) for tube in robot.tube_numbers]
    curve = backbone(finer, columns_of(x[None]), SIGMA, np)
    expected = np.stack([np.broadcast_to(each, (1, len(SIGMA)))[0] for each in curve.points], axis=-1)
    elastic = KINEMATIC_MODELS["elastic"]
    np.testing.assert_allclose(elastic.points(robot, x[None], SIGMA)[0], expected, atol=1e-3)
    found, fine = (
        motors(tubes, x, twist(tubes, x, sections(tubes, x[2:4], np), np)) for tubes in (robot.tube_numbers, finer)
    )
    np.testing.assert_allclose(found, fine, atol=1e-5)


def integrated(robot, q):
    """The shape (n, 3) on the dominant model, by a general integrator of its curvature vector."""
    (first, second), beta = robot.tubes, q[2:4]

    def rates(s, state):
        i, tube = (0, first) if s < beta[0] else (1, second)
        # The direction of the curvature at s, of a tube that is untwisted, from where its curved part begins.
        angle = q[i] + tube.pre_torsion * (tube.curved_length - beta[i] + s)
        d1, d2, t = state[3:].reshape(3, 3)
        u = tube.tip_curvature * np.array([np.cos(angle), np.sin(angle)])
        return np.concatenate([t, -u[0] * t, -u[1] * t, u[0] * d1 + u[1] * d2])

    state, found = np.concatenate([np.zeros(3), np.eye(3).ravel()]), []
    for low, high in ((0.0, beta[0]), (beta[0], beta[1])):
        s = np.unique(np.append(SIGMA * beta[1], (low, high)))
        s = s[(s >= low) & (s <= high)]
        # Just within the piece, since the curvature jumps at its ends.
        part = solve_ivp(
            lambda s, y, a=low, b=high: rates(min(max(s, a), b - 1e-9), y),
            (low, high),
            state,
            t_eval=s,
            rtol=1e-10,
            atol=1e-10,
        )
        state, found = part.y[:, -1], found + [(a, *p) for a, p in zip(part.t, part.y[:3].T, strict=True)]
    table = np.array(found)
    rows = [np.abs(table[:, 0] - s).argmin() for s in SIGMA * beta[1]]
    return table[rows, 1:]


@pytest.mark.parametrize("seed", range(4))
def test_helices_of_many_turns_on_the_dominant_model_are_those_integrated(seed):
    rng = np.random.default_rng(seed)
    turns = rng.uniform(3, 20, 2) * rng.choice([-1, 1], 2)
    robot = Robot((helix(turns[0], 0.02, 200, 120, 2.6, 2.0), helix(turns[1], 0.015, 400, 150, 1.4, 1.0)))
    q = np.array([*rng.uniform(-3, 3, 2), *np.sort(rng.uniform(20, 120, 2)), 0.0, 0.0])
    expected = integrated(robot, q)
    np.testing.assert_allclose(KINEMATIC_MODELS["dominant"].points(robot, q[None], SIGMA)[0], expected, atol=1e-3)


def test_a_helix_of_several_turns_from_a_file_is_planned_on(shared_data):
    robot = Robot.from_toml(shared_data / "cases/robots/helix.toml")
    assert robot.structure.pieces == (3, 4)
    q = np.array([0.3, 0.0, 100.0, 140.0, 0.0, 0.0])
    elastic = KINEMATIC_MODELS["elastic"]
    x = elastic.rest(robot, q)
    # Several equilibria belong to q. Shot from the rates of this one, which it counts without the helices' own.
    rates = twist(robot.tube_numbers, x, sections(robot.tube_numbers, x[2:4], np), np).rates
    shot = Shot(robot, q, tuple(rate - tube.pre_torsion for rate, tube in zip(rates, robot.tubes, strict=True)))
    np.testing.assert_allclose(x, shot.x, atol=1e-4)
    np.testing.assert_allclose(elastic.points(robot, x[None], SIGMA)[0], shot.points(SIGMA), atol=1e-3)


def test_helices_of_two_rad_keep_their_programs():
    assert PAIR.structure.pieces == ()
    assert Robot((helix(2.0, 0.01, 200, 110, 2.0, 1.5),)).structure.pieces == ()
