"""Perturbed robots: Monte Carlo samples of a robot within its tolerances, and robots with measured parameters.

A perturbed robot differs from the nominal one by `parts`, one row a tube: relative changes of the pre-curvature
(1), of the bending stiffness EI (2) and of the torsional ratio EI / GJ (3), an absolute change of the curved
length in mm (4) and the error of its motor's zero delta_i in rad (5). With a backlash l_i, of its own, the angle
of tube i follows that of its motor, from the aligned pose on, as a play operator:

    alpha_i <- min(max(alpha_i, motor_i - l_i), motor_i + l_i),  and alpha_i + delta_i turns the tube.

See docs/method.md, "Tolerances and Monte Carlo samples".
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.limits import Limits
from ctr_nlp.robot.robot import Robot
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure
from ctr_nlp.robot.tolerances import DEVIATION_NAMES, Tolerances
from ctr_nlp.robot.tube import Tube
from ctr_nlp.support.value_checks import whole_number
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags

MAX_BOX_VERTICES = 2**16
"""Most box vertices that are returned; moving each one through a plan takes some milliseconds."""
MIN_REMAINING_PART = 0.05
"""Least part of a curvature, stiffness or length that is left of it: normal samples have no bound, and a tube of
negative stiffness would have no equilibrium.
"""


@dataclass(frozen=True, eq=False)
class RobotSamples(ReadOnlyValue):
    """Perturbed robots (samples) that share one structure, as a batch of n robots with d tubes each.

    Attributes
    ----------
    structure : Structure
        What they have in common: compiled programs are shared.
    numbers : ndarray
        Tubes (n, d, 8), in the order of `structure.TUBE_NUMBER_NAMES`.
    offsets : ndarray
        Errors of the motors' zeros (n, d), rad: by how much the angle of a tube exceeds that of its motor.
    backlash : ndarray
        Backlash (n, d), rad: largest difference between the angles of a tube and of its motor, to either side.
    forces : ndarray
        Forces (n, 3) at the tips, N, in the axes of the base.
    deviations : ndarray
        Differences (n, d, 5) from the nominal robot, in the order of `tolerances.DEVIATION_NAMES`.
    """

    structure: Structure
    numbers: Array
    offsets: Array
    backlash: Array
    forces: Array
    deviations: Array

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, chosen: Any) -> RobotSamples:
        """Return the robots that `chosen` indexes (an integer array, a mask or a slice over n), as samples."""
        rows = (each[chosen] for each in (self.numbers, self.offsets, self.backlash, self.forces, self.deviations))
        return RobotSamples(self.structure, *rows)

    def tube_configurations(self, q: Array, from_aligned: Flags) -> Array:
        """Return the angles that the tubes of the samples have where the motors move through a motion.

        Parameters
        ----------
        q : ndarray
            Configurations (T, 2d + 2) of the motors, rad and mm. Every motor turns in one direction from row to
            row.
        from_aligned : ndarray
            Rows (T,) that the robot reaches from the aligned pose, all tubes at alpha_d. The first row is one of
            them.

        Returns
        -------
        ndarray
            Configurations (n, T, 2d + 2) of the tubes. A tube whose motor has turned by more than its backlash
            follows at that angle; it stands still while a motor that turns back takes up the play.
        """
        found = np.repeat(q[None], len(self), axis=0)
        d = self.offsets.shape[1]
        if self.backlash.any():
            # The aligned pose has no backlash taken up: all tubes stand where the innermost motor is.
            alpha = found[:, 0, :d]
            for j, goal in enumerate(q[:, :d]):
                alpha = apply_backlash(
                    np.full_like(alpha, goal[-1]) if from_aligned[j] else alpha, goal, self.backlash
                )
                found[:, j, :d] = alpha
        found[..., :d] += self.offsets[:, None]
        return found


def apply_backlash(alpha: Array, motor_angle: Array, play: Array) -> Array:
    """Return the angles of tubes after their motors have turned, with backlash (play operator).

    Parameters
    ----------
    alpha : ndarray
        Angles (.., d) of the tubes before, rad.
    motor_angle : ndarray
        Angles (.., d) of their motors after the turn, rad.
    play : ndarray
        Backlash (.., d) to either side, rad.

    Returns
    -------
    ndarray
        Angles (.., d) of the tubes after it, rad: clipped to within `play` of `motor_angle`.
    """
    found: Array = np.clip(alpha, motor_angle - play, motor_angle + play)
    return found


def sample_robots(robot: Robot, count: int, seed: int) -> RobotSamples:
    """Sample robots at random from the tolerances of a robot.

    Parameters
    ----------
    robot : Robot
        The nominal robot, with its tolerances.
    count : int
        Number of samples n, at least 1.
    seed : int
        Seed of numpy's default generator, at least 0. The same seed gives the same samples, and fewer samples are
        the first of more.

    Returns
    -------
    RobotSamples
        The samples. Where a force may act at the tip, each has all of it, in a random direction of its own.

    Raises
    ------
    RobotError
        `count` or `seed` is out of range.

    Examples
    --------
    >>> from ctr_nlp.robot import table_i_robot
    >>> from ctr_nlp.robot.samples import sample_robots
    >>> samples = sample_robots(table_i_robot(), count=3, seed=0)
    >>> samples.numbers.shape, samples.offsets.shape
    ((3, 3, 8), (3, 3))
    """
    count = whole_number(RobotError, "draws", count)
    seed = whole_number(RobotError, "seed of draws", seed, 0)
    tolerances = robot.tolerances
    d = robot.d
    # Three independent streams: robots without a tolerance of diameters or a backlash stay the same samples when
    # another tolerance is added.
    random, shares, sections = (np.random.default_rng([seed, stream]) for stream in range(3))
    if tolerances.distribution == "uniform":
        bands = tolerances.bands_without_diameters(d)
        parts = random.uniform(-1.0, 1.0, (count, *bands.shape)) * bands
        off = sections.uniform(-1.0, 1.0, (count, d, 2)) * tolerances.diameters(d)[:, None]
        # A view into parts: the factor of a section with both diameters off, (D^4 - d^4) / (D0^4 - d0^4),
        # multiplies the factor that the band of the bending stiffness gives, so that thin tubes are not
        # linearised.
        stiffness = parts[..., DEVIATION_NAMES.index("bending_stiffness")]
        stiffness[:] = (1 + stiffness) * _bending_stiffness_factors(robot, off) - 1
    else:
        root = tolerances.covariance_root(robot.tubes)
        # Independent standard normal numbers times R have the covariance R R^T.
        parts = (random.standard_normal((count, len(root))) @ root.T).reshape(count, d, len(DEVIATION_NAMES))
    lags = shares.uniform(0.0, 1.0, (count, d)) * tolerances.max_backlash(d)
    return perturb_robot(robot, parts, lags, _forces(robot, count, seed))


def box_vertices_of(robot: Robot, max_vertices: int = MAX_BOX_VERTICES) -> RobotSamples:
    """Return the robots at the vertices of the box that the tolerances span.

    Parameters
    ----------
    robot : Robot
        The nominal robot, with its tolerances.
    max_vertices : int
        Most vertices: with more than this, so many of them are chosen at random (seed 0).

    Returns
    -------
    RobotSamples
        Robots of which every independent quantity is as far off as at the end of a uniform band. Tubes with a
        backlash have all of it; where a force may act at the tip, all of it does, in a random direction of each
        robot's own.
    """
    root = robot.tolerances.covariance_root(robot.tubes)
    deviations = root[:, abs(root).max(axis=0) > 0]
    count = deviations.shape[1]
    if 2**count <= max_vertices:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=count))).reshape(-1, count)
    else:
        # Too many vertices to list: a random choice, which may repeat some.
        signs = np.random.default_rng(0).choice((-1.0, 1.0), (max_vertices, count))
    # A uniform band of half width b has the standard deviation b / sqrt(3), which is the size of root's columns.
    parts = math.sqrt(3) * signs @ deviations.T
    # Every vertex has all of the backlash, which is no deviation to either side of a nominal value.
    lags = np.tile(robot.tolerances.max_backlash(robot.d), (len(signs), 1))
    return perturb_robot(
        robot, parts.reshape(-1, robot.d, len(DEVIATION_NAMES)), lags, _forces(robot, len(signs), 0)
    )


def _forces(robot: Robot, count: int, seed: int) -> Array:
    """Return forces (count, 3) at tips, N, each as large as may be, in directions uniform over the sphere."""
    # A normalised standard normal vector is uniform over the sphere. Stream 3 of the seed: 0 to 2 are those of
    # `sample_robots`.
    directions = np.random.default_rng([seed, 3]).standard_normal((count, 3))
    return robot.tolerances.tip_force * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _bending_stiffness_factors(robot: Robot, off: Array) -> Array:
    """Return the factors (n, d) by which bending stiffnesses change where diameters are off by (n, d, 2) mm,
    outer, inner.
    """
    described = np.array([(tube.outer_diameter, tube.inner_diameter) for tube in robot.tubes])
    fourth = np.maximum(described + off, 0.0) ** 4
    whole = described**4
    return np.asarray((fourth[..., 0] - fourth[..., 1]) / (whole[:, 0] - whole[:, 1]))


def perturb_robot(robot: Robot, deviations: Array, backlash: Array, forces: Array | None = None) -> RobotSamples:
    """Return the robots that differ from a nominal one by given amounts.

    Parameters
    ----------
    robot : Robot
        The nominal robot, of d tubes.
    deviations : ndarray
        Differences (n, d, 5), in the order of `tolerances.DEVIATION_NAMES`: relative for the first three, then mm
        and rad.
    backlash : ndarray
        Backlash (n, d), rad.
    forces : ndarray, optional
        Forces (n, 3) at the tips, N; none by default.

    Returns
    -------
    RobotSamples
        Curvatures, stiffnesses and lengths are kept above a twentieth of the nominal ones, and curved parts no
        longer than their tubes.
    """
    forces = np.zeros((len(deviations), 3)) if forces is None else forces
    numbers = np.repeat(robot.numbers[None], len(deviations), axis=0)
    # One factor for both ends of a linear curved part, whose shape is kept up to scale.
    factors = {
        "root_curvature": deviations[..., 0],
        "tip_curvature": deviations[..., 0],
        "bending_stiffness": deviations[..., 1],
        "torsional_ratio": deviations[..., 2],
    }
    for name, part in factors.items():
        numbers[..., TUBE_NUMBER_NAMES.index(name)] *= np.maximum(1 + part, MIN_REMAINING_PART)
    length, curved = (TUBE_NUMBER_NAMES.index(name) for name in ("length", "curved_length"))
    described = robot.numbers[:, curved]
    numbers[..., curved] = np.clip(
        described + deviations[..., 3], MIN_REMAINING_PART * described, numbers[..., length]
    )
    # Where a perturbed curved part is shorter than the tube's largest extension, the straight transmission comes
    # out of the insertion point. That is another structure, which then holds for the whole batch.
    reach = robot.upper[robot.d : 2 * robot.d]
    bent = np.array([kind != "straight" for kind in robot.structure.kinds])
    emerges = (numbers[..., curved] < reach).any(axis=0) & bent
    shown = tuple(emerges | np.array(robot.structure.transmission_emerges))
    structure = replace(robot.structure, transmission_emerges=tuple(map(bool, shown)))
    return RobotSamples(structure, numbers, deviations[..., 4], backlash, forces, deviations)


def build_calibrated_robot(robot: Robot, deviations: Array, covariance: Array, rotation_lag: Any) -> Robot:
    """Return the robot that a calibration found, with its remaining uncertainty as tolerances.

    Parameters
    ----------
    robot : Robot
        The robot as described before.
    deviations : ndarray
        Differences (d, 5) of its tubes from that description, in the order of `tolerances.DEVIATION_NAMES`.
    covariance : ndarray
        Covariance (5 d, 5 d) that is left of these differences.
    rotation_lag : float or sequence of float
        Largest backlash, rad; one number or one a tube.

    Returns
    -------
    Robot
        The stiffness is changed through `youngs_modulus` and the torsional ratio through `poisson_ratio`. Errors
        of motors' zeros are no numbers of tubes: correcting them is left to the caller, and only their uncertainty
        is in the tolerances.

    Raises
    ------
    RobotError
        No such tubes can be made.
    """
    tubes = tuple(_tube(tube, own) for tube, own in zip(robot.tubes, deviations, strict=True))
    # Relative parts refer to the new tubes now: k0 (1 + p + e) = k (1 + e / (1 + p)) with k = k0 (1 + p). Lengths
    # and zeros are absolute and keep their scale.
    scale = np.ones(deviations.shape)
    scale[:, :3] = 1 / (1 + deviations[:, :3])
    left = covariance * np.outer(scale.ravel(), scale.ravel())
    # Averaged with its transpose, since rounding of the product may leave a covariance that is not quite
    # symmetric.
    tolerances = Tolerances(rotation_lag=rotation_lag, distribution="normal", covariance=(left + left.T) / 2)
    return replace(robot, tubes=tubes, limits=_limits(robot), tolerances=tolerances)


def _tube(tube: Tube, deviations: Array) -> Tube:
    """Return a tube changed by `deviations` (5,): curvature, stiffness and torsional ratio as parts, curved length
    in mm.
    """
    curvature, stiffness, ratio, length, _ = deviations.tolist()
    return replace(
        tube,
        curvature=(tube.root_curvature * (1 + curvature), tube.tip_curvature * (1 + curvature)),
        youngs_modulus=tube.youngs_modulus * (1 + stiffness),
        # EI / GJ = 1 + Poisson's ratio for a round section (J = 2 I, G = E / (2 (1 + nu))).
        poisson_ratio=(1 + tube.poisson_ratio) * (1 + ratio) - 1,
        curved_length=tube.curved_length + length,
    )


def _limits(robot: Robot) -> Limits:
    """Return the robot's limits with explicit ones of beta: by default they would follow the curved
    lengths found.
    """
    # Only the limits are pinned; lower and upper are those of the robot before.
    beta = zip(*(robot.split(ends)[1].tolist() for ends in (robot.lower, robot.upper)), strict=True)
    return replace(robot.limits, beta=tuple(beta))
