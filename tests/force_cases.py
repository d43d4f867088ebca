"""Shapes of a slim robot under known forces, measured with noise, and how well these are estimated.

Shapes come from plans under a load: a force along the body acts there between two places, and not on the pieces on
which the estimate looks for it.
"""

from dataclasses import dataclass

import numpy as np

import ctr_nlp as ctr
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.force_estimation import ForceEstimate, estimate_forces
from ctr_nlp.robot.samples import sample_robots

NOISE = 0.3
SIGMA = np.linspace(0.05, 1.0, 20)
EXACT = ctr.Tolerances(curvature=0, bending_stiffness=0, torsional_ratio=0, curved_length=0, motor_zero=0)
ROUGH = ctr.Tolerances(curvature=0.02, bending_stiffness=0.02, torsional_ratio=0, curved_length=0, motor_zero=0.02)


def slim(tolerances=EXACT):
    tubes = [(150, 60, 1 / 100, 2.0, 1.6), (230, 110, 1 / 70, 1.4, 1.1), (320, 150, 1 / 60, 0.9, 0.6)]
    return ctr.Robot(
        tuple(ctr.Tube(*numbers, youngs_modulus=60_000.0) for numbers in tubes), tolerances=tolerances
    )


Q = np.array([0.3, 1.0, 0.6, 30.0, 80.0, 125.0, 0.0, 0.0])


def shape_under(load, robot=None, q=Q):
    """The shape (101, 3) of a robot at q under a load."""
    robot = slim() if robot is None else robot
    line = ctr.curve_from_points([[0.0, 0.0, z] for z in np.linspace(0, q[5], 30)])
    plan = ctr.plan_through(ctr.Problem("straight", robot, ctr.growing(line, 1)), q[None])
    return (plan if load is None else plan.with_load(load)).shape[0]


def measured(shape, seed=0, q=Q, force=(0.0, 0.0, 0.0), noise=NOISE):
    places = np.rint(100 * SIGMA).astype(int)
    points = shape[places] + np.random.default_rng(seed).normal(size=(len(places), 3)) * noise
    none = np.full((1, 3), np.nan)
    return Measurements(
        q[None],
        none,
        none,
        points[None],
        places[None] / 100,
        np.full(1, np.nan),
        np.zeros(1, int),
        force=np.array(force),
    )


def sampled_robot(robot, samples, k):
    """The robot of a sample, without tolerances."""
    tubes = []
    for tube, off in zip(robot.tubes, samples.deviations[k], strict=True):
        curvature = tuple((1 + off[0]) * each for each in np.atleast_1d(tube.curvature))
        tubes.append(
            ctr.Tube(
                tube.length,
                tube.curved_length,
                curvature if len(curvature) > 1 else curvature[0],
                tube.outer_diameter,
                tube.inner_diameter,
                youngs_modulus=tube.youngs_modulus * (1 + off[1]),
            )
        )
    return ctr.Robot(tuple(tubes), tolerances=EXACT)


@dataclass(frozen=True)
class Case:
    """Forces at the tip and along the body, N, the place of the latter, mm, and what was estimated."""

    tip: np.ndarray
    body: np.ndarray
    place: float
    found: ForceEstimate

    @property
    def tip_scores(self):
        """Errors over reported deviations."""
        return (self.found.force - self.tip) / self.found.deviations

    @property
    def body_scores(self):
        """Errors over reported deviations."""
        return (self.found.body_force - self.body) / self.found.body_deviations

    @property
    def noticed(self):
        """Whether it is reported that something acts elsewhere than at the tip."""
        return self.found.kind in ("body", "tip and body", "unexplained")

    @property
    def detectable(self):
        """Whether the force along the body is above the least detectable one in its direction."""
        size = np.linalg.norm(self.body)
        return size > 0 and size > self.found.least_body_force(self.place, self.body)


def random_direction(rng):
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def load_of(tip, body, place):
    """The load of forces, N, of which that along the body is spread over 4 mm."""
    along = {"distributed_force": tuple(body / 4), "between": (place - 2, place + 2)} if body.any() else {}
    return ctr.Load(force=tuple(tip), **along)


def random_cases(tolerances, seed, count, detectable=False):
    """Cases with a force at the tip, along the body or both in turn, of 0.05 to 0.3 N.

    detectable: with a force along the body alone, of 1 to 1.5 times the least detectable one at its place in its
    direction, where this is below 1 N.
    """
    robot, rng = slim(tolerances), np.random.default_rng(seed)
    samples = sample_robots(robot, count, seed)
    cases = []
    for k in range(count):
        acts = (("tip",), ("body",), ("tip", "body"))[1 if detectable else k % 3]
        tip, body = (random_direction(rng) * rng.uniform(0.05, 0.3) * (where in acts) for where in ("tip", "body"))
        place = float(rng.uniform(40.0, 100.0))
        q = Q.copy()
        q[:3] += rng.uniform(-0.5, 0.5, 3)
        if detectable:
            (bare,) = estimate_forces(robot, measured(shape_under(None, robot, q), seed + k, q), NOISE)
            least = bare.least_body_force(place, body)
            if least > 1:
                continue
            body *= rng.uniform(1.0, 1.5) * least / np.linalg.norm(body)
        moved = q + np.pad(samples.offsets[k], (0, 5))
        shape = shape_under(load_of(tip, body, place), sampled_robot(robot, samples, k), moved)
        if np.isfinite(shape).all():
            (found,) = estimate_forces(robot, measured(shape, seed + k, q), NOISE)
            cases.append(Case(tip, body, place, found))
    return cases


def root_mean_square(values):
    return float(np.sqrt(np.mean(np.square(list(values)))))
