"""Forces on a robot from its measured shape: at the tip, at a place along the body, or both.

The shape y of a robot at known motors q is measured with noise of standard deviation sigma in every coordinate.
With h(F, G, s, u) the shape of the elastic robot under a force F at the tip and a force G at arc length s, and
with deviations R u of its tubes (R R^T their covariance, from the robot's tolerances), the estimate is the
posterior (Gelman et al., Bayesian Data Analysis, 2013) of

    y = h(F, G, s, u) + noise,   u normal with variance 1,

under a prior that says: no force, one at the tip, one along the body and both are equally probable; a place is
uniform along the body; a force has any direction, and its components are normal with a deviation
FORCE_SCALES_N[k], all up to COMMON_FORCE_SCALE_N equally probable: forces are mostly 0.05 to 0.3 N, and large ones
are rare, but possible.

An explanation is one of the four kinds, for a force along the body with a piece of the robot near which it acts.
For each, h is linearised at the posterior's mode, so that posterior and evidence are those of normal
distributions. The reported forces are means over all explanations, weighted by their evidence, with the covariance
within and between them: a force is not more certain than that it acts at all. Under the prior, as far as shapes
are linear in the forces, errors over reported deviations have the mean square 1, whatever kind is reported.

What is reported is the simplest kind that is not refuted, by a test with a known rate of false alarms: a force is
added only where it lowers the sum of squares by more than chance does (likelihood ratio, FALSE_ALARM_RATE), and
what remains must be as small as noise makes it. Where one force is enough and either place is possible, the more
probable one is reported. So a contact at mid-body is not reported as a force at the tip.

Forces are dead loads in the axes of the base. Rucker and Webster, Deflection-based force sensing for continuum
robots, IROS 2011, estimate forces at the tip in this way from a measured tip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from ctr_nlp.exceptions import MeasurementError
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.loads.rod_pieces import kind_with_pieces, piece_positions, unloaded_state
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.model import curves
from ctr_nlp.models.loads import Load, check_moduli
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import perturb_robot
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.support.value_checks import check_instance, number
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Index

NO_FORCE, TIP, BODY, TIP_AND_BODY, UNEXPLAINED = "none", "tip", "body", "tip and body", "unexplained"
"""What explains a measured shape. UNEXPLAINED: no force at the tip and at one place along the body does."""
DEFAULT_NOISE_MM, DEFAULT_DIRECTION_NOISE_RAD = 0.3, 0.02
"""Default standard deviations of a measured coordinate, mm, and of a direction, rad: electromagnetic trackers."""
FALSE_ALARM_RATE = 0.01
"""Probability with which a force is reported, or added, that does not act."""
DETECTION_RATE = 0.95
"""Probability with which the least detectable force is noticed."""
UNEXPLAINED_RATE = 1e-3
"""Probability of a misfit as large as the one found, below which no explanation is accepted."""
MAX_FIT_ITERATIONS, FIT_TOLERANCE = 30, 1e-4
"""Most Levenberg-Marquardt steps, and the decrease of the sum of squares below which they end."""
FIRST_DAMPING, MAX_DAMPING = 1e-3, 1e8
"""Damping of the first step, relative to the diagonal of the normal equations, and the largest that is tried."""
STEPS = {"force": 1e-4, "place": 0.2, "deviation": 1e-3}
"""Steps of finite differences: N, mm, and parts of a standard deviation."""
MAX_FORCE_STEP_N = 0.2
"""Largest change of a force in one step, N."""
MIN_CURVATURE = 1e-9
"""Replaces 0 in denominators and on the diagonal of the normal equations."""
FORCE_SCALES_N = np.array([0.05, 0.1, 0.2, 0.4, 0.8])
"""Standard deviations of the components of a force beforehand, N: from touching tissue to pulling a tool."""
COMMON_FORCE_SCALE_N = 0.1
"""Scale of common forces, 0.05 to 0.3 N, whose components have 0.11 N on the whole."""
FORCE_SCALE_PROBABILITIES = np.minimum(1.0, COMMON_FORCE_SCALE_N / FORCE_SCALES_N) ** 3
FORCE_SCALE_PROBABILITIES /= FORCE_SCALE_PROBABILITIES.sum()
"""Probabilities of the scales: alike up to the common one, then falling with the cube, so that a force of 1 N is
rare, but possible. A component has 0.1 N on the whole."""
FITTED_FORCE_SCALE_N = 0.2
"""Standard deviation with which the mode is found at which shapes are linearised, N."""
PLACE_DEVIATION_PIECES = 0.5
"""Standard deviation of a place around the middle of a piece, in lengths of it: the sum over pieces is uniform."""
FORCE_UNKNOWNS = {NO_FORCE: 0, TIP: 3, BODY: 4, TIP_AND_BODY: 7}
"""Number of unknowns of each kind of explanation."""
PLACE_INDEX, FORCE_COUNT = 6, 7
"""Index of the place among the unknowns, and number of those of forces and place."""
NO_LENGTH_MM = 1e-9
"""Length of a piece below which no force is looked for on it."""


@dataclass(frozen=True, eq=False)
class ForceEstimate(ReadOnlyValue):
    """Forces on a robot, estimated from one measured shape.

    Attributes
    ----------
    kind : str
        ``"none"``, ``"tip"``, ``"body"``, ``"tip and body"``, or ``"unexplained"`` where no force at the tip and
        at one place along the body explains the shape: then the forces are not to be trusted.
    weights : dict of float
        Probability of each explanation, given that one of them is right.
    force : (3,) array
        Force at the tip in the axes of the base, N: its mean over all explanations, so that it is near 0 where
        the force acts along the body.
    force_covariance : (3, 3) array
        Its covariance, N^2: of the sensor's noise, the robot's tolerances, and the doubt about what acts.
    body_force : (3,) array
        Force along the body, N: its mean over all explanations, so that it is near 0 where none acts.
    body_covariance : (3, 3) array
        Its covariance, N^2.
    place, place_deviation : float
        Arc length from the insertion point at which it acts, if it does, and its standard deviation, mm; NaN where
        ``kind`` has none.
    probability : float
        Probability of a misfit at least as large, if the explanation is right.
    least_tip_force : float
        Least force at the tip that this robot and sensor detect in 95 of 100 cases, N, in its worst direction.
    places : (K,) array
        Arc lengths, mm, at which the next is known.
    least_body_forces : (K,) array
        Least force across the body at these places, in its worst direction, that is told from a force at the tip
        in 95 of 100 cases, N.
    body_information : (K, 3, 3) array
        Information on a force along the body at these places beside a force at the tip, 1/N^2:
        :meth:`least_body_force` has what it says of one direction.
    """

    kind: str
    weights: dict[str, float]
    force: Array
    force_covariance: Array
    body_force: Array
    body_covariance: Array
    place: float
    place_deviation: float
    probability: float
    least_tip_force: float
    places: Array
    least_body_forces: Array
    body_information: Array

    def least_body_force(self, place: float, direction: Array) -> float:
        """Return the least force in one direction that is told from a force at the tip in 95 of 100 cases.

        Parameters
        ----------
        place : float
            Arc length from the insertion point, mm.
        direction : (3,) array
            Direction of the force in the axes of the base, of any length > 0.

        Returns
        -------
        float
            The force, N.

        Raises
        ------
        MeasurementError
            The direction has no length.
        """
        size = float(np.linalg.norm(direction))
        if not 0 < size < math.inf:
            raise MeasurementError(f"direction is {direction}; it must be three finite numbers that are not all 0")
        unit = np.asarray(direction) / size
        information = np.array([unit @ each @ unit for each in self.body_information])
        return _least_force(float(np.interp(place, self.places, information)), len(self.places))

    @property
    def deviations(self) -> Array:
        """Standard deviations (3,) of the force at the tip, N."""
        return np.asarray(np.sqrt(np.diag(self.force_covariance)))

    @property
    def body_deviations(self) -> Array:
        """Standard deviations (3,) of the force along the body, N."""
        return np.asarray(np.sqrt(np.diag(self.body_covariance)))

    def __str__(self) -> str:
        """Say what acts, how large it is and where."""
        told = {
            NO_FORCE: f"no force is detected (at the tip, {self.least_tip_force:.3g} N would be)",
            TIP: f"at the tip {_with_deviation(self.force, self.deviations)}",
            BODY: f"along the body, {self._where}, {_with_deviation(self.body_force, self.body_deviations)}",
            UNEXPLAINED: "something pushes elsewhere, or the robot or its sensor is not as described: no force at "
            "the tip and at one place along the body explains the shape",
        }
        told[TIP_AND_BODY] = f"{told[TIP]}; {told[BODY]}"
        others = {
            TIP: ("along the body", self.weights[BODY] + self.weights[TIP_AND_BODY]),
            BODY: ("at the tip", self.weights[TIP] + self.weights[TIP_AND_BODY]),
        }
        if self.kind in others:
            where, probability = others[self.kind]
            if probability > FALSE_ALARM_RATE:
                told[self.kind] += f" (with probability {probability:.0%} a force acts {where}, too, or instead)"
        return told[self.kind]

    @property
    def _where(self) -> str:
        return f"at {self.place:.0f} ± {self.place_deviation:.0f} mm"


def _with_deviation(force: Array, deviations: Array) -> str:
    """Write a force with its standard deviations, N."""
    each = ", ".join(f"{value:.3f} ± {deviation:.3f}" for value, deviation in zip(force, deviations, strict=True))
    return f"({each}) N"


def estimate_forces(
    robot: Robot,
    measured: Measurements,
    noise: float = DEFAULT_NOISE_MM,
    direction_noise: float = DEFAULT_DIRECTION_NOISE_RAD,
) -> list[ForceEstimate]:
    """Estimate the forces on a robot from measured shapes, and say where they act.

    Parameters
    ----------
    robot : Robot
        The robot; its Young's moduli must be in MPa. Its tolerances say how well its tubes and motors' zeros are
        known: a robot that was calibrated (:func:`calibrate`) has smaller ones.
    measured : Measurements
        T observations at known configurations, in the axes of the robot's base: points along the body, the tip or
        its direction. Forces that are known to act, such as hanging weights, are taken off.
    noise : float
        Standard deviation of each measured coordinate, mm.
    direction_noise : float
        Standard deviation of a measured direction, rad.

    Returns
    -------
    list of ForceEstimate
        One for each observation.

    Raises
    ------
    LoadError
        A tube has no Young's modulus in MPa.
    MeasurementError
        A value is out of range, an observation has too few measured values for the forces that are sought, or the
        robot has no equilibrium at a configuration.

    Examples
    --------
    A straight rod of 100 mm, of which a force of 0.1 N moves the tip by 2.8 mm:

    >>> import ctr_nlp as ctr
    >>> rod = ctr.Robot((ctr.Tube(200, 150, 0.0, 1.5, 1.0, youngs_modulus=60_000),))
    >>> sigma = np.linspace(0.1, 1.0, 10)
    >>> bent = np.stack([0.1 * (100 * sigma) ** 2 * (300 - 100 * sigma) / (6 * 60_000 * 0.1994), 0 * sigma,
    ...     100 * sigma], axis=1)
    >>> measured = Measurements(np.array([[0, 100, 0, 0]]), np.full((1, 3), np.nan), np.full((1, 3), np.nan),
    ...     bent[None], sigma[None], np.full(1, np.nan), np.zeros(1, dtype=int))
    >>> found, = estimate_forces(rod, measured, noise=0.05)
    >>> found.kind, found.force.round(1).tolist()[0]
    ('tip', 0.1)
    """
    check_instance(MeasurementError, "robot", robot, Robot)
    check_instance(MeasurementError, "measured", measured, Measurements)
    check_moduli(robot)
    for name, value, unit in ("noise", noise, " mm"), ("direction_noise", direction_noise, " rad"):
        number(MeasurementError, name, value, lambda x: 0 < x < math.inf, "be a finite number > 0", unit)
    described = _RobotInDoubt(robot)
    return [
        _Observation(described, measured, j, float(noise), float(direction_noise)).explain()
        for j in range(len(measured))
    ]


class _RobotInDoubt:
    """A robot whose tubes deviate by R u within its tolerances, and the solver of its loaded equilibria."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        root = robot.tolerances.covariance_root(robot.tubes)
        self.root = root[:, abs(root).max(axis=0) > 0]
        # The structure of all robots within the tolerances: where a curved part may be shorter, the straight part
        # behind it may come out.
        extreme = np.zeros((1, robot.d, len(DEVIATION_NAMES)))
        curved = DEVIATION_NAMES.index("curved_length")
        extreme[..., curved] = -3 * np.sqrt((root**2).sum(axis=1).reshape(robot.d, -1)[:, curved])
        self.structure = perturb_robot(robot, extreme, np.zeros((1, robot.d))).structure
        self.kind = kind_with_pieces(Load(), robot.d)
        self.equilibria = LoadedEquilibria(self.structure, self.kind)


