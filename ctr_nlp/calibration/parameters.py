"""What a calibration estimates: parameters by name, with what is known of each before anything is measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctr_nlp.calibration.measurements import Measurements
from ctr_nlp.exceptions import OptionError
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import LEAST
from ctr_nlp.robot.structure import NUMBERS, Structure
from ctr_nlp.robot.tolerances import NAMES
from ctr_nlp.robot.tube import CURVATURE, STRAIN_MADE
from ctr_nlp.simulation.lag import Lag
from ctr_nlp.typing import Array

LAGS = "rotation_lag", "lag_per_overlap", "drag"
"""Of every tube: play to either side, its growth with the overlap, and the time constant of viscous drag."""
MODULUS = "youngs_modulus"
"""Of all tubes alike, as a part of their own: how stiff they are together, which shows under loads alone."""
DELAY, OFFSET = "sensor_delay", "tip_offset"
BASE = "base_x", "base_y", "base_z", "base_turn_x", "base_turn_y", "base_roll"
"""Where the robot's base is for the sensor, in every recording: mm in the sensor's axes, rad about the base's."""
KINDS = (*NAMES, MODULUS, *LAGS, DELAY, OFFSET)
"""What may be asked for by name; the base's pose is estimated wherever it is unknown."""
UNITS = {
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
SIGMAS = {
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
"""Standard deviations before measuring, of what is asked for and has no tolerance in the robot's file."""
ROUNDING = 1e-9
"""What is added to variances, as a part of them, so that parameters known to be tied can be told apart."""
MOST_RATIO = 1.5
"""The largest torsional ratio, that of a Poisson's ratio of 0.5."""
WORDS = {"rotation_lag": "play", "lag_per_overlap": "play per mm of overlap", "base_roll": "roll of the base"}


@dataclass(frozen=True)
class Parameter:
    """One number: its kind, of which tube (from 1) or recording (from 1), and what is known of it beforehand.

    mean, sigma, low, high: in unit; parts are parts of the robot's own number.
    """

    kind: str
    number: int | None
    sigma: float
    mean: float = 0.0
    low: float = -math.inf
    high: float = math.inf

    @property
    def unit(self) -> str:
        """Of its value."""
        return UNITS[self.kind]

    @property
    def name(self) -> str:
        """In tables and files, such as curvature_2."""
        return self.kind if self.number is None else f"{self.kind}_{self.number}"

    @property
    def words(self) -> str:
        """In a sentence."""
        said = WORDS.get(self.kind, self.kind.replace("_", " "))
        whose = "recording" if self.kind in BASE else "tube"
        return said if self.number is None else f"{said} of {whose} {self.number}"


@dataclass(frozen=True)
class Parameters:
    """The parameters of a robot that are estimated; columns of values (n, P) are theirs, in order."""

    robot: Robot
    each: tuple[Parameter, ...]

    def __len__(self) -> int:
        return len(self.each)

    @property
    def names(self) -> list[str]:
        """Of each."""
        return [one.name for one in self.each]

    @cached_property
    def mean(self) -> Array:
        """Before measuring, (P,)."""
        return np.array([one.mean for one in self.each])

    @cached_property
    def sigma(self) -> Array:
        """Standard deviations before measuring, (P,)."""
        return np.array([one.sigma for one in self.each])

    @cached_property
    def covariance(self) -> Array:
        """Before measuring, (P, P): with the correlations of tubes' parts that the robot's tolerances may tell."""
        found, all_parts = np.diag(self.sigma**2), _covariance(self.robot)
        columns = self.columns(*NAMES)
        places = [len(NAMES) * self.tube(k) + NAMES.index(self.each[k].kind) for k in columns]
        for k, row in zip(columns, places, strict=True):
            for j, column in zip(columns, places, strict=True):
                if j != k:
                    found[k, j] = all_parts[row, column]
        return found

    @cached_property
    def whitened(self) -> Array:
        """A matrix (P, P) that makes of differences from the mean independent ones of variance 1."""
        scaled = self.covariance / np.outer(self.sigma, self.sigma)
        root = np.linalg.cholesky(scaled + ROUNDING * np.eye(len(self)))
        return np.asarray(np.linalg.inv(root) / self.sigma)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Least and largest values, (P,) each."""
        return np.array([one.low for one in self.each]), np.array([one.high for one in self.each])

    @cached_property
    def structure(self) -> Structure:
        """Of robots of any values: where lengths are estimated, any transmission may show."""
        found = self.robot.structure
        if any(one.kind == "curved_length" for one in self.each):
            return Structure(found.kinds, (True,) * found.d, found.gap)
        return found

    def columns(self, *kinds: str) -> list[int]:
        """Where parameters of some kinds stand."""
        return [k for k, one in enumerate(self.each) if one.kind in kinds]

    def of_tubes(self, values: Array, kind: str) -> Array:
        """One kind's values (.., d) of all tubes; 0 where they are not estimated."""
        found = np.zeros((*values.shape[:-1], self.robot.d))
        for k in self.columns(kind):
            found[..., self.tube(k)] = values[..., k]
        return found

    def parts(self, values: Array) -> Array:
        """By how much tubes differ from the robot's (.., d, 5), in the order of robot.tolerances.NAMES."""
        found = np.stack([self.of_tubes(values, name) for name in NAMES], axis=-1)
        for k in self.columns(MODULUS):
            found[..., NAMES.index("bending_stiffness")] += values[..., k, None]
        return found

    @property
    def parts_over(self) -> Array:
        """How these parts, (5 d,) tube by tube, grow with every parameter, (5 d, P)."""
        return np.stack([self.parts(unit).ravel() for unit in np.eye(len(self))], axis=1)

    def numbers_over(self, column: int) -> Array:
        """How the tubes' numbers (d, 8), in the order of NUMBERS, grow with a parameter."""
        one, found = self.each[column], np.zeros((self.robot.d, len(NUMBERS)))
        if one.kind == MODULUS:
            number = NUMBERS.index("bending_stiffness")
            found[:, number] = self.robot.numbers[:, number]
        scaled = {"curvature": ("root_curvature", "tip_curvature")}.get(one.kind, (one.kind,))
        for name in scaled if one.kind in NAMES and one.kind != "motor_zero" else ():
            number, i = NUMBERS.index(name), self.tube(column)
            found[i, number] = 1.0 if one.kind == "curved_length" else self.robot.numbers[i, number]
        return found

    def lag(self, values: Array) -> Lag:
        """The lag of tubes of values (.., P)."""
        return Lag(*(np.maximum(self.of_tubes(values, kind), 0.0) for kind in LAGS))

    def delay(self, values: Array) -> float:
        """The sensor's, s, of values (P,)."""
        return float(sum(values[k] for k in self.columns(DELAY)))

    def tube(self, column: int) -> int:
        """Of which tube a parameter is, from 0."""
        number = self.each[column].number
        assert number is not None
        return number - 1


def default_kinds(robot: Robot, measured: Measurements, bears: bool = False) -> tuple[str, ...]:
    """What is estimated where nothing is named: what has a tolerance, under a load the modulus, and where time is
    known lag and delay.
    """
    bands = robot.tolerances.bands(robot.tubes)
    known = [name for name, band in zip(NAMES, bands.T, strict=True) if band.any()]
    return (*known, *([MODULUS] * bears), *((*LAGS, DELAY) if measured.timed else ()))


def parameters_of(
    robot: Robot,
    measured: Measurements,
    kinds: Sequence[str] | None = None,
    registered: bool = False,
    bears: bool = False,
) -> Parameters:
    """The parameters of some kinds, with priors from the robot's tolerances; raises OptionError.

    A kind that is named and has no tolerance is known to within SIGMAS. registered: whether the sensor's axes are
    the base's. bears: whether the robot bears a load.
    """
    asked = default_kinds(robot, measured, bears) if kinds is None else tuple(dict.fromkeys(kinds))
    for kind in asked:
        if kind not in KINDS:
            raise OptionError(f"{kind!r} cannot be estimated; choose from {', '.join(KINDS)}")
        if kind in (*LAGS, DELAY) and not measured.timed:
            raise OptionError(f"{kind} shows in motions alone; the measurements have no time_s")
        if kind == MODULUS and not bears:
            raise OptionError(
                f"{kind} shows under loads alone; give the force at the tip in every observation, in N, as "
                "force_x, force_y and force_z, or a load that the robot bears in all"
            )
        if kind == OFFSET and not np.isfinite(measured.tip).any():
            raise OptionError(f"{OFFSET} needs measured tips; there are none")
    found = [one for kind in KINDS if kind in asked for one in _of_kind(robot, kind, bears)]
    if not registered:
        numbers = [None] if measured.recordings == 1 else list(range(1, measured.recordings + 1))
        found += [Parameter(kind, number, SIGMAS[kind]) for number in numbers for kind in BASE]
    if not found:
        raise OptionError("nothing is to be estimated: the robot has no tolerances; name what is to be estimated")
    return Parameters(robot, tuple(found))


def _of_kind(robot: Robot, kind: str, bears: bool) -> list[Parameter]:
    if kind in (DELAY, OFFSET):
        return [Parameter(kind, None, SIGMAS[kind])]
    if kind == MODULUS:
        return [Parameter(kind, None, SIGMAS[kind], low=LEAST - 1)]
    tubes = range(robot.d)
    if kind in LAGS:
        known = robot.tolerances.lags(robot.d) / math.sqrt(3) if kind == LAGS[0] else np.zeros(robot.d)
        return [Parameter(kind, i + 1, float(known[i]) or SIGMAS[kind], low=0.0) for i in tubes]
    sigmas = np.sqrt(np.diag(_covariance(robot)).reshape(robot.d, len(NAMES))[:, NAMES.index(kind)])
    if not sigmas.any():
        sigmas = np.full(robot.d, SIGMAS[kind])
    chosen = [i for i in tubes if sigmas[i] > 0 and _shows(robot, kind, i, bears)]
    return [Parameter(kind, i + 1, float(sigmas[i]), 0.0, *_range(robot, kind, i)) for i in chosen]


def _covariance(robot: Robot) -> Array:
    root = robot.tolerances.root(robot.tubes)
    return np.asarray(root @ root.T)


def _shows(robot: Robot, kind: str, i: int, bears: bool) -> bool:
    """Whether a number of a tube can change any shape: a straight one has no curvature, one tube no ratios, whose
    stiffness shows under a load alone.
    """
    if kind in ("curvature", "curved_length"):
        return robot.structure.kinds[i] != "straight"
    return kind == "motor_zero" or robot.d > 1 or bears


def _range(robot: Robot, kind: str, i: int) -> tuple[float, float]:
    """Least and largest value: beyond them no tube can be described."""
    tube = robot.tubes[i]
    if kind == "motor_zero":
        return -math.pi, math.pi
    if kind == "curved_length":
        return (LEAST - 1) * tube.curved_length, tube.length - tube.curved_length
    most = math.inf
    if kind == "curvature":
        most = min(CURVATURE, 2 * STRAIN_MADE / tube.outer_diameter) / tube.largest_curvature - 1
    if kind == "torsional_ratio":
        most = MOST_RATIO / (1 + tube.poisson_ratio) - 1
    return LEAST - 1, most
