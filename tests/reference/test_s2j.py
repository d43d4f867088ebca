"""A network from shapes to joints: what it must keep whatever it has learned, and what it learns."""

import math
from dataclasses import replace

import numpy as np
import pytest
from common import named_problem
from hypothesis import given
from hypothesis import strategies as st
from learning.network_errors import evaluate_network
from methods.comparison import parse_variant
from reference import REFERENCE_METHODS, reference_frames
from reference.descent import clip_configuration
from reference.learned.network import (
    FORMAT,
    InverseKinematicsNetwork,
    load_trained_network,
    network_path,
    read_network,
    robot_identity,
)
from reference.learned.s2j import predict_configuration, target_tilt
from reference.learned.samples import NETWORK_INPUT_SIGMA, sample_stable_unknowns, shapes_of
from reference.learned.training import Training, train_network
from scipy.spatial.transform import Rotation
from strategies import configurations, robots
from truth import Shot

from ctr_nlp import Robot, Settings, summary, table_i_robot
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.paths.target import QUADRATURE, SIGMA_GRID
from ctr_nlp.planning.per_frame import march

pytestmark = pytest.mark.interpreted
ROBOT = table_i_robot()
TWO = Robot(ROBOT.tubes[1:])
QUICK = Training(shapes=4000, steps=600, batch=64, widths=(64, 64))
MODEL_NAMES = "dominant", "elastic"
seeds = st.integers(0, 2**32 - 1)


def untrained(robot=ROBOT, seed=0, model="dominant"):
    """A network whose weights are random, and so are its answers, some of them far beyond limits."""
    rng, inputs, widths = np.random.default_rng(seed), 3 * len(NETWORK_INPUT_SIGMA) + 1, (16, 3 * robot.d - 1)
    layers = tuple(
        (rng.normal(size=(n, m)), rng.normal(size=n)) for m, n in zip((inputs, 16), widths, strict=True)
    )
    told = {"format": FORMAT, "model": model, "robot": robot_identity(robot)}
    return InverseKinematicsNetwork(layers, rng.normal(size=inputs), np.eye(inputs), np.ones((1, 3)), told)


def targets(robot, model, x):
    return KINEMATIC_MODELS[model].points(robot, x, SIGMA_GRID)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A folder of networks of this test's own."""
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path))
    return tmp_path


@pytest.fixture(scope="module", params=MODEL_NAMES)
def learned(request):
    """A small network of two tubes on a model."""
    pytest.importorskip("torch", reason='training needs PyTorch: pip install -e ".[learning]"')
    return train_network(TWO, KINEMATIC_MODELS[request.param], QUICK)


@given(st.data())
def test_what_is_brought_within_limits_keeps_them_all_and_stays_there(data):
    robot = data.draw(robots())
    if data.draw(st.booleans()):
        apart = np.diff([tube.length for tube in robot.tubes]).min(initial=math.inf)
        robot = robot.with_limits(carriage_gap=min(float(apart), 5.0) / 2)
    q = np.random.default_rng(data.draw(seeds)).normal(size=(5, 2 * robot.d + 2))
    q[:, robot.d : -2] *= 100
    kept = clip_configuration(robot, q)
    for row in kept:
        robot.check(row)
    np.testing.assert_array_equal(clip_configuration(robot, kept), kept)


@given(st.data())
def test_what_keeps_limits_is_left_as_it_is(data):
    robot = data.draw(robots())
    q = data.draw(configurations(robot))
    np.testing.assert_array_equal(clip_configuration(robot, q), q)


@pytest.mark.parametrize("model", MODEL_NAMES)
@pytest.mark.parametrize("seed", range(5))
def test_answers_keep_limits_whatever_the_network_says(model, seed):
    robot = ROBOT.with_limits(alpha=(-1.0, 2.0), theta=(-0.1, 0.2))
    for target in targets(robot, model, sample_stable_unknowns(robot, KINEMATIC_MODELS[model], 4, seed)):
        found = predict_configuration(untrained(robot, seed), robot, KINEMATIC_MODELS[model], target, np.zeros(8))
        robot.check(found.q)
        np.testing.assert_allclose(
            KINEMATIC_MODELS[model].configuration(robot, found.x[None])[0], found.q, atol=1e-6
        )