class _Observation:
    """One measured shape, and the robot that it is compared with."""

    def __init__(
        self, described: _RobotInDoubt, measured: Measurements, j: int, noise: float, direction_noise: float
    ) -> None:
        robot = self.robot = described.robot
        self.root, self.structure = described.root, described.structure
        self.kind, self.equilibria = described.kind, described.equilibria
        self.q = measured.q[j].astype(float)
        points = np.isfinite(measured.points[j]) & np.isfinite(measured.sigma[j])[:, None]
        tip, direction = (np.isfinite(each[j]).all() for each in (measured.tip, measured.direction))
        self.sigma = np.append(measured.sigma[j][points.any(axis=1)], 1.0)
        self.used = np.concatenate([points[points.any(axis=1)].ravel(), np.full(3, tip), np.full(3, direction)])
        values = np.concatenate(
            [measured.points[j][points.any(axis=1)].ravel(), measured.tip[j], measured.direction[j]]
        )
        scale = np.full(len(values), noise)
        scale[-3:] = direction_noise
        self.values, self.scale = values[self.used], scale[self.used]
        if len(self.values) < 3:
            raise MeasurementError(
                f"observation {j + 1} has {len(self.values)} measured values; a force needs at least 3"
            )
        self.known_force = measured.force[j]
        (self.middles,), (self.lengths,) = piece_positions(robot, self.kind, robot.split(self.q[None])[1])
        self.start = unloaded_state(self.equilibria, robot, self.q[None])
        if not np.isfinite(self.start.determinant).all():
            raise MeasurementError(f"the robot has no equilibrium at the configuration of observation {j + 1}")

    @cached_property
    def place_range(self) -> Array:
        """Least and largest arc length (2,) at which a force along the body is looked for, mm."""
        return self.middles[self.useful[[0, -1]]]

    @cached_property
    def useful(self) -> Index:
        """Indices of the pieces on which a force is looked for: those that have a length."""
        return np.flatnonzero(self.lengths > NO_LENGTH_MM)

    def loads(self, tip: Array, body: Array, place: Array) -> Array:
        """Return load numbers (n, l) of forces tip, body (n, 3), N, the latter at place (n,), mm.

        What is known to act is added to them.
        """
        fixed = np.zeros((len(tip), Load().numbers(self.robot.d).size))
        fixed[:, :3] = tip + self.known_force
        return np.hstack([fixed, self.pushes(body, place)])

    def pushes(self, body: Array, place: Array) -> Array:
        """Return the numbers (n, 6K), N/mm, of forces on the pieces, of forces body (n, 3), N, at place (n,), mm.

        Each is constant along its piece. A force acts on the two pieces around its place, shared so that its
        centroid is there.
        """
        rows = len(body)
        pushes = np.zeros((rows, len(self.lengths), 2, 3))
        middles, lengths = self.middles[self.useful], self.lengths[self.useful]
        right = np.clip(np.searchsorted(middles, place), 1, len(middles) - 1)
        part = np.clip((place - middles[right - 1]) / (middles[right] - middles[right - 1]), 0.0, 1.0)
        for at, share in ((right - 1, 1 - part), (right, part)):
            pushes[np.arange(rows), self.useful[at], 0] += (share / lengths[at])[:, None] * body
        return pushes.reshape(rows, -1)

    def predict(self, states: States, tip: Array, body: Array, place: Array, u: Array) -> tuple[Array, States]:
        """Return the measured values (n, m) that forces and deviations u (n, r) lead to, and the equilibria.

        states: n equilibria from which the branches are followed. NaN where a branch ends before.
        """
        deviations = (u @ self.root.T).reshape(len(u), self.robot.d, -1)
        samples = perturb_robot(self.robot, deviations, np.zeros((len(u), self.robot.d)))
        q = np.tile(self.q, (len(u), 1))
        q[:, : self.robot.d] += samples.offsets
        there, done = self.equilibria.follow_branches(
            states, q, self.loads(tip, body, place), numbers=samples.numbers
        )
        return np.where(done[:, None] == 1, self.values_of(there), np.nan), there

    def values_of(self, states: States) -> Array:
        """Return the values (n, m) that the sensor would measure, without noise, of n equilibria."""
        points, tangents = self.curves_of(states, self.sigma)
        return np.concatenate([points.reshape(len(points), -1), tangents[:, -1]], axis=1)[:, self.used]

    def curves_of(self, states: States, sigma: Array) -> tuple[Array, Array]:
        """Return points, mm, and unit tangents (n, k, 3) of n equilibria at sigma (k,)."""
        return curves(self.structure, states.numbers, states.load, states.unknowns, sigma, self.kind)

    def explain(self) -> ForceEstimate:
        """Compare the explanations, and return the simplest one that is not refuted."""
        explanations = self.explanations
        fits = _Fits(self, explanations).run()
        best = {
            kind: int(
                np.flatnonzero(explanations.kinds == kind)[np.argmin(fits.misfit[explanations.kinds == kind])]
            )
            for kind in (NO_FORCE, TIP, BODY, TIP_AND_BODY)
        }
        found = fits.average()
        kind = self.choose({name: float(fits.misfit[row]) for name, row in best.items()}, found.weights)
        freedom = len(self.values) - FORCE_UNKNOWNS[kind]
        probability = float(chi2.sf(fits.misfit[best[kind]], max(freedom, 1)))
        if probability <= UNEXPLAINED_RATE:
            kind = UNEXPLAINED
        least_tip, information, least_body = self.least_detectable(fits, best[TIP])
        placed = kind in (BODY, TIP_AND_BODY)
        return ForceEstimate(
            kind=kind,
            weights=found.weights,
            force=found.mean[:3],
            force_covariance=found.covariance[:3, :3],
            body_force=found.mean[3:],
            body_covariance=found.covariance[3:, 3:],
            place=found.place if placed else math.nan,
            place_deviation=found.place_deviation if placed else math.nan,
            probability=probability,
            least_tip_force=least_tip,
            places=self.middles[self.useful],
            least_body_forces=least_body,
            body_information=information,
        )

    @cached_property
    def explanations(self) -> _Explanations:
        """All explanations: of forces along the body one for each piece."""
        places, lengths = self.middles[self.useful], self.lengths[self.useful]
        count = len(places)
        kinds = np.array([NO_FORCE, TIP] + [BODY] * count + [TIP_AND_BODY] * count)
        share = lengths / lengths.sum()
        return _Explanations(
            kinds=kinds,
            probability=np.concatenate([[1.0, 1.0], share, share]) / 4,
            place=np.concatenate([[0.0, 0.0], places, places]),
            place_deviation=PLACE_DEVIATION_PIECES * np.concatenate([[1.0, 1.0], lengths, lengths]),
        )

    def choose(self, misfit: dict[str, float], weights: dict[str, float]) -> str:
        """Return the kind of the simplest explanation to which no further force is worth adding.

        misfit: least sum of squares of each kind. weights: probabilities of the kinds, which decide between a
        force at the tip and one along the body where either is enough.
        """

        def worth(simple: str, full: str, freedom: int, tried: int = 1) -> bool:
            # Of many places the best is taken, which chance favours: the rate is shared between them (Bonferroni).
            bound = chi2.isf(FALSE_ALARM_RATE / tried, freedom)
            return bool(misfit[simple] - misfit[full] > bound)

        places = len(self.useful)
        if (
            not worth(NO_FORCE, TIP, 3)
            and not worth(NO_FORCE, BODY, 3, places)
            and not worth(NO_FORCE, TIP_AND_BODY, 6, places)
        ):
            return NO_FORCE
        enough = [TIP] if not worth(TIP, TIP_AND_BODY, 3, places) else []
        enough += [BODY] if not worth(BODY, TIP_AND_BODY, 3) else []
        return max(enough, key=lambda kind: weights[kind], default=TIP_AND_BODY)

    def body_slopes(self, states: States, values: Array) -> Array:
        """Return derivatives (K, 3, m) of the weighted values over a force on each piece, at an equilibrium.

        states: of one row. values (m,): that it has.
        """
        count = len(self.useful)
        rows = 3 * count
        place = np.repeat(self.middles[self.useful], 3)
        probes = np.tile(np.eye(3), (count, 1)) * STEPS["force"]
        many = states.rows(np.zeros(rows, dtype=int))
        # The fit keeps the forces that it has; the probe is added.
        at = many.load.copy()
        at[:, at.shape[1] - 6 * len(self.lengths) :] += self.pushes(probes, place)
        there, done = self.equilibria.follow_branches(many, many.q, at)
        change = (self.values_of(there) - values) / STEPS["force"]
        slopes = np.where(done[:, None] == 1, change, 0.0) / self.scale
        return np.asarray(slopes.reshape(count, 3, -1))

    def least_detectable(self, fits: _Fits, tip: int) -> tuple[float, Array, Array]:
        """Return the least force at the tip that is noticed with DETECTION_RATE, N, and what is known at K places.

        That is the information (K, 3, 3), 1/N^2, on a force there beside what else is unknown, and the least force
        (K,), N, across the body. tip: number of the explanation by a force at the tip. A force F n lowers the sum
        of squares by F^2 n' I n in the mean: this is compared with the noncentrality at which the likelihood ratio
        test has that power.
        """
        deviations = self.root.shape[1]
        # Deviations of the tubes are known beforehand as if they were measured, too.
        known = np.zeros((3 + deviations, deviations))
        known[3:] = np.eye(deviations)
        slopes = np.hstack([fits.slopes[tip][[0, 1, 2, *range(FORCE_COUNT, FORCE_COUNT + deviations)]], known])
        states = fits.states.rows(slice(tip, tip + 1))
        free = slopes[:3] - slopes[:3] @ _projector(slopes[3:])
        tangents = self.tangents_at(states)
        # Across the body only: what pushes along it hardly bends it.
        across = np.linalg.svd(tangents[-1:])[2][1:]
        least = float(np.linalg.eigvalsh(across @ free @ free.T @ across.T)[0])
        inside = _projector(slopes)
        body = self.body_slopes(states, fits.values[tip])
        body = np.concatenate([body, np.zeros((*body.shape[:2], deviations))], axis=2)
        free = body - body @ inside
        information = free @ np.swapaxes(free, 1, 2)
        found = []
        for each, tangent in zip(information, tangents, strict=True):
            across = np.linalg.svd(tangent[None])[2][1:]
            found.append(_least_force(float(np.linalg.eigvalsh(across @ each @ across.T)[0]), len(self.useful)))
        return _least_force(least), information, np.array(found)

    def tangents_at(self, states: States) -> Array:
        """Return the unit tangents (K, 3) of a robot at the middles of its pieces; states: of one row."""
        sigma = self.middles[self.useful] / self.robot.split(self.q[None])[1][0, -1]
        return self.curves_of(states, sigma)[1][0]


