"""What a sensor sees of a robot whose numbers are known, for tests of calibrations."""

from dataclasses import replace

import numpy as np

from ctr_nlp import Load, Measurements, Robot, Tolerances, Tube
from ctr_nlp.identify.calibration.next_poses import stable_poses
from ctr_nlp.models import KINEMATIC_MODELS, model_with_load
from ctr_nlp.models.protocol import MotionSubsteps
from ctr_nlp.robot.samples import perturb_robot

TWO = Robot(
    (Tube(90, 60, 1 / 130, 3.0, 2.4), Tube(160, 110, 1 / 60, 2.0, 1.4)),
    tolerances=Tolerances(0.1, 0.1, motor_zero=0.05),
)


def wide(robot, tolerances=None):
    """The robot, known to within 10 % and 0.05 rad, without an arm."""
    known = tolerances or Tolerances(0.1, 0.1, motor_zero=0.05)
    return replace(robot, tolerances=known).with_locked_tilt()


def shapes_of(robot, parts, q, sigma, model="elastic"):
    """Points (T, n, 3) of the robot whose parts are off by parts (d, 5), each pose by itself."""
    model = KINEMATIC_MODELS[model]
    draws = perturb_robot(robot, np.asarray(parts)[None], np.zeros((1, robot.d)))
    turned = np.array(q)
    turned[:, : robot.d] += draws.offsets[0]
    way = MotionSubsteps(turned, np.arange(len(q)), np.ones(len(q), dtype=bool), len(q))
    (found,) = model.follow_batch(draws.structure, draws.numbers, way, turned[None], False)
    return model.points_batch(draws.structure, draws.numbers, found.x[None], sigma)[0]


def observations(q, points=None, sigma=(), tip=None, direction=None, time=None, recording=None, force=None):
    """Measurements of what is given; the rest was not seen, and where no force is given none acts."""
    count = len(q)
    unseen = np.full((count, 3), np.nan)
    return Measurements(
        np.asarray(q, dtype=float),
        unseen if tip is None else tip,
        unseen if direction is None else direction,
        np.zeros((count, 0, 3)) if points is None else points,
        np.tile(np.asarray(sigma, dtype=float), (count, 1)),
        np.full(count, np.nan) if time is None else time,
        np.zeros(count, dtype=int) if recording is None else recording,
        force=np.zeros(3) if force is None else force,
    )


def measured_shapes(robot, parts, seed, count=40, places=5, noise=0.5, model="elastic"):
    """Shapes at random stable poses, with noise in mm in every coordinate."""
    q = stable_poses(robot, KINEMATIC_MODELS[model], count, seed)
    sigma = np.linspace(1 / places, 1, places)
    points = shapes_of(robot, parts, q, sigma, model)
    return observations(q, points + noise * np.random.default_rng(seed).standard_normal(points.shape), sigma)


def parts_within(robot, seed):
    """Parts (d, 5) at random within the robot's tolerances."""
    bands = robot.tolerances.bands(robot.tubes)
    return np.random.default_rng(seed).uniform(-1, 1, bands.shape) * bands


def pushed_shapes(robot, q, force, sigma):
    """Points (T, n, 3) of the robot at poses q (T, 2d + 2), at each of which one of forces (T, 3) pulls."""
    models = [model_with_load("elastic", Load(force=tuple(each))) for each in force]
    return np.array(
        [m.points(robot, m.rest(robot, row)[None], sigma)[0] for m, row in zip(models, q, strict=True)]
    )


def weighed(actual, robot, count=30, newtons=1.0, noise=0.2):
    """Shapes of an actual robot where the described one is stable, with a weight in two of three poses."""
    q, random = stable_poses(robot, KINEMATIC_MODELS["elastic"], count, 0), np.random.default_rng(0)
    force = np.outer(newtons * (np.arange(count) % 3 > 0), [0.0, 1.0, 0.0])
    force[2::3] = [0.0, 0.0, newtons]
    sigma = np.linspace(0.25, 1, 4)
    points = pushed_shapes(actual, q, force, sigma)
    return observations(q, points + noise * random.standard_normal(points.shape), sigma, force=force)