def test_what_leaves_limits_is_not_solved_unless_it_is_projected(cache):
    untrained().save(network_path(ROBOT, "dominant"))
    plain, projected = (
        parse_variant(name).plan(named_problem("arc", 4), Settings(), (), None)
        for name in ("s2j", "s2j-projected")
    )
    assert not plain.success.all()
    assert "limits left by" in next(iter(plain.meta["failures"].values()))
    assert projected.success.all()
    np.testing.assert_array_equal(plain.q, projected.q)


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_a_turned_target_is_answered_by_the_same_robot_turned(model):
    """About the insertion direction by the tubes' angles, and about other axes by the tilt."""
    on, turn = KINEMATIC_MODELS[model], 0.7
    (target,) = targets(ROBOT, model, sample_stable_unknowns(ROBOT, on, 1, 3))
    first = predict_configuration(untrained(), ROBOT, on, target, np.zeros(8))
    c, s = np.cos(turn), np.sin(turn)
    about_z, about_y = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    for axes in (about_z, about_y):
        second = predict_configuration(untrained(), ROBOT, on, target @ axes.T, first.q)
        shapes = on.points(ROBOT, np.array([first.x, second.x]), SIGMA_GRID)
        np.testing.assert_allclose(shapes[1], shapes[0] @ axes.T, atol=1e-2)