def _least_force(information: float, places: int = 1) -> float:
    """Return the least force, N, that is noticed with DETECTION_RATE; information: on its size, 1/N^2.

    places: number of places among which the best is taken, which chance favours.
    """
    return math.sqrt(_noncentrality(3, FALSE_ALARM_RATE / places) / max(information, 1e-300))


def _projector(rows: Array) -> Array:
    """Return the projector (n, n) onto the span of rows (k, n)."""
    if not len(rows):
        return np.zeros((rows.shape[1], rows.shape[1]))
    return np.asarray(np.linalg.pinv(rows) @ rows)


def _noncentrality(freedom: int, rate: float) -> float:
    """Return the noncentrality at which a chi-square test of a false alarm rate has DETECTION_RATE."""
    bound = chi2.isf(rate, freedom)
    return float(brentq(lambda x: ncx2.sf(bound, freedom, x) - DETECTION_RATE, 1e-6, 1e4))


class _Explanations(NamedTuple):
    """H explanations of a shape.

    kinds (H,). probability (H,): beforehand. place, place_deviation (H,): mean and standard deviation, mm,
    beforehand, of the place of a force along the body.
    """

    kinds: Any
    probability: Array
    place: Array
    place_deviation: Array


class _Posterior(NamedTuple):
    """Mean (6,) and covariance (6, 6) of the forces at the tip and along the body, N, over all explanations.

    place, place_deviation: mm, of the latter if it acts. weights: probabilities of the kinds.
    """

    mean: Array
    covariance: Array
    place: float
    place_deviation: float
    weights: dict[str, float]


