"""Scenarios that represent all robots within the tolerances, and the models on which they are planned.

The uncertain parameters z of a robot have mean 0 and covariance R R^T. N robots z = R d with the rows d of a
two-level orthogonal array have the same mean and covariance, so that the mean over them of errors that are
quadratic in z is the mean over all robots (Plackett and Burman, The design of optimum multifactorial experiments,
Biometrika 33, 1946).
"""

from __future__ import annotations

import math

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS, Model, model_for_tip_forces, model_named
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.models.loaded.tips import tip_angles
from ctr_nlp.models.loads import Load
from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.ocp.shared.scenarios import check_scenarios
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import perturb_robot
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.support.value_checks import check_instance
from ctr_nlp.typing import Array


def scenarios_from_tolerances(robot: Robot, with_tip_force: bool = False) -> Scenarios:
    """Return the nominal robot and robots that have the mean and the covariance of the tolerances.

    robot: with its tolerances. with_tip_force: whether the largest tip force of the tolerances acts on each robot
    but the first, in directions whose mean is 0; otherwise forces are left out. Lags are left out. Raises
    OptionError where all tolerances are 0, and where a tube's curved part may end within its range of extensions,
    which would change the structure of the program.
    """
    force = robot.tolerances.tip_force
    root = robot.tolerances.covariance_root(robot.tubes)
    # Parameters without uncertainty would only make the design larger.
    deviations = root[:, abs(root).max(axis=0) > 0]
    if not (deviations.size or force):
        raise OptionError("all tolerances of the robot are 0; give some, or plan without robustness")
    count = deviations.shape[1]
    sides = 3 * bool(with_tip_force and force)
    signs = two_level_orthogonal_array(count + sides) if count + sides else np.zeros((0, 0))
    # The first row is the nominal robot.
    parts = np.vstack([np.zeros(len(root)), signs[:, :count] @ deviations.T]).reshape(
        -1, robot.d, len(DEVIATION_NAMES)
    )
    made = perturb_robot(robot, parts, np.zeros(parts.shape[:2]))
    if made.structure != robot.structure:
        raise OptionError(
            "curved_length of tolerances lets a curved part end before the tube's largest extension; "
            "a robust plan needs limits of beta below the curved lengths"
        )
    # The nominal robot has no weight in the mean over robots, unless it is the only one.
    weights = np.append(float(not len(signs)), np.ones(len(signs)))
    # Entries +-F / sqrt(3) have size F and covariance F^2 / 3 I, that of forces of size F from all sides.
    forces = np.vstack([np.zeros(3), force / math.sqrt(3) * signs[:, count:]]) if sides else np.zeros((0, 3))
    return Scenarios(made.numbers, made.offsets, weights, forces)


def with_forces(scenarios: Scenarios, size: float) -> Scenarios:
    """Return scenarios with six more: the first robot with a tip force of `size`, N, along +-x, +-y and +-z.

    Their shape errors do not count. None are added where the size is 0.
    """
    forces = size * np.vstack([np.eye(3), -np.eye(3)])[: 6 * (size > 0)]
    numbers, offsets = (np.repeat(of[:1], len(forces), axis=0) for of in (scenarios.numbers, scenarios.offsets))
    return scenarios.append_robots(numbers, offsets, forces)


def resolve_scenarios(robot: Robot, model: str | Model, scenarios: Scenarios | None) -> tuple[Model, Scenarios]:
    """Return the model and the scenarios of a robust plan.

    robot: with its tolerances. model: name or model asked for; where tip forces may act, the loaded one is
    returned. scenarios: None for those of the robot's tolerances. Raises OptionError, and LoadError where forces
    act on a robot whose elastic moduli are not known.
    """
    model = model_named(model, "model of scenarios")
    if scenarios is None:
        scenarios = with_forces(scenarios_from_tolerances(robot), robot.tolerances.tip_force)
    check_instance(OptionError, "scenarios", scenarios, Scenarios)
    # Samples with tip forces join the scenarios in later rounds, even if none of the first ones has any.
    model = model_for_tip_forces(model, scenarios.has_tip_forces or robot.tolerances.tip_force > 0)
    model.check_planning(robot)
    check_scenarios(robot, model, scenarios)
    return model, scenarios


