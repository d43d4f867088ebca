"""Parameters of a calibration, by name, with the mean and covariance of their prior.

Parameters of tubes are differences from the nominal robot, as in robot/tolerances.py: parts of its own number for
curvature, bending stiffness and torsional ratio, mm for the curved length, rad for the zero of a motor. Their
prior mean p_0 is 0, and the prior covariance C_0 comes from the robot's tolerances, or from PRIOR_SIGMAS where it
has none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.plan.backlash import BacklashAndDrag
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import MIN_REMAINING_PART
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.robot.tube import MAX_TUBE_CURVATURE_PER_MM
from ctr_nlp.typing import Array

LAGS = "rotation_lag", "lag_per_overlap", "drag"
"""Kinds of lag of each tube: play to either side, its growth with the overlap, time constant of viscous drag."""
MODULUS_KIND = "youngs_modulus"
"""Common factor of all tubes' stiffnesses, as a part of their own; identifiable only under loads."""
DELAY, OFFSET = "sensor_delay", "tip_offset"
BASE = "base_x", "base_y", "base_z", "base_turn_x", "base_turn_y", "base_roll"
"""Pose of the robot's base, one a recording: translation, mm, in the sensor's axes; rotation, rad, in its own."""
PARAMETER_KINDS = (*DEVIATION_NAMES, MODULUS_KIND, *LAGS, DELAY, OFFSET)
"""Kinds of parameters that may be named; the base's pose is estimated wherever it is unknown."""
PARAMETER_UNITS = {
    "curvature": "part",
    "bending_stiffness": "part",
    "torsional_ratio": "part",
    "curved_length": "mm",
    "motor_zero": "rad",
    "youngs_modulus": "part",
    "rotation_lag": "rad",
    "lag_per_overlap": "rad/mm",
    "drag": "s",
    "sensor_delay": "s",
    "tip_offset": "mm",
    **dict(zip(BASE, ("mm",) * 3 + ("rad",) * 3, strict=True)),
}
PRIOR_SIGMAS = {
    "curvature": 0.1,
    "bending_stiffness": 0.1,
    "torsional_ratio": 0.1,
    "curved_length": 2.0,
    "motor_zero": 0.05,
    "youngs_modulus": 0.3,
    "rotation_lag": 0.05,
    "lag_per_overlap": 0.001,
    "drag": 0.1,
    "sensor_delay": 0.1,
    "tip_offset": 5.0,
    **dict(zip(BASE, (1000.0,) * 3 + (1.0,) * 3, strict=True)),
}
"""Prior standard deviations of kinds that are named and have no tolerance in the robot's file."""
TIED_VARIANCE_INCREASE = 1e-9
"""Part by which variances are raised, so that the covariance of tied parameters is not singular."""
MOST_RATIO = 1.5
"""The largest torsional ratio, that of a Poisson's ratio of 0.5."""
PARAMETER_PHRASES = {
    "rotation_lag": "play",
    "lag_per_overlap": "play per mm of overlap",
    "base_roll": "roll of the base",
}


@dataclass(frozen=True)
class Parameter:
    """One number that is estimated, and its prior.

    Attributes
    ----------
    kind : str
        Kind of parameter, of PARAMETER_KINDS or BASE.
    number : int or None
        The tube or the recording that it belongs to, from 1; None where it belongs to the whole robot.
    sigma, mean, low, high : float
        Prior standard deviation, mean, and bounds, in `unit`. A unit of "part" is a part of the nominal robot's
        number.
    """

    kind: str
    number: int | None
    sigma: float
    mean: float = 0.0
    low: float = -math.inf
    high: float = math.inf

    @property
    def unit(self) -> str:
        """Unit of the value: "part", "mm", "rad", "rad/mm" or "s"."""
        return PARAMETER_UNITS[self.kind]

    @property
    def name(self) -> str:
        """Name in tables and files, such as curvature_2."""
        return self.kind if self.number is None else f"{self.kind}_{self.number}"

    @property
    def words(self) -> str:
        """Name in a sentence, such as "curvature of tube 2"."""
        said = PARAMETER_PHRASES.get(self.kind, self.kind.replace("_", " "))
        whose = "recording" if self.kind in BASE else "tube"
        return said if self.number is None else f"{said} of {whose} {self.number}"


