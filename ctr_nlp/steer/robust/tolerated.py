"""Scenarios that stand for all the robots that tolerances allow."""

from __future__ import annotations

import itertools
import math

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.shared.scenarios import check_shared
from ctr_nlp.models import Model, model_named
from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import Draws, drawn_from
from ctr_nlp.robot.tolerances import NAMES
from ctr_nlp.support.values import instance
from ctr_nlp.typing import Array

EXTREMES = 512
"""Corners that are given, at most."""


def scenarios_of(robot: Robot) -> Scenarios:
    """A robot, and robots that have the mean and the covariance of what it may be within its tolerances.

    Lags are left out. Raises OptionError where nothing may differ, and where tubes' curved parts may come to end
    in their transmissions, which is another structure.
    """
    root = robot.tolerances.root(robot.tubes)
    deviations = root[:, abs(root).max(axis=0) > 0]
    if not deviations.size:
        raise OptionError("all tolerances of the robot are 0; give some, or plan without robustness")
    signs = balanced(deviations.shape[1])
    parts = np.vstack([np.zeros(len(root)), signs @ deviations.T]).reshape(-1, robot.d, len(NAMES))
    made = drawn_from(robot, parts, np.zeros(parts.shape[:2]))
    if made.structure != robot.structure:
        raise OptionError(
            "curved_length of tolerances lets a curved part end before the tube's largest extension; "
            "a robust plan needs limits of beta below the curved lengths"
        )
    return Scenarios(made.numbers, made.offsets, np.r_[0.0, np.ones(len(signs))])


def extremes_of(robot: Robot) -> Draws:
    """The corners of what a robot may be within its tolerances, without lags: all of them, or EXTREMES at random.

    Their order is a random one, so that the first are as good as any; it is the same for every robot. Every
    independent quantity is as far off as at the end of a uniform band: sqrt(3) standard deviations.
    """
    root, random = robot.tolerances.root(robot.tubes), np.random.default_rng(0)
    deviations = root[:, abs(root).max(axis=0) > 0]
    count = deviations.shape[1]
    if 2**count <= EXTREMES:
        signs = random.permutation(np.array(list(itertools.product((-1.0, 1.0), repeat=count))))
    else:
        signs = random.choice((-1.0, 1.0), (EXTREMES, count))
    parts = math.sqrt(3) * signs @ deviations.T
    return drawn_from(robot, parts.reshape(-1, robot.d, len(NAMES)), np.zeros((len(signs), robot.d)))


def described(robot: Robot, model: str | Model, scenarios: Scenarios | None) -> tuple[Model, Scenarios]:
    """The model and the scenarios asked for, which by default are those of tolerances; raises OptionError."""
    model = model_named(model, "model of scenarios")
    scenarios = scenarios_of(robot) if scenarios is None else scenarios
    instance(OptionError, "scenarios", scenarios, Scenarios)
    check_shared(robot, model, scenarios)
    return model, scenarios


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
