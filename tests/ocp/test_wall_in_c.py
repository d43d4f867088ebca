"""The wall in C: what it says is what wall.py says, and frames in one call are those of steps."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from lumens import bent, straight, wandering

from ctr_nlp import Load, Loaded, LoadOverTime, Problem, Robot, Settings, growing, table_i_robot
from ctr_nlp.codegen import cache
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.ocp.compiled_wall import WallDistance
from ctr_nlp.ocp.wall import Wall, make_wall
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.planning.nlp_frames import NlpFrames

ROBOT = table_i_robot()
TWO = Robot(ROBOT.tubes[1:])
ACROSS = Load(force=(0.0, 0.2, 0.0))
WITHIN = {"dominant": 1e-6, "elastic": 2e-2}
"""mm; a program's elastic shapes are integrated in fewer steps than others."""


def drawn(seed, count=5):
    """Unknowns of any model (count, 8), some with tubes that end together."""
    rng = np.random.default_rng(seed)
    beta = np.sort(rng.uniform(0, [50, 100, 150], (count, 3)))
    beta[0] = 40.0
    return np.hstack([rng.uniform(-3, 3, (count, 3)), beta, rng.uniform(-0.2, 0.2, (count, 2))])


def coiled():
    """A lumen of three turns of 15 mm, 8 mm apart: between two of them, either may be the nearest."""
    u = np.linspace(0, 6 * np.pi, 900)
    table = np.column_stack([15 * np.cos(u) - 15, 15 * np.sin(u), 8 * u / (2 * np.pi), 3 + np.cos(u)])
    return Lumen(table)


def assert_same(wall, x):
    assert wall.compiled_wall.ready(wait=True)
    (found, slack), (expected, needed) = wall.compiled_wall(x), wall.compute_local_wall(x)
    within = WITHIN[wall.model.name]
    np.testing.assert_allclose(slack, needed, atol=within)
    rooms = found[..., 9] - expected[..., 9]
    np.testing.assert_allclose(rooms, 0, atol=within)
    np.testing.assert_allclose(found, expected, atol=5 * within)


@pytest.mark.parametrize("model", ["dominant", "elastic"])
@pytest.mark.parametrize("seed", range(6))
def test_c_describes_the_wall_as_numpy_does(model, seed):
    """Bends up to the lumen's own radius; some robots are longer than the lumen."""
    curve = wandering(seed, bend=1 / (20 + 10 * seed), length=60.0)
    assert_same(Wall(ROBOT, Lumen.from_curve(curve), KINEMATIC_MODELS[model], 30.0, 0.1 * seed), drawn(seed))


@pytest.mark.parametrize("seed", range(4))
def test_the_nearest_place_is_that_of_the_whole_path_and_not_of_the_turn_before(seed):
    assert_same(Wall(ROBOT, coiled(), KINEMATIC_MODELS["dominant"], 30.0, 0.0), drawn(seed, 20))


def test_one_frame_after_another_is_described_for_itself():
    wall = make_wall(ROBOT, Lumen.from_curve(wandering(1)), KINEMATIC_MODELS["dominant"], Settings())
    assert wall.compiled_wall.ready(wait=True)
    x = drawn(3)
    whole = wall.compiled_wall(x)
    for j in (2, 0, 0, 4):
        for one, all_of_them in zip(wall.compiled_wall(x[j : j + 1]), whole, strict=True):
            np.testing.assert_array_equal(one[0], all_of_them[j])


def test_robots_of_other_tubes_are_described_with_their_own_shapes():
    wall = make_wall(ROBOT, Lumen.from_curve(wandering(2)), KINEMATIC_MODELS["elastic"], Settings())
    assert wall.compiled_wall.ready(wait=True)
    other, x = (
        replace(ROBOT, tubes=[replace(tube, curvature=1.3 * tube.curvature) for tube in ROBOT.tubes]),
        drawn(4),
    )
    before, _ = wall.compiled_wall(x)
    found, slack = wall.compiled_wall(x, other.numbers)
    expected, needed = wall.compute_local_wall(x, other.numbers)
    np.testing.assert_allclose(slack, needed, atol=WITHIN["elastic"])
    np.testing.assert_allclose(found, expected, atol=5 * WITHIN["elastic"])
    own, _ = make_wall(
        other, Lumen.from_curve(wandering(2)), KINEMATIC_MODELS["elastic"], Settings()
    ).compute_local_wall(x)
    np.testing.assert_allclose(expected, own, atol=1e-9)
    assert abs(found - before).max() > 1.0
    np.testing.assert_array_equal(wall.compiled_wall(x)[0], before)