def reported_model(model: Model) -> Model:
    """Return the model on which a plan is reported: without a load where the nominal robot has none.

    model: on which scenarios are planned.
    """
    return KINEMATIC_MODELS[model.name] if model.applied_load == Load() else model


def reported_unknowns(robot: Robot, model: Model, q: Array, x: Array) -> Array:
    """Return the unknowns (T, 2d + 2) of the nominal robot on the model on which plans are reported.

    model: on which scenarios are planned. q: (T, 2d + 2), configurations. x: (T, n_x), unknowns on `model`.
    """
    told = reported_model(model)
    last = robot.d - 1
    if told == model:
        return x
    found = q.copy()
    # Tips relative to each other are the same on both models. The innermost tip's own angle adds to every alpha
    # alike: with 0 for it, what alpha_d misses is that angle.
    found[:, :last], found[:, last] = x[:, :last], 0.0
    found[:, last] = q[:, last] - told.configuration(robot, found)[:, last]
    return found


def loaded_unknowns(robot: Robot, model: Model, q: Array, x: Array) -> Array:
    """Return the unknowns (T, n_x) of the unloaded nominal robot on the scenarios' model.

    model: on which scenarios are planned. q: (T, 2d + 2), configurations. x: (T, 2d + 2), unknowns on
    reported_model(model). The innermost tip's angle, which alpha determines up to whole turns, is continuous over
    the frames.
    """
    if reported_model(model) == model:
        return x
    assert isinstance(model, Loaded)
    found = model.unloaded_unknowns(robot, q, tip_angles(x, robot.d))
    last = robot.d - 1
    found[:, last] = np.unwrap(found[:, last])
    return found


def tips_of(model: Model, robot: Robot, x: Array) -> Array:
    """Return the unknowns that q does not determine: tips (T, d) in rad, under a load (T, d + 2).

    model, robot: that x is of. x: (T, n_x), all unknowns.
    """
    angles = x[:, : robot.d]
    turns = x[:, 2 * robot.d :]
    return angles if model.applied_load is None else np.hstack([angles, turns])


def unknowns_of(model: Model, robot: Robot, tips: Array, q: Array) -> Array:
    """Return the unknowns (T, n_x) of a robot on a model from its tips and configurations; inverse of tips_of.

    tips: (T, d) in rad, under a load (T, d + 2). q: (T, 2d + 2), rad and mm.
    """
    d = robot.d
    if model.applied_load is None:
        return np.hstack([tips, q[:, d:]])
    return np.hstack([tips[:, :d], q[:, d : 2 * d], tips[:, d:]])


def two_level_orthogonal_array(count: int) -> Array:
    """Return a two-level orthogonal array (N, count) of +-1: rows are robots, columns are parameters.

    Columns have mean 0, variance 1, and are uncorrelated, so that the mean over the rows of a quadratic function
    is its mean over independent parameters (Plackett and Burman, 1946). N - 1 is the least prime p >= count with p
    = 3 (mod 4).
    """
    size = count
    # Paley's construction: for such a prime the quadratic residues modulo p give a Hadamard matrix of order p + 1.
    while size % 4 != 3 or any(size % k == 0 for k in range(2, size)):
        size += 1
    squares = {k * k % size for k in range(1, size)}
    # +1 at 0 and at quadratic residues, -1 elsewhere; shifted p times, and closed by a row of -1, columns sum to
    # 0.
    row = np.array([1.0 if k in squares or k == 0 else -1.0 for k in range(size)])
    signs = np.vstack([*(np.roll(row, -k) for k in range(size)), -np.ones(size)])
    return signs[:, :count]