@dataclass(frozen=True)
class Parameters:
    """The P parameters of a robot that are estimated; arrays of values (.., P) have them in this order.

    Attributes
    ----------
    robot : Robot
        The nominal robot.
    each : tuple of Parameter
        The parameters.
    """

    robot: Robot
    each: tuple[Parameter, ...]

    def __len__(self) -> int:
        return len(self.each)

    @property
    def names(self) -> list[str]:
        """Names of the parameters, in order."""
        return [one.name for one in self.each]

    @cached_property
    def mean(self) -> Array:
        """Prior means p_0 (P,)."""
        return np.array([one.mean for one in self.each])

    @cached_property
    def sigma(self) -> Array:
        """Prior standard deviations (P,)."""
        return np.array([one.sigma for one in self.each])

    @cached_property
    def covariance(self) -> Array:
        """Prior covariance C_0 (P, P), with the correlations that the robot's tolerances may have."""
        # Only correlations come from the tolerances: a named kind without a tolerance has its variance from
        # PRIOR_SIGMAS, and 0 in the robot's covariance.
        found = np.diag(self.sigma**2)
        all_parts = _covariance(self.robot)
        columns = self.columns(*DEVIATION_NAMES)
        places = [len(DEVIATION_NAMES) * self.tube(k) + DEVIATION_NAMES.index(self.each[k].kind) for k in columns]
        for k, row in zip(columns, places, strict=True):
            for j, column in zip(columns, places, strict=True):
                if j != k:
                    found[k, j] = all_parts[row, column]
        return found

    @cached_property
    def whitening_matrix(self) -> Array:
        """Matrix W (P, P) with W^T W = C_0^-1: W (p - p_0) are independent numbers of variance 1."""
        # Scaled to correlations first: variances in mm^2 and rad^2 differ by many orders of magnitude. The matrix
        # of tied (fully correlated) numbers is singular; a little variance of their own makes it definite.
        scaled = self.covariance / np.outer(self.sigma, self.sigma)
        root = np.linalg.cholesky(scaled + TIED_VARIANCE_INCREASE * np.eye(len(self)))
        return np.asarray(np.linalg.inv(root) / self.sigma)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Least and largest values, (P,) each."""
        return np.array([one.low for one in self.each]), np.array([one.high for one in self.each])

    @cached_property
    def structure(self) -> Structure:
        """Structure of robots with any values of the parameters.

        Where curved lengths are estimated, the straight transmission of any tube may come out of the opening.
        """
        found = self.robot.structure
        if any(one.kind == "curved_length" for one in self.each):
            return replace(found, transmission_emerges=(True,) * found.d)
        return found

    def columns(self, *kinds: str) -> list[int]:
        """Return the indices of all parameters of some kinds."""
        return [k for k, one in enumerate(self.each) if one.kind in kinds]

    def of_tubes(self, values: Array, kind: str) -> Array:
        """Return one kind's values of all tubes, (.., d), from values (.., P); 0 where they are not estimated."""
        found = np.zeros((*values.shape[:-1], self.robot.d))
        for k in self.columns(kind):
            found[..., self.tube(k)] = values[..., k]
        return found

    def parts(self, values: Array) -> Array:
        """Compute the differences of tubes from the nominal ones.

        Parameters
        ----------
        values : (.., P) array
            Values of the parameters.

        Returns
        -------
        (.., d, 5) array
            Differences in the order of ``robot.tolerances.DEVIATION_NAMES``: parts, mm and rad.
        """
        found = np.stack([self.of_tubes(values, name) for name in DEVIATION_NAMES], axis=-1)
        for k in self.columns(MODULUS_KIND):
            # To first order: (1 + a)(1 + m) = 1 + a + m.
            found[..., DEVIATION_NAMES.index("bending_stiffness")] += values[..., k, None]
        return found

    @property
    def parts_jacobian(self) -> Array:
        """Derivatives (5d, P) of the differences of :meth:`parts`, tube by tube, over the parameters."""
        return np.stack([self.parts(unit).ravel() for unit in np.eye(len(self))], axis=1)

    def numbers_derivative(self, column: int) -> Array:
        """Compute the derivatives of the tubes' numbers over one parameter, which are constant.

        Parameters
        ----------
        column : int
            Index of the parameter.

        Returns
        -------
        (d, 8) array
            Derivatives in the order of ``robot.structure.TUBE_NUMBER_NAMES``, each in its unit per unit of the
            parameter.
        """
        one = self.each[column]
        found = np.zeros((self.robot.d, len(TUBE_NUMBER_NAMES)))
        if one.kind == MODULUS_KIND:
            number = TUBE_NUMBER_NAMES.index("bending_stiffness")
            found[:, number] = self.robot.numbers[:, number]
        # Parts scale the nominal number, a length is added to it; a motor's zero is no number of a tube.
        scaled = {"curvature": ("root_curvature", "tip_curvature")}.get(one.kind, (one.kind,))
        for name in scaled if one.kind in DEVIATION_NAMES and one.kind != "motor_zero" else ():
            number = TUBE_NUMBER_NAMES.index(name)
            i = self.tube(column)
            found[i, number] = 1.0 if one.kind == "curved_length" else self.robot.numbers[i, number]
        return found

    def lag(self, values: Array) -> BacklashAndDrag:
        """Return the backlash and drag of the tubes for values (.., P)."""
        # Values of a fit may be below their bound 0 by rounding, which BacklashAndDrag refuses.
        return BacklashAndDrag(*(np.maximum(self.of_tubes(values, kind), 0.0) for kind in LAGS))

    def delay(self, values: Array) -> float:
        """Return the delay of the sensor, s, for values (P,)."""
        return float(sum(values[k] for k in self.columns(DELAY)))

    def tube(self, column: int) -> int:
        """Return the tube, from 0, that the parameter at index column belongs to."""
        number = self.each[column].number
        assert number is not None
        return number - 1