@pytest.mark.parametrize(
    "load", [ACROSS, replace(ACROSS, densities=6.45, down=(0, 0, 1))], ids=["force", "weight"]
)
def test_a_loaded_robot_is_described_where_its_load_has_brought_it(load):
    """In every frame the load of its time, and the same unknowns anew under another load."""
    robot, curve = with_modulus(ROBOT, 60_000), wandering(2)
    coming = Loaded(LoadOverTime([Load(), load], [0.0, 1.0]))
    wall, x = Wall(robot, Lumen.from_curve(curve), coming, 30.0, 0.1), drawn(4)
    assert wall.compiled_wall.ready(wait=True)
    loads = coming.load.numbers_at(3, np.linspace(0, 1, len(x)))
    found, slack = wall.compiled_wall(x, None, loads)
    expected, needed = wall.compute_local_wall(x, None, loads)
    np.testing.assert_allclose(slack, needed, atol=WITHIN["elastic"])
    np.testing.assert_allclose(found, expected, atol=5 * WITHIN["elastic"])
    for k, frame in enumerate(growing(curve, len(x)).sample()):
        values, _ = wall.local_parameters_during([replace(frame, motion_fraction=k / (len(x) - 1))])(x[k : k + 1])
        np.testing.assert_array_equal(values["wall"][0], found[k])
    both, _ = wall.compiled_wall(x[[1, 1]], None, loads[[0, -1]])
    assert abs(both[1] - both[0]).max() > 0.1
    with pytest.raises(ValueError, match="loads have shape"):
        wall.compiled_wall(x)


@pytest.mark.parametrize("lumen", [coiled(), Lumen.from_curve(wandering(3))])
def test_what_is_left_beside_points_is_the_same_in_c(lumen, monkeypatch):
    """Near the path, far from it, beyond its ends, and at points that are not known."""
    rng = np.random.default_rng(0)
    points = lumen.table[rng.integers(len(lumen.table), size=(40, 25)), :3] + rng.normal(size=(40, 25, 3)) * 3
    points[0] += 200.0
    points[1, ::2, 1] = np.nan
    near = lumen.project(points)
    found = WallDistance(lumen)(points)
    assert np.isfinite(found).sum() == found.size - 13
    np.testing.assert_allclose(found, near.radius - near.distance, atol=1e-6)
    for name, each, expected in zip(near._fields, WallDistance(lumen).project(points), near, strict=True):
        np.testing.assert_allclose(each, expected, atol=1e-5, err_msg=name)
    monkeypatch.setattr(cache, "unavailable_reason", lambda: "no compiler")
    np.testing.assert_array_equal(WallDistance(lumen)(points), near.radius - near.distance)


def test_what_is_not_known_is_not_described():
    wall = make_wall(ROBOT, Lumen.from_curve(wandering(1)), KINEMATIC_MODELS["dominant"], Settings())
    assert wall.compiled_wall.ready(wait=True)
    x = drawn(3)
    x[1] = np.nan
    found, slack = wall.compiled_wall(x)
    assert np.isnan(slack[1])
    assert np.isnan(found[1]).any(axis=1).all()
    assert np.isfinite(np.delete(slack, 1)).all()
    assert np.isfinite(np.delete(found, 1, axis=0)).all()


def test_unknowns_of_another_model_are_refused():
    wall = make_wall(ROBOT, Lumen.from_curve(straight(4.0)), KINEMATIC_MODELS["dominant"], Settings())
    with pytest.raises(ValueError, match="the model has 8 unknowns"):
        wall.compiled_wall(drawn(2)[:, :6])


def test_a_wall_that_has_been_used_can_be_sent_to_another_process():
    wall = make_wall(ROBOT, Lumen.from_curve(straight(4.0)), KINEMATIC_MODELS["dominant"], Settings())
    x = drawn(5)
    before = wall.local_parameters(x)
    after = pickle.loads(pickle.dumps(wall)).local_parameters(x)
    np.testing.assert_allclose(after[0]["wall"], before[0]["wall"], atol=1e-9)
    np.testing.assert_allclose(after[1], before[1], atol=1e-9)


@pytest.mark.parametrize(("model", "robot"), [("dominant", ROBOT), ("elastic", TWO)])
def test_frames_within_a_lumen_in_one_call_are_those_of_steps(model, robot):
    lumen = bent(4.0)
    problem = Problem("bent", robot, growing(lumen.part(0, 100.0), 8), lumen=lumen)
    frames = NlpFrames.of(problem, model=model)
    assert frames.wall.compiled_wall.ready(wait=True)
    once, steps = (replace(frames, active_wall=frames.wall) for _ in range(2))
    steps.__dict__["_compiled_frames"] = None
    first = once.search_near(0, frames.search(0)[0])
    found = [[result for result, _ in each.run(range(1, 8), first)] for each in (once, steps)]
    assert once._compiled_frames is not None
    assert all(result.success for each in found for result in each)
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one.q, other.q, atol=1e-6)
        assert one.objective == pytest.approx(other.objective, rel=1e-6)
