"""What is described or computed once cannot be changed behind anybody's back."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest
from malformed import helix, plan

from ctr_nlp import Limits, Problem, Robot, Settings, curve_from_points, growing, shape_curve, table_i_robot
from ctr_nlp.paths.lumen import Lumen

ARRAYS = [f.name for f in fields(plan()) if isinstance(getattr(plan(), f.name), np.ndarray)]


@pytest.mark.parametrize("name", [*ARRAYS, "q", "reached_frames"])
def test_no_array_of_a_plan_can_be_written(name):
    array = getattr(plan(), name)
    for view in (array, array[..., :1], array.reshape(-1), array.T):
        with pytest.raises(ValueError, match="read-only"):
            view.flat[0] = 0
        with pytest.raises(ValueError, match="read-only"):
            view[...] = 0


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_that_a_plan_was_made_of_is_not_the_plans(name):
    given = getattr(plan(), name).copy()
    made = replace(plan(), **{name: given})
    given[...] = 1 - given
    np.testing.assert_array_equal(getattr(made, name), getattr(plan(), name))
    assert given.flags.writeable


@pytest.mark.parametrize(
    "change",
    [
        lambda meta: meta.__setitem__("model", "elastic"),
        lambda meta: meta.update(model="elastic"),
        lambda meta: meta.pop("model"),
        lambda meta: meta.__delitem__("model"),
        lambda meta: meta.clear(),
        lambda meta: meta.popitem(),
        lambda meta: meta.setdefault("x", 1),
        lambda meta: meta.__ior__({"x": 1}),
        lambda meta: meta["robot"]["limits"].update(carriage_gap=3),
        lambda meta: meta["robot"]["tubes"].append({}),
        lambda meta: meta["robot"]["tubes"].clear(),
        lambda meta: meta["robot"]["tubes"].sort(),
        lambda meta: meta["robot"]["tubes"].__setitem__(0, {}),
        lambda meta: meta["robot"]["tubes"].__iadd__([{}]),
        lambda meta: meta["robot"]["tubes"][0].update(curvature=1),
    ],
)
def test_meta_of_a_plan_cannot_be_changed_at_any_depth(change):
    before = json.dumps(plan().meta)
    with pytest.raises(TypeError, match="read-only"):
        change(plan().meta)
    assert json.dumps(plan().meta) == before


def test_meta_is_a_copy_that_json_pickle_and_copies_can_hold():
    given = {**plan().meta, "options": {"tried": [1, 2]}}
    made = replace(plan(), meta=given)
    given["options"]["tried"].append(3)
    assert made.meta["options"]["tried"] == [1, 2]
    for again in (
        json.loads(json.dumps(made.meta)),
        pickle.loads(pickle.dumps(made.meta)),
        copy.deepcopy(made.meta),
    ):
        assert again == made.meta
    changed = made.meta | {"model": "elastic"}
    changed["solver"] = "sqp"
    assert made.meta["solver"] == "ipopt"


def test_a_plan_can_be_sent_to_another_process():
    """Arrays come out of pickle writeable, and cached ones with them."""
    assert plan().robot.lower.shape == plan().q[0].shape
    again = pickle.loads(pickle.dumps(plan()))
    robot = pickle.loads(pickle.dumps(plan().robot))
    assert again.meta == plan().meta
    assert robot == plan().robot
    np.testing.assert_array_equal(again.q, plan().q)
    for array in (again.alpha, again.q, again.shape, again.robot.lower, robot.lower):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


@pytest.mark.parametrize(
    ("thing", "name"),
    [
        (plan(), "alpha"),
        (table_i_robot(), "tubes"),
        (table_i_robot().tubes[0], "curvature"),
        (Limits(), "beta"),
        (Settings(), "seed"),
        (growing(curve_from_points(helix()), 2), "lengths"),
        (curve_from_points(helix()), "length"),
        (Problem("p", table_i_robot(), growing(curve_from_points(helix()), 2)), "duration"),
    ],
    ids=lambda thing: type(thing).__name__,
)
def test_no_field_can_be_set(thing, name):
    with pytest.raises(FrozenInstanceError):
        setattr(thing, name, None)


def test_what_a_robot_was_described_with_is_not_the_robots():
    beta, tubes = np.array([[0.0, 50], [0, 107], [0, 150]]), list(table_i_robot().tubes)
    speed = [1.0, 2.0, 3.0]
    robot = Robot(tubes, Limits(beta=beta, alpha_speed=speed))
    beta[:], speed[0] = 1e3, -1
    tubes.clear()
    assert robot.d == 3
    assert robot.upper[3:6].tolist() == [50, 107, 150]
    assert robot.to_dict()["limits"]["beta"] == [[0, 50], [0, 107], [0, 150]]
    assert robot.speed[0] == 1
    for array in (robot.lower, robot.upper, robot.speed, robot.max_extensions, *robot.split(robot.upper)):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_points_that_a_curve_was_made_of_are_not_the_curves():
    points, radius, transform = helix(), np.full(61, 6.0), np.eye(4)
    curve = curve_from_points(points, radius).apply_transform(transform)
    s = np.linspace(0, curve.length, 50)
    before = curve_from_points(helix(), np.full(61, 6.0))
    points *= 2
    radius *= 3
    transform *= 4
    for name in ("point", "tangent", "curvature", "radius"):
        np.testing.assert_allclose(getattr(curve, name)(s), getattr(before, name)(s))


def test_the_configuration_that_a_shape_was_made_of_is_not_the_shapes(robot):
    q = np.array([0, 0, 0, 10, 20, 30, 0, 0.0])
    curve = shape_curve(robot, q)
    before = curve.point(np.array([30.0]))
    q[:] = 1
    np.testing.assert_array_equal(curve.point(np.array([30.0])), before)


def test_arrays_of_a_problem_and_its_samples_are_read_only_copies():
    to_robot, truth = np.eye(4), np.zeros((2, 8))
    problem = Problem(
        "p",
        table_i_robot(),
        growing(curve_from_points(helix(), np.full(61, 6.0)), 2),
        to_robot=to_robot,
        truth=truth,
    )
    to_robot[:], truth[:] = 7, 7
    assert problem.to_robot.tolist() == np.eye(4).tolist()
    assert not problem.truth.any()
    sample = problem.target_frames[0]
    for array in (
        problem.to_robot,
        problem.truth,
        sample.points,
        sample.tangents,
        sample.curvature,
        sample.turning,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(ValueError, match="read-only"):
        sample.radius[0] = 0


def test_the_table_of_a_lumen_is_a_read_only_copy():
    table = np.column_stack([helix(), np.full(61, 6.0)])
    lumen = Lumen(table)
    table[:] = 0
    assert lumen.table[0, 3] == 6
    with pytest.raises(ValueError, match="read-only"):
        lumen.table[0] = 0
    with pytest.raises(AttributeError):
        lumen.table = table