class _Fits:
    """Fits of all explanations to an observation, in one batch; `run` makes them.

    z (H, 7 + r): force at the tip, force along the body, N, place, mm, and deviations of the tubes; 0 for what an
    explanation does not have. states: the equilibria. values (H, m): predicted. residual (H, m), slopes (H, 7 + r,
    m): over the noise, and their derivatives. misfit (H,): sum of squares of residuals and deviations.
    """

    def __init__(self, of: _Observation, explanations: _Explanations) -> None:
        self.of, self.explanations = of, explanations
        count, deviations = len(explanations.kinds), of.root.shape[1]
        tip, body = ((explanations.kinds == kind) | (explanations.kinds == TIP_AND_BODY) for kind in (TIP, BODY))
        self.present = np.column_stack(
            [np.repeat(tip[:, None], 3, axis=1), np.repeat(body[:, None], 4, axis=1), np.ones((count, deviations))]
        ).astype(bool)
        self.before = np.zeros((count, FORCE_COUNT + deviations))
        self.before[:, PLACE_INDEX] = np.where(body, explanations.place, 0.0)
        self.z = self.before.copy()
        self.steps = np.array(
            [STEPS["force"]] * PLACE_INDEX + [STEPS["place"]] + [STEPS["deviation"]] * deviations
        )
        self.states = of.start.rows(np.zeros(count, dtype=int))
        self.values, self.states = of.predict(self.states, *self._split(self.z))
        self.residual = (self.values - of.values) / of.scale
        self.slopes = np.zeros((count, FORCE_COUNT + deviations, len(of.values)))

    def _split(self, z: Array) -> tuple[Array, Array, Array, Array]:
        """Split unknowns z (n, 7 + r) into tip, body (n, 3), place (n,) and deviations u (n, r)."""
        return z[:, :3], z[:, 3:PLACE_INDEX], z[:, PLACE_INDEX], z[:, FORCE_COUNT:]

    def _certainty(self, tip_scale: float, body_scale: float) -> Array:
        """Return one over the variances (H, 7 + r) of the unknowns beforehand; scales: of the forces, N.

        1 for what an explanation does not have.
        """
        count = len(self.z)
        forces = np.repeat([[tip_scale] * 3 + [body_scale] * 3], count, axis=0)
        others = np.ones((count, self.z.shape[1] - FORCE_COUNT))
        deviations = np.column_stack([forces, self.explanations.place_deviation, others])
        return np.asarray(np.where(self.present, deviations, 1.0) ** -2)

    def run(self) -> _Fits:
        """Find the mode of each explanation by Levenberg's and Marquardt's method."""
        certainty = self._certainty(FITTED_FORCE_SCALE_N, FITTED_FORCE_SCALE_N)
        cost = self._cost(self.z, self.residual, certainty)
        damping = np.full(len(self.z), FIRST_DAMPING)
        stale = np.ones(len(self.z), dtype=bool)
        searched = np.arange(len(self.z))
        for _ in range(MAX_FIT_ITERATIONS):
            if (again := searched[stale[searched]]).size:
                self.slopes[again] = self._slopes(again)
            tried = self._step(searched, certainty, damping[searched])
            values, states = self.of.predict(self.states.rows(searched), *self._split(tried))
            residual = (values - self.of.values) / self.of.scale
            # NaN, where the branch of equilibria ends on the way, is no gain.
            after = self._cost(tried, residual, certainty[searched], searched)
            gained = cost[searched] - after
            better = gained > 0
            rows = searched[better]
            self.z[rows], self.values[rows], self.residual[rows] = tried[better], values[better], residual[better]
            cost[rows] = after[better]
            self.states = _replace_rows(self.states, rows, states.rows(better))
            damping[searched] *= np.where(better, 0.1, 10.0)
            stale[searched] = better
            searched = searched[np.where(better, gained > FIT_TOLERANCE, damping[searched] < MAX_DAMPING)]
            if not len(searched):
                break
        every = np.flatnonzero(stale)
        self.slopes[every] = self._slopes(every)
        self.misfit = (self.residual**2).sum(axis=1) + (self.z[:, FORCE_COUNT:] ** 2).sum(axis=1)
        return self

    def _cost(self, z: Array, residual: Array, certainty: Array, rows: Index | None = None) -> Array:
        """Return the sums of squares (n,) of residuals (n, m) and of unknowns z (n, 7 + r) beside those
        expected.
        """
        before = self.before if rows is None else self.before[rows]
        return np.asarray((residual**2).sum(axis=1) + (certainty * (z - before) ** 2).sum(axis=1))

    def _step(self, rows: Index, certainty: Array, damping: Array) -> Array:
        """Return unknowns (n, 7 + r) after damped Gauss-Newton steps; forces change by MAX_FORCE_STEP_N at
        most.
        """
        slopes = self.slopes[rows]
        normal = slopes @ np.swapaxes(slopes, 1, 2) + certainty[rows, :, None] * np.eye(slopes.shape[1])
        damped = normal + damping[:, None, None] * normal * np.eye(slopes.shape[1])
        slope = (slopes @ self.residual[rows, :, None])[..., 0] + certainty[rows] * (
            self.z[rows] - self.before[rows]
        )
        step = -np.linalg.solve(damped, slope[..., None])[..., 0]
        largest = abs(step[:, :PLACE_INDEX]).max(axis=1)
        tried = (
            self.z[rows] + step * np.minimum(1.0, MAX_FORCE_STEP_N / np.maximum(largest, MIN_CURVATURE))[:, None]
        )
        placed = self.present[rows, PLACE_INDEX]
        tried[placed, PLACE_INDEX] = np.clip(tried[placed, PLACE_INDEX], *self.of.place_range)
        return np.asarray(tried)

    def _slopes(self, rows: Index) -> Array:
        """Return derivatives (n, 7 + r, m) of the residuals of some rows by differences in one batch."""
        which, column = np.nonzero(self.present[rows])
        at = rows[which]
        steps = self.steps[column].copy()
        # Beyond the last piece a place is the same as on it: the difference is taken backwards there.
        ends = (column == PLACE_INDEX) & (self.z[at, PLACE_INDEX] + steps > self.of.place_range[1])
        steps[ends] *= -1
        probes = self.z[at]
        probes[np.arange(len(at)), column] += steps
        values, _ = self.of.predict(self.states.rows(at), *self._split(probes))
        found = np.zeros((len(rows), *self.slopes.shape[1:]))
        found[which, column] = np.nan_to_num((values - self.values[at]) / steps[:, None] / self.of.scale)
        return found

    def average(self) -> _Posterior:
        """Return the posterior over all explanations and all scales of their forces (Bayesian model averaging)."""
        evidence, means, covariances = [], [], []
        scales = list(zip(FORCE_SCALES_N.tolist(), np.log(FORCE_SCALE_PROBABILITIES).tolist(), strict=True))
        for tip_scale, tip_log in scales:
            for body_scale, body_log in scales:
                log_evidence, mean, covariance = self._evidence(tip_scale, body_scale)
                evidence.append(log_evidence + np.log(self.explanations.probability) + tip_log + body_log)
                means.append(mean)
                covariances.append(covariance)
        # A fit whose equilibria were lost explains nothing.
        every = np.nan_to_num(np.array(evidence), nan=-np.inf)
        parts = np.exp(every - every.max())
        parts /= parts.sum()
        mean, covariance = _mix(parts, np.array(means)[..., :6], np.array(covariances)[..., :6, :6])
        body = parts * self.present[:, PLACE_INDEX]
        body /= max(body.sum(), np.finfo(float).tiny)
        here = slice(PLACE_INDEX, PLACE_INDEX + 1)
        place, variance = _mix(body, np.array(means)[..., here], np.array(covariances)[..., here, here])
        kinds = self.explanations.kinds
        weights = {kind: float(parts[:, kinds == kind].sum()) for kind in (NO_FORCE, TIP, BODY, TIP_AND_BODY)}
        return _Posterior(mean, covariance, float(place[0]), math.sqrt(variance[0, 0]), weights)

    def _evidence(self, tip_scale: float, body_scale: float) -> tuple[Array, Array, Array]:
        """Return logarithms of the evidence (H,), and mean (H, 7 + r) and covariance of the unknowns.

        tip_scale, body_scale: standard deviations of each component of the forces beforehand, N. The shape is
        linear in the unknowns around the fit (Laplace's approximation).
        """
        certainty = self._certainty(tip_scale, body_scale)
        normal = self.slopes @ np.swapaxes(self.slopes, 1, 2) + certainty[..., None] * np.eye(certainty.shape[1])
        slope = (self.slopes @ self.residual[..., None])[..., 0] + certainty * (self.z - self.before)
        covariance = np.linalg.inv(normal)
        step = -(covariance @ slope[..., None])[..., 0]
        least = self._cost(self.z, self.residual, certainty) + (slope * step).sum(axis=1)
        log_evidence = -least / 2 - np.linalg.slogdet(normal)[1] / 2 + np.log(certainty).sum(axis=1) / 2
        present = self.present[:, :, None] & self.present[:, None]
        return log_evidence, self.z + step, np.where(present, covariance, 0.0)


def _mix(parts: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) of a mixture with shares `parts` (..), by the law of total
    covariance.
    """
    shares, columns = parts.ravel(), means.shape[-1]
    means, covariances = means.reshape(-1, columns), covariances.reshape(-1, columns, columns)
    mean = shares @ means
    apart = means - mean
    return mean, np.tensordot(shares, covariances, 1) + (shares[:, None] * apart).T @ apart


def _replace_rows(states: States, rows: Index, new: States) -> States:
    """Return states in which some rows are new."""
    found = []
    for old, other in zip(states, new, strict=True):
        changed = old.copy()
        changed[rows] = other
        found.append(changed)
    return States(*found)