@given(st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_the_tilt_is_that_of_a_robot_that_begins_in_the_target_s_direction(theta_x, theta_y):
    dominant = KINEMATIC_MODELS["dominant"]
    x = np.array([[0.3, 0.8, -1.0, 30.0, 60.0, 100.0, theta_x, theta_y]])
    again = np.concatenate([x[0, :6], target_tilt(targets(ROBOT, "dominant", x)[0])])
    first, second = (dominant.tangents(ROBOT, each, np.zeros(1))[0, 0] for each in (x, again[None]))
    np.testing.assert_allclose(second, first, atol=1e-3)


def test_a_problem_without_a_network_is_refused_and_told_how_to_have_one(cache):
    for name, model in (("s2j", "dominant"), ("s2j-elastic", "elastic"), ("s2j-horizon", "dominant")):
        with pytest.raises(
            OptionError,
            match=rf"no network .* on the {model} model; `python scripts/studies/learn.py --model {model}`",
        ):
            parse_variant(name).plan(named_problem("arc", 2), Settings(), (), None)


def test_a_network_of_other_tubes_another_number_of_them_or_another_model_does_not_serve(cache):
    untrained().save(network_path(ROBOT, "dominant"))
    assert (
        load_trained_network(ROBOT.with_limits(theta=(0, 0), alpha_speed=1.0), "dominant").metadata["model"]
        == "dominant"
    )
    longer = replace(ROBOT.tubes[2], curvature=0.013)
    for robot in (TWO, Robot((*ROBOT.tubes[:2], longer)), ROBOT.with_limits(beta=[(0, 40), (0, 107), (0, 150)])):
        with pytest.raises(OptionError, match="dominant model, but for 1 other robot; "):
            load_trained_network(robot, "dominant")
    with pytest.raises(OptionError, match="on the elastic model, but on dominant; "):
        load_trained_network(ROBOT, "elastic")


def test_a_file_gives_back_the_network_and_says_what_is_wrong_with_it(tmp_path):
    network, file = untrained(), tmp_path / "deep" / "network.npz"
    network.save(file)
    points = shapes_of(
        ROBOT, KINEMATIC_MODELS["dominant"], sample_stable_unknowns(ROBOT, KINEMATIC_MODELS["dominant"], 5, 0)
    )
    np.testing.assert_array_equal(read_network(file).tips(points), network.tips(points))
    assert read_network(file).metadata == network.metadata
    assert [path.name for path in file.parent.iterdir()] == ["network.npz"]
    replace(network, metadata=network.metadata | {"format": 0}).save(file)
    with pytest.raises(OptionError, match="has the format 0, not 1; train it anew"):
        read_network(file)
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(OptionError, match="cannot be read"):
        read_network(file)


@pytest.mark.parametrize(
    ("field", "value"), [("shapes", 1), ("steps", 0), ("batch", -3), ("seed", -1), ("steps", 1.5)]
)
def test_trainings_that_make_no_sense_are_refused(field, value):
    with pytest.raises(OptionError, match=f"{field} is {value}"):
        Training(**{field: value})


def test_equal_seeds_give_equal_networks_and_others_do_not():
    pytest.importorskip("torch", reason='training needs PyTorch: pip install -e ".[learning]"')
    short = replace(QUICK, shapes=200, steps=20)
    first, again, other = (
        train_network(TWO, KINEMATIC_MODELS["dominant"], replace(short, seed=seed)) for seed in (4, 4, 5)
    )
    for one, same, different in zip(first.layers, again.layers, other.layers, strict=True):
        for k in range(2):
            np.testing.assert_array_equal(one[k], same[k])
            assert not np.array_equal(one[k], different[k])


def test_a_training_that_is_interrupted_leaves_nothing():
    pytest.importorskip("torch", reason='training needs PyTorch: pip install -e ".[learning]"')
    with pytest.raises(KeyboardInterrupt):
        train_network(TWO, KINEMATIC_MODELS["dominant"], replace(QUICK, shapes=100), stop=lambda: True)


def arcs(robot, q, sigma):
    """Points of dominant arcs one after the other, from circles and rotations."""
    d, points = robot.d, []
    for s in sigma * q[2 * d - 1]:
        axes, point, begin = Rotation.from_euler("xy", q[2 * d :]), np.zeros(3), 0.0
        for tube, alpha, end in zip(robot.tubes, q, q[d:], strict=False):
            length, k = max(min(end, s) - begin, 0.0), tube.tip_curvature
            side = (1 - np.cos(k * length)) / k
            point = point + axes.apply([side * np.cos(alpha), side * np.sin(alpha), np.sin(k * length) / k])
            axes = axes * Rotation.from_rotvec(k * length * np.array([-np.sin(alpha), np.cos(alpha), 0]))
            begin = max(begin, end)
        points.append(point)
    return np.array(points)


TRUTHS = {"dominant": arcs, "elastic": lambda robot, q, sigma: Shot(robot, q).points(sigma)}


def errors(network, robot, count):
    """Parts of lengths, (count,), by which robots that stand at answers miss shapes, by other models than ours."""
    name = network.told["model"]
    model, truth, found = KINEMATIC_MODELS[name], TRUTHS[name], []
    x = sample_stable_unknowns(robot, model, count, 77)
    for q, target in zip(model.configuration(robot, x), targets(robot, name, x), strict=True):
        away = truth(robot, predict_configuration(network, robot, model, target, q).q, SIGMA_GRID) - truth(
            robot, q, SIGMA_GRID
        )
        found.append(np.sqrt(QUADRATURE @ (away**2).sum(axis=1)) / q[2 * robot.d - 1])
    return np.array(found)


def test_shapes_that_were_not_trained_on_come_back(learned):
    """Within 5 % of their lengths on average, after some seconds of training; the slow test asks for 1 %."""
    assert errors(learned, TWO, 10).mean() < 0.05
    first, last = learned.curve[[0, -1], 2]
    assert last < first / 2


def test_errors_that_are_told_are_those_of_the_robot_at_rest(learned):
    model = KINEMATIC_MODELS[learned.told["model"]]
    x = sample_stable_unknowns(TWO, model, 10, 77)
    told = evaluate_network(learned, TWO, model, x)
    assert told.rms / told.length == pytest.approx(errors(learned, TWO, 10), abs=1e-3)
    assert (told.tip > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", MODEL_NAMES)
def test_a_thousand_shapes_come_back_within_a_hundredth_of_their_length(name):
    """On average, of the paper's robot; of the first 50 by another model than ours."""
    pytest.importorskip("torch", reason='training needs PyTorch: pip install -e ".[learning]"')
    model = KINEMATIC_MODELS[name]
    network = train_network(ROBOT, model, Training())
    found = evaluate_network(network, ROBOT, model, sample_stable_unknowns(ROBOT, model, 1000, 77))
    assert (found.rms / found.length).mean() < 0.01
    assert errors(network, ROBOT, 50).mean() < 0.01


def test_a_horizon_starts_from_what_a_network_gives(cache):
    untrained().save(network_path(ROBOT, "dominant"))
    problem = named_problem("arc", 4)
    begun = march(problem, reference_frames(problem, "s2j-projected", Settings()), "forward")
    plan = parse_variant("s2j-horizon").plan(problem, Settings(), (), None)
    assert len(plan.meta["starts"]) == 1
    assert plan.success.all()
    assert summary(plan)["e3"] < summary(begun)["e3"]


def test_every_learned_method_knows_its_model():
    learned = [name for name in REFERENCE_METHODS if name.startswith("s2j")]
    assert len(learned) == 4
    for name in learned:
        assert parse_variant(name).model == ("elastic" if name.endswith("elastic") else "dominant")