def default_kinds(robot: Robot, measured: Measurements, loaded: bool = False) -> tuple[str, ...]:
    """Choose the kinds of parameters that are estimated where none are named.

    Parameters
    ----------
    robot : Robot
        The nominal robot: whatever has a tolerance is estimated.
    measured : Measurements
        The observations: where their time is known, backlash, drag and the sensor's delay are estimated.
    loaded : bool
        Whether the robot is loaded: then the Young's modulus is estimated.

    Returns
    -------
    tuple of str
        Kinds of parameters.
    """
    bands = robot.tolerances.bands(robot.tubes)
    known = [name for name, band in zip(DEVIATION_NAMES, bands.T, strict=True) if band.any()]
    return (*known, *([MODULUS_KIND] * loaded), *((*LAGS, DELAY) if measured.has_times else ()))


def parameters_of(
    robot: Robot,
    measured: Measurements,
    kinds: Sequence[str] | None = None,
    registered: bool = False,
    loaded: bool = False,
) -> Parameters:
    """Build the parameters of some kinds, with prior mean and covariance from the robot's tolerances.

    Parameters
    ----------
    robot : Robot
        The nominal robot.
    measured : Measurements
        The observations.
    kinds : sequence of str, optional
        Of PARAMETER_KINDS; by default :func:`default_kinds`. One that is named and has no tolerance has the
        standard deviation of PRIOR_SIGMAS.
    registered : bool
        Whether the sensor's axes are those of the robot's base; otherwise the base's pose is estimated, too, in
        every recording.
    loaded : bool
        Whether the robot is loaded.

    Returns
    -------
    parameters : Parameters
        Without those that change no shape, such as the curvature of a straight tube.

    Raises
    ------
    OptionError
        A kind is unknown, not identifiable from such measurements, or nothing is left to be estimated.
    """
    asked = default_kinds(robot, measured, loaded) if kinds is None else tuple(dict.fromkeys(kinds))
    for kind in asked:
        if kind not in PARAMETER_KINDS:
            raise OptionError(f"{kind!r} cannot be estimated; choose from {', '.join(PARAMETER_KINDS)}")
        if kind in (*LAGS, DELAY) and not measured.has_times:
            raise OptionError(f"{kind} can be estimated from motions only, and the measurements have no time_s")
        if kind == MODULUS_KIND and not loaded:
            raise OptionError(
                f"{kind} can be estimated under a load only; give the tip force of every observation in N "
                "(columns force_x, force_y, force_z), or a load that acts in all of them"
            )
        if kind == OFFSET and not np.isfinite(measured.tip).any():
            raise OptionError(f"{OFFSET} needs measured tips; there are none")
    found = [one for kind in PARAMETER_KINDS if kind in asked for one in _of_kind(robot, kind, loaded)]
    if not registered:
        numbers = [None] if measured.recordings == 1 else list(range(1, measured.recordings + 1))
        found += [Parameter(kind, number, PRIOR_SIGMAS[kind]) for number in numbers for kind in BASE]
    if not found:
        raise OptionError("nothing to estimate: the robot has no tolerances; name the parameters to estimate")
    return Parameters(robot, tuple(found))


