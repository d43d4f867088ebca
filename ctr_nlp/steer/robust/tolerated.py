"""Scenarios that stand for all the robots that tolerances allow."""

from __future__ import annotations

import math

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.shared.scenarios import check_shared
from ctr_nlp.loads import Load
from ctr_nlp.models import MODELS, Model, bearing, model_named
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.models.loaded.tips import tip_angles
from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import drawn_from
from ctr_nlp.robot.tolerances import NAMES
from ctr_nlp.support.values import instance
from ctr_nlp.typing import Array


def scenarios_of(robot: Robot, pushed: bool = False) -> Scenarios:
    """A robot, and robots that have the mean and the covariance of what it may be within its tolerances.

    Lags are left out. So is a force at the tip, unless these robots are pushed: then each but the first bears one
    as large as may be, and together these have the mean and the covariance of such forces from all sides. Raises
    OptionError where nothing may differ, and where tubes' curved parts may come to end in their transmissions,
    which is another structure.
    """
    force = robot.tolerances.tip_force
    root = robot.tolerances.root(robot.tubes)
    deviations = root[:, abs(root).max(axis=0) > 0]
    if not (deviations.size or force):
        raise OptionError("all tolerances of the robot are 0; give some, or plan without robustness")
    count, sides = deviations.shape[1], 3 * bool(pushed and force)
    signs = balanced(count + sides) if count + sides else np.zeros((0, 0))
    parts = np.vstack([np.zeros(len(root)), signs[:, :count] @ deviations.T]).reshape(-1, robot.d, len(NAMES))
    made = drawn_from(robot, parts, np.zeros(parts.shape[:2]))
    if made.structure != robot.structure:
        raise OptionError(
            "curved_length of tolerances lets a curved part end before the tube's largest extension; "
            "a robust plan needs limits of beta below the curved lengths"
        )
    weights = np.append(float(not len(signs)), np.ones(len(signs)))
    forces = np.vstack([np.zeros(3), force / math.sqrt(3) * signs[:, count:]]) if sides else np.zeros((0, 3))
    return Scenarios(made.numbers, made.offsets, weights, forces)


def with_forces(scenarios: Scenarios, size: float) -> Scenarios:
    """Scenarios, and the first of them with a force of a size, N, at its tip along each axis, either way.

    Their shape errors do not count. None are added where the size is 0.
    """
    forces = size * np.vstack([np.eye(3), -np.eye(3)])[: 6 * (size > 0)]
    numbers, offsets = (np.repeat(of[:1], len(forces), axis=0) for of in (scenarios.numbers, scenarios.offsets))
    return scenarios.joined(numbers, offsets, forces)


def described(robot: Robot, model: str | Model, scenarios: Scenarios | None) -> tuple[Model, Scenarios]:
    """The model and the scenarios asked for, which by default are those of tolerances; raises OptionError.

    Where forces may act, the model is one of loaded robots, which also raises LoadError where moduli are not told.
    """
    model = model_named(model, "model of scenarios")
    if scenarios is None:
        scenarios = with_forces(scenarios_of(robot), robot.tolerances.tip_force)
    instance(OptionError, "scenarios", scenarios, Scenarios)
    model = bearing(model, scenarios.pushed or robot.tolerances.tip_force > 0)
    model.check(robot)
    check_shared(robot, model, scenarios)
    return model, scenarios


def told_on(model: Model) -> Model:
    """The model that a plan made on one tells of: that without a load, where robots bear only what may come."""
    return MODELS[model.name] if model.bears == Load() else model


def told_unknowns(robot: Robot, model: Model, q: Array, x: Array) -> Array:
    """The unknowns (T, 2d + 2) of that model, of a robot at q (T, 2d + 2) with the unknowns x of the other one.

    Tips are turned alike against each other; by how much they are turned together is what alpha tells of them.
    """
    told, last = told_on(model), robot.d - 1
    if told == model:
        return x
    found = q.copy()
    found[:, :last], found[:, last] = x[:, :last], 0.0
    found[:, last] = q[:, last] - told.configuration(robot, found)[:, last]
    return found


def bearing_unknowns(robot: Robot, model: Model, q: Array, x: Array) -> Array:
    """The unknowns (T, 2d + 2) of a model, of a robot that moves through q (T, 2d + 2) with the unknowns x of
    told_on(model). The turn of its tip is continuous over the frames, where alpha tells of it up to whole turns.
    """
    if told_on(model) == model:
        return x
    assert isinstance(model, Loaded)
    found, last = model.unloaded(robot, q, tip_angles(x, robot.d)), robot.d - 1
    found[:, last] = np.unwrap(found[:, last])
    return found


def tips_of(model: Model, robot: Robot, x: Array) -> Array:
    """What of a robot's unknowns x (T, n_x) its q does not say: tips (T, d), under a load (T, d + 2)."""
    angles, turns = x[:, : robot.d], x[:, 2 * robot.d :]
    return angles if model.bears is None else np.hstack([angles, turns])


def unknowns_of(model: Model, robot: Robot, tips: Array, q: Array) -> Array:
    """The unknowns (T, n_x) of a robot at q (T, 2d + 2) with tips as of tips_of."""
    d = robot.d
    if model.bears is None:
        return np.hstack([tips, q[:, d:]])
    return np.hstack([tips[:, :d], q[:, d : 2 * d], tips[:, d:]])


def balanced(count: int) -> Array:
    """Deviations (N, count) of so many independent quantities, each of mean 0 and variance 1; N is the next
    prime's successor.

    Over them, the mean of a function up to its second order is that over all values of the quantities: columns are
    orthogonal (Plackett and Burman, The design of optimum multifactorial experiments, Biometrika 33, 1946).
    """
    size = count
    while size % 4 != 3 or any(size % k == 0 for k in range(2, size)):
        size += 1
    squares = {k * k % size for k in range(1, size)}
    row = np.array([1.0 if k in squares or k == 0 else -1.0 for k in range(size)])
    signs = np.vstack([*(np.roll(row, -k) for k in range(size)), -np.ones(size)])
    return signs[:, :count]
