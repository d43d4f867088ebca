"""What holds for every model of the package, whatever it computes: it is run on each that the registry has."""

from __future__ import annotations

import numpy as np
import pytest

from ctr_nlp import Limits, Robot, Tube, table_i_robot
from ctr_nlp.models import KINEMATIC_MODELS, Model, suits
from ctr_nlp.models.protocol import build_sample_function
from ctr_nlp.typing import Array

OWN = {name: each for name, each in KINEMATIC_MODELS.items() if type(each).__module__.startswith("ctr_nlp.")}
EVERY_MODEL = pytest.mark.parametrize("model", OWN.values(), ids=OWN.keys())
ROBOTS = (
    table_i_robot(),
    Robot((Tube(200, 150, 0.008, 2, 1),), Limits()),
    Robot((Tube(100, 50, 0.0, 3, 2.5), Tube(200, 150, 0.0, 2, 1)), Limits()),
)
"""Curved tubes, one curved tube, and straight ones: a model is tried on the first that it describes."""
SIGMA = np.linspace(0.0, 1.0, 401)


def robot_for(model: Model) -> Robot:
    found = [robot for robot in ROBOTS if suits(robot, model)]
    assert found, f"no robot of ROBOTS goes with the {model.name} model; add one that does"
    return found[0]


def configuration(robot: Robot, theta: tuple[float, float] = (0.1, -0.2)) -> Array:
    """A configuration (2d + 2,) with every tube three quarters out."""
    alpha = 0.4 * np.arange(1, robot.d + 1)
    return np.concatenate([alpha, 0.75 * robot.max_extensions, theta])


def shape(model: Model, q: Array, robot: Robot) -> Array:
    """Points (401, 3), mm, of a robot at rest at q."""
    return model.points(robot, model.rest(robot, q)[None], SIGMA)[0]


@EVERY_MODEL
def test_a_shape_begins_at_the_insertion_point_and_is_as_long_as_the_robot(model):
    robot = robot_for(model)
    q = configuration(robot)
    points = shape(model, q, robot)
    np.testing.assert_allclose(points[0], 0.0, atol=1e-6)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert length == pytest.approx(q[2 * robot.d - 1], rel=1e-4)


@EVERY_MODEL
def test_tangents_are_slopes_of_the_points(model):
    robot = robot_for(model)
    x = model.rest(robot, configuration(robot))[None]
    tangents = model.tangents(robot, x, SIGMA)[0]
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1.0, atol=1e-6)
    chords = np.diff(model.points(robot, x, SIGMA)[0], axis=0)
    chords /= np.linalg.norm(chords, axis=1)[:, None]
    np.testing.assert_allclose((tangents[1:] + tangents[:-1]) / 2, chords, atol=0.01)


@EVERY_MODEL
def test_the_tilt_turns_the_whole_shape(model):
    robot = robot_for(model)
    x, y = 0.1, -0.2
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    upright = shape(model, configuration(robot, (0.0, 0.0)), robot)
    tilted = shape(model, configuration(robot, (x, y)), robot)
    np.testing.assert_allclose(tilted, upright @ (about_y @ about_x).T, atol=1e-4)


@EVERY_MODEL
def test_unknowns_hold_the_configuration(model):
    robot = robot_for(model)
    q = configuration(robot)
    np.testing.assert_allclose(model.configuration(robot, model.rest(robot, q)[None])[0], q, atol=1e-6)


@EVERY_MODEL
def test_numbers_batches_and_symbols_agree(model):
    robot = robot_for(model)
    sigma = np.array([0.1, 0.5, 1.0])
    x = model.rest(robot, configuration(robot))[None]
    points = model.points(robot, x, sigma)
    tangents = model.tangents(robot, x, sigma)
    batch = model.points_batch(robot.structure, robot.numbers[None], x[None], sigma)
    np.testing.assert_allclose(batch[0], points, atol=1e-6)
    written = build_sample_function(model, robot.structure, len(sigma))(x[0], sigma, robot.numbers, [])
    np.testing.assert_allclose(written[0].full(), points[0], atol=1e-3)
    np.testing.assert_allclose(written[1].full(), tangents[0], atol=1e-4)