def _of_kind(robot: Robot, kind: str, loaded: bool) -> list[Parameter]:
    """Return the parameters of one kind, one for each tube or only one; loaded: whether the robot is loaded."""
    if kind in (DELAY, OFFSET):
        return [Parameter(kind, None, PRIOR_SIGMAS[kind])]
    if kind == MODULUS_KIND:
        return [Parameter(kind, None, PRIOR_SIGMAS[kind], low=MIN_REMAINING_PART - 1)]
    tubes = range(robot.d)
    if kind in LAGS:
        # A lag that is uniform in [0, L] has the root mean square L / sqrt(3). The prior mean is 0, so that
        # estimates are biased towards a robot without lag.
        known = robot.tolerances.max_backlash(robot.d) / math.sqrt(3) if kind == LAGS[0] else np.zeros(robot.d)
        return [Parameter(kind, i + 1, float(known[i]) or PRIOR_SIGMAS[kind], low=0.0) for i in tubes]
    sigmas = np.sqrt(
        np.diag(_covariance(robot)).reshape(robot.d, len(DEVIATION_NAMES))[:, DEVIATION_NAMES.index(kind)]
    )
    if not sigmas.any():
        sigmas = np.full(robot.d, PRIOR_SIGMAS[kind])
    chosen = [i for i in tubes if sigmas[i] > 0 and _shows(robot, kind, i, loaded)]
    return [Parameter(kind, i + 1, float(sigmas[i]), 0.0, *_range(robot, kind, i)) for i in chosen]


def _covariance(robot: Robot) -> Array:
    """Return the covariance (5d, 5d) of the differences of tubes by the robot's tolerances."""
    root = robot.tolerances.covariance_root(robot.tubes)
    return np.asarray(root @ root.T)


def _shows(robot: Robot, kind: str, i: int, loaded: bool) -> bool:
    """Return whether a number of tube i, from 0, can change any shape.

    A straight tube has no curvature, and the stiffness of a single tube matters only under a load.
    """
    if kind in ("curvature", "curved_length"):
        return robot.structure.kinds[i] != "straight"
    return kind == "motor_zero" or robot.d > 1 or loaded


def _range(robot: Robot, kind: str, i: int) -> tuple[float, float]:
    """Return the least and largest value of a parameter of tube i, from 0, for which the tube is valid."""
    tube = robot.tubes[i]
    if kind == "motor_zero":
        return -math.pi, math.pi
    if kind == "curved_length":
        return (MIN_REMAINING_PART - 1) * tube.curved_length, tube.length - tube.curved_length
    most = math.inf
    if kind == "curvature":
        most = (
            min(MAX_TUBE_CURVATURE_PER_MM, 2 * tube.pre_curvature_strain_limit / tube.outer_diameter)
            / tube.largest_curvature
            - 1
        )
    if kind == "torsional_ratio":
        most = MOST_RATIO / (1 + tube.poisson_ratio) - 1
    return MIN_REMAINING_PART - 1, most
