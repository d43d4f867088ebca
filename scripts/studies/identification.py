"""Identification of a robot's parameters from random poses in free space, before a motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctr_nlp.identify.calibration.calibration import Calibration, calibrate
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.calibration.next_poses import stable_poses
from ctr_nlp.identify.closed_loop.parameter_differences import ParameterDifferences
from ctr_nlp.models import Model
from ctr_nlp.models.protocol import MotionSubsteps
from ctr_nlp.robot import Robot, Tolerances
from ctr_nlp.robot.samples import RobotSamples
from ctr_nlp.typing import Array

IDENTIFICATION_POSE_COUNT = 20
"""Number of poses in which a robot is measured."""


def identify_robot(
    robot: Robot, tolerances: Tolerances, sample: RobotSamples, model: Model, sigma: Array, noise: float, seed: int
) -> tuple[Array, Array]:
    """Estimate the parameters of a simulated robot from IDENTIFICATION_POSE_COUNT random poses.

    Returns the mean (k,) and the covariance (k, k) of its differences from the nominal robot, in the order of
    ParameterDifferences. robot: the nominal one. tolerances: prior knowledge. sample: the robot that is measured.
    model: kinematic model. sigma: (n,), normalised arc lengths of the measured points, in the axes of the base.
    noise: standard deviation of every coordinate, mm. seed: of poses and noise. Raises MeasurementError,
    OptionError.
    """
    differences = ParameterDifferences.of(robot, tolerances)
    measured = measure_random_poses(robot, sample, model, sigma, noise, seed)
    found = calibrate(replace(robot, tolerances=tolerances), measured, model=model, registered=True, held_out=0)
    return _ordered_estimates(differences, found)


def measure_random_poses(
    robot: Robot,
    sample: RobotSamples,
    model: Model,
    sigma: Array,
    noise: float,
    seed: int,
    poses: int = IDENTIFICATION_POSE_COUNT,
) -> Measurements:
    """Simulate measurements of a robot's shape at random stable poses.

    robot: the nominal one, whose limits the poses keep. sample: the robot that is measured. model: kinematic
    model. sigma: (n,), normalised arc lengths of the measured points. noise: standard deviation of every
    coordinate, mm. seed: of poses and noise. poses: number of them. In each pose the robot is at rest without a
    history.
    """
    q = stable_poses(robot, model, poses, seed)
    # The measurements record the commanded q. The tubes stand at q plus the errors of the motors' zeros, which are
    # among the parameters to be estimated.
    turned = np.array(q)
    turned[:, : robot.d] += sample.offsets[0]
    way = MotionSubsteps(turned, np.arange(poses), np.ones(poses, dtype=bool), poses)
    (found,) = model.follow_batch(sample.structure, sample.numbers, way, turned[None], False)
    (points,) = model.points_batch(sample.structure, sample.numbers, found.x[None], sigma)
    # Independent of the stream of `seed`, from which the poses are sampled.
    points += noise * np.random.default_rng([seed, 3]).standard_normal(points.shape)
    none = np.full((poses, 3), np.nan)
    places = np.tile(sigma, (poses, 1))
    return Measurements(q, none, none, points, places, none[:, 0], np.zeros(poses, dtype=int))


def _ordered_estimates(differences: ParameterDifferences, found: Calibration) -> tuple[Array, Array]:
    """Return estimates (k,) and covariance (k, k) of a calibration in the order of `differences`."""
    rows = {(one.number, one.kind): k for k, one in enumerate(found.parameters.each)}
    picked = [rows[tube + 1, name] for tube, name in differences.entries]
    return found.fit.values[picked], found.fit.covariance[np.ix_(picked, picked)]
