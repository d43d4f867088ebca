"""Simulated measurements of robots that are known, and usual mistakes in files of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from sensed import TWO, observations, shapes_of

from ctr_nlp import Measurements, Robot, Tolerances, Tube, table_i_robot
from ctr_nlp.identify.calibration.next_poses import stable_poses
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.robot.tolerances import DEVIATION_NAMES

KNOWN = Tolerances(0.02, 0.02, motor_zero=0.02)
WIDE = Robot(
    (
        Tube(173, 173, 0.0108, 2.39, 1.83),
        Tube(275, 114, 0.01168, 1.8, 1.4),
        Tube(309, 145, 0.01352, 1.1, 0.7),
    ),
    tolerances=KNOWN,
)
ROBOTS = {
    "two": replace(TWO, tolerances=KNOWN).with_locked_tilt(),
    "wide": WIDE.with_locked_tilt(),
    "table": replace(table_i_robot(), tolerances=KNOWN).with_locked_tilt(),
}


def simulate(robot, seed, count=25, noise=0.2, off=0.02, points=0, registered=True, turns=1.0):
    """Measurements of a robot whose numbers are up to a part `off` away, tips and a number of points.

    Angles go from -pi to pi, times `turns`.
    """
    random = np.random.default_rng([seed, 5])
    parts = np.zeros((robot.d, len(DEVIATION_NAMES)))
    parts[:, :2] = random.uniform(-off, off, (robot.d, 2))
    parts[:, 4] = random.uniform(-0.02, 0.02, robot.d)
    q = stable_poses(robot, KINEMATIC_MODELS["elastic"], count, seed)
    q[:, : robot.d] *= turns
    sigma = np.r_[np.linspace(1, points, points) / (points + 1), 1.0]
    seen = shapes_of(robot, parts, q, sigma)
    seen = seen + noise * random.standard_normal(seen.shape)
    if not registered:
        turn = Rotation.random(random_state=int(random.integers(1000))).as_matrix()
        seen = seen @ turn.T + random.uniform(-200, 200, 3)
    return observations(q, seen[:, :-1], sigma[:-1], tip=seen[:, -1])


@dataclass(frozen=True)
class Mistake:
    """A mistake in a file: what it does to measurements, words of its name, and where it can be seen."""

    apply: Callable[[Measurements, Robot], Measurements]
    words: str
    needs_registered: bool = False
    least_points: int = 0
    least_tubes: int = 1


def configurations(change):
    def apply(measured, robot):
        q = np.array(measured.q)
        change(q, robot.d)
        return replace(measured, q=q)

    return apply


def seen(change):
    def apply(measured, _):
        return replace(measured, tip=change(measured.tip), points=change(measured.points))

    return apply


def matrix(*rows):
    return seen(lambda vectors: vectors @ np.array(rows, dtype=float).T)


def scale_alpha(q, d):
    q[:, :d] *= 180 / np.pi


def scale_beta(factor):
    def change(q, d):
        q[:, d : 2 * d] *= factor

    return configurations(change)


def both(*mistakes):
    def apply(measured, robot):
        for one in mistakes:
            measured = one(measured, robot)
        return measured

    return apply


def negate(*tubes):
    def change(q, d):
        q[:, [i for i in tubes if i < d]] *= -1

    return configurations(change)


def exchange_alpha(q, d):
    q[:, [0, d - 1]] = q[:, [d - 1, 0]]


def exchange_tubes(q, d):
    exchange_alpha(q, d)
    q[:, [d, 2 * d - 1]] = q[:, [2 * d - 1, d]]


def relative_alpha(q, d):
    q[:, 1:d] = np.diff(q[:, :d], axis=1)


def rows(order):
    def apply(measured, _):
        places = order(len(measured))
        return replace(
            measured,
            tip=measured.tip[places],
            points=measured.points[places],
            sigma=measured.sigma[places],
        )

    return apply


def exchange_two(count):
    order = np.arange(count)
    order[[3, count // 2]] = order[[count // 2, 3]]
    return order


def some_permuted(count):
    order = np.arange(count)
    some = order[::3]
    order[::3] = np.roll(some, 1)
    return order


def permute_points(share):
    def apply(measured, _):
        random = np.random.default_rng(3)
        points = np.array(measured.points)
        n = points.shape[1]
        for row in range(0, len(points), round(1 / share)):
            order = random.permutation(n)
            while (order == np.arange(n)).all():
                order = random.permutation(n)
            points[row] = points[row, order]
        return replace(measured, points=points)

    return apply


def one_row(change):
    def apply(measured, _):
        tip, points = np.array(measured.tip), np.array(measured.points)
        tip[4], points[4] = change(tip[4]), change(points[4])
        return replace(measured, tip=tip, points=points)

    return apply


def exchange_points_in_a_row(measured, _):
    points = np.array(measured.points)
    points[6, [0, -1]] = points[6, [-1, 0]]
    return replace(measured, points=points)


def moved_sensor(degrees, mm):
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.64, 0.48])).as_matrix()
    place = mm * np.array([0.6, -0.48, 0.64])
    return seen(lambda vectors: vectors @ turn.T + place)


MISTAKES = {
    "points in m": Mistake(seen(lambda v: v / 1000), "are in m"),
    "points in cm": Mistake(seen(lambda v: v / 10), "are in cm"),
    "points in inches": Mistake(seen(lambda v: v / 25.4), "are in in"),
    "beta in m": Mistake(scale_beta(1e-3), "in m"),
    "beta in cm": Mistake(scale_beta(0.1), "in cm"),
    "beta and points in m": Mistake(both(scale_beta(1e-3), seen(lambda v: v / 1000)), "and measured points in m"),
    "beta and points in cm": Mistake(both(scale_beta(0.1), seen(lambda v: v / 10)), "in cm"),
    "degrees": Mistake(configurations(scale_alpha), "degrees"),
    "sign of alpha_1": Mistake(negate(0), "alpha_1 has the opposite sign|alpha_2", least_tubes=2),
    "sign of the last alpha": Mistake(negate(2), "alpha_3 has the opposite sign", least_tubes=3),
    "sign of all alphas": Mistake(negate(0, 1, 2), "all alphas have the opposite sign"),
    "mirrored x": Mistake(matrix([-1, 0, 0], [0, 1, 0], [0, 0, 1]), "opposite sign|mirrored"),
    "mirrored y": Mistake(matrix([1, 0, 0], [0, -1, 0], [0, 0, 1]), "opposite sign|mirrored"),
    "mirrored z": Mistake(matrix([1, 0, 0], [0, 1, 0], [0, 0, -1]), "opposite sign|mirrored"),
    "x and y exchanged": Mistake(matrix([0, 1, 0], [1, 0, 0], [0, 0, 1]), "exchanged"),
    "y and z exchanged": Mistake(matrix([1, 0, 0], [0, 0, 1], [0, 1, 0]), "exchanged"),
    "y and z exchanged, turned": Mistake(
        matrix([1, 0, 0], [0, 0, -1], [0, 1, 0]), "x, y, z of the robot are", needs_registered=True
    ),
    "alpha columns exchanged": Mistake(
        configurations(exchange_alpha), "alpha_1 and alpha_. are exch", least_tubes=2
    ),
    "tubes exchanged": Mistake(configurations(exchange_tubes), "exchanged|innermost", least_tubes=2),
    "alpha from tube to tube": Mistake(configurations(relative_alpha), "from the tube around it", least_tubes=2),
    "rows shifted by one": Mistake(rows(lambda n: np.roll(np.arange(n), 1)), "1 row"),
    "rows shifted by three": Mistake(rows(lambda n: np.roll(np.arange(n), -3)), "3 rows"),
    "rows reversed": Mistake(rows(lambda n: np.arange(n)[::-1]), "reverse order"),
    "rows permuted": Mistake(rows(np.random.default_rng(1).permutation), "another order"),
    "a third of the rows permuted": Mistake(rows(some_permuted), "another order"),
    "two rows exchanged": Mistake(rows(exchange_two), "exchanged between"),
    "points in reverse order": Mistake(
        lambda m, _: replace(m, points=m.points[:, ::-1]), "in the order", least_points=2
    ),
    "points permuted in all rows": Mistake(permute_points(1), "points are in another order", least_points=3),
    "points permuted in a third": Mistake(permute_points(1 / 3), "points (are|were) in another", least_points=3),
    "two points exchanged in a row": Mistake(
        exchange_points_in_a_row, "(are|were) in another order", least_points=2
    ),
    "one row in m": Mistake(one_row(lambda v: v / 1000), "in m"),
    "sensor 3 degrees, 5 mm off": Mistake(moved_sensor(3, 5), "base pose explains", needs_registered=True),
    "sensor 1 degree, 1 mm off": Mistake(moved_sensor(1, 1), "base pose explains", needs_registered=True),
    "sensor 40 degrees, 100 mm off": Mistake(moved_sensor(40, 100), "base pose explains", needs_registered=True),
}
