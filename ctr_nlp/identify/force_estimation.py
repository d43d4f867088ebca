"""Forces on a robot from its measured shape: at the tip, at a place along the body, or both.

The shape y of a robot at known motors q is measured with noise of standard deviation sigma in every coordinate.
With h(F, G, s, u) the shape of the elastic robot under a force F at the tip and a force G at arc length s, and
with deviations R u of its tubes (R R^T their covariance, from the robot's tolerances), the estimate minimises

    |y - h(F, G, s, u)|^2 / sigma^2  +  |u|^2,

which is the posterior's mode for a flat prior of the forces. Four explanations are compared: no force, a force
at the tip, a force along the body, and both. A force is added only where it lowers the sum by more than chance
does (likelihood ratio, FALSE_ALARM_RATE), and what remains must be as small as noise makes it. So a contact at
mid-body is not reported as a force at the tip.

Forces are dead loads in the axes of the base. Rucker and Webster, Deflection-based force sensing for continuum
robots, IROS 2011, estimate forces at the tip in this way from a measured tip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

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
FORCE_SCALE_N = 0.2
"""Standard deviation of each component of a force beforehand, N: that of forces of tools and tissue."""
SAME_PLACE_MM = 2.0
"""Distance up to which two fits count as one place, mm."""
MIN_PLACES_APART, PLACES_TRIED = 3, 3
"""Pieces between two places from which fits begin, and number of these."""
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
        Force along the body, N; 0 where none acts.
    body_covariance : (3, 3) array
        Its covariance, N^2.
    place, place_deviation : float
        Arc length from the insertion point at which it acts, and its standard deviation, mm; NaN without one.
    probability : float
        Probability of a misfit at least as large, if the explanation is right.
    least_tip_force : float
        Least force at the tip that this robot and sensor detect in 95 of 100 cases, N, in its worst direction.
    places : (K,) array
        Arc lengths, mm, at which the next is known.
    least_body_forces : (K,) array
        Least force across the body at these places, in its worst direction, that is told from a force at the tip
        in 95 of 100 cases, N.
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
        elsewhere = self.weights[BODY] + self.weights[TIP_AND_BODY]
        if self.kind == TIP and elsewhere > FALSE_ALARM_RATE:
            told[TIP] += f" (a force along the body is as good an explanation, with probability {elsewhere:.0%})"
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

    def residuals(self, values: Array, u: Array) -> Array:
        """Return weighted residuals (n, m + r) of predicted values (n, m), with those of the deviations."""
        return np.hstack([(values - self.values) / self.scale, u])

    def fit(self, has_tip: bool, has_body: bool, first: _Fit | None = None, place: float = math.nan) -> _Fit:
        """Fit forces of a kind, from a first guess, by Levenberg's and Marquardt's method."""
        return _Fit(self, has_tip, has_body).run(first, place)

    def explain(self) -> ForceEstimate:
        """Compare the explanations, and return the simplest one that is not refuted."""
        none, tip = self.fit(False, False), self.fit(True, False)
        bodies = self.body_fits(none, has_tip=False)
        boths = self.body_fits(min((tip, *bodies), key=lambda each: each.misfit), has_tip=True)
        fits = {NO_FORCE: [none], TIP: [tip], BODY: bodies, TIP_AND_BODY: boths}
        kind = self.choose({name: min(each, key=lambda fit: fit.misfit) for name, each in fits.items()})
        chosen = min(fits[kind], key=lambda fit: fit.misfit)
        freedom = len(self.values) - chosen.force_count
        probability = float(chi2.sf(chosen.misfit, max(freedom, 1)))
        least_tip, least_body = self.least_detectable(tip)
        force, covariance, weights = self.average(fits)
        return ForceEstimate(
            kind=kind if probability > UNEXPLAINED_RATE else UNEXPLAINED,
            weights=weights,
            force=force,
            force_covariance=covariance,
            body_force=chosen.body,
            body_covariance=chosen.force_covariance[3:6, 3:6],
            place=chosen.place,
            place_deviation=math.sqrt(chosen.force_covariance[6, 6]) if chosen.has_body else math.nan,
            probability=probability,
            least_tip_force=least_tip,
            places=self.middles[self.useful],
            least_body_forces=least_body,
        )

    def average(self, fits: dict[str, list[_Fit]]) -> tuple[Array, Array, dict[str, float]]:
        """Return mean (3,) and covariance (3, 3) of the force at the tip over all explanations, and their weights.

        Bayesian model averaging: explanations are equally probable beforehand, forces normal with the deviation
        FORCE_SCALE_N, or that of the largest force found, and places uniform along the body. So a force at the
        tip is not more certain than that it acts there.
        """
        found = max(abs(fit.tip).max() for each in fits.values() for fit in each)
        scale = max(FORCE_SCALE_N, found)
        kinds, evidence, means, covariances = [], [], [], []
        for kind, each in fits.items():
            for fit in _distinct(each):
                log_evidence, mean, covariance = fit.evidence(scale)
                kinds.append(kind)
                evidence.append(log_evidence)
                means.append(mean)
                covariances.append(covariance)
        parts = np.exp(np.array(evidence) - max(evidence))
        parts /= parts.sum()
        mean = parts @ np.array(means)
        apart = np.array(means) - mean
        # The law of total covariance: within each explanation, and between them.
        spread = np.einsum("k,kij->ij", parts, np.array(covariances)) + np.einsum(
            "k,ki,kj->ij", parts, apart, apart
        )
        weights = {
            kind: float(sum(part for part, other in zip(parts, kinds, strict=True) if other == kind))
            for kind in fits
        }
        return mean, spread, weights

    def choose(self, fits: dict[str, _Fit]) -> str:
        """Return the kind of the simplest explanation to which no further force is worth adding."""

        def worth(simple: str, full: str, freedom: int, tried: int = 1) -> bool:
            # Of many places the best is taken, which chance favours: the rate is shared between them (Bonferroni).
            bound = chi2.isf(FALSE_ALARM_RATE / tried, freedom)
            return bool(fits[simple].misfit - fits[full].misfit > bound)

        places = len(self.useful)
        if (
            not worth(NO_FORCE, TIP, 3)
            and not worth(NO_FORCE, BODY, 3, places)
            and not worth(NO_FORCE, TIP_AND_BODY, 6, places)
        ):
            return NO_FORCE
        if not worth(TIP, TIP_AND_BODY, 3, places):
            return TIP
        return TIP_AND_BODY if worth(BODY, TIP_AND_BODY, 3) else BODY

    def body_fits(self, base: _Fit, has_tip: bool) -> list[_Fit]:
        """Fit a force along the body, from the places at which it helps most to first order."""
        tried: list[int] = []
        for k in np.argsort(-self.gains(base, has_tip)).tolist():
            if len(tried) < PLACES_TRIED and all(abs(k - other) > MIN_PLACES_APART for other in tried):
                tried.append(k)
        return [self.fit(has_tip, True, base, float(self.middles[self.useful[k]])) for k in tried]

    def body_slopes(self, base: _Fit) -> Array:
        """Return derivatives (K, 3, m + r) of the residuals over a force on each piece, at a fit."""
        count = len(self.useful)
        rows = 3 * count
        place = np.repeat(self.middles[self.useful], 3)
        probes = np.tile(np.eye(3), (count, 1)) * STEPS["force"]
        many = base.states.rows(np.zeros(rows, dtype=int))
        # The fit keeps the forces that it has; the probe is added.
        at = many.load.copy()
        at[:, at.shape[1] - 6 * len(self.lengths) :] += self.pushes(probes, place)
        there, done = self.equilibria.follow_branches(many, many.q, at)
        change = (self.values_of(there) - base.values) / STEPS["force"]
        slopes = np.where(done[:, None] == 1, change, 0.0) / self.scale
        return np.hstack([slopes, np.zeros((rows, self.root.shape[1]))]).reshape(count, 3, -1)

    def gains(self, base: _Fit, has_tip: bool) -> Array:
        """Return by how much a force on each piece lowers the sum of squares, to first order, (K,)."""
        kept = base.slopes if has_tip or not base.has_tip else base.slopes[3:]
        if has_tip and not base.has_tip:
            kept = np.vstack([self.tip_slopes(base), kept])
        inside = _projector(kept)
        gains = []
        for slope in base.body_slopes:
            free = slope - slope @ inside
            gains.append(base.residual @ free.T @ np.linalg.pinv(free @ free.T) @ free @ base.residual)
        return np.array(gains)

    def tip_slopes(self, base: _Fit) -> Array:
        """Return derivatives (3, m + r) of the residuals over a force at the tip, at a fit."""
        values, _ = self.predict(
            base.states.rows(np.zeros(3, dtype=int)),
            base.tip + STEPS["force"] * np.eye(3),
            np.tile(base.body, (3, 1)),
            np.full(3, base.place_or_zero),
            np.tile(base.u, (3, 1)),
        )
        slopes = (values - base.values) / STEPS["force"] / self.scale
        return np.hstack([slopes, np.zeros((3, self.root.shape[1]))])

    def least_detectable(self, tip: _Fit) -> tuple[float, Array]:
        """Return the least forces, N, that are noticed with DETECTION_RATE: at the tip, and at places (K,).

        A force F n lowers the sum of squares by F^2 n' I n in the mean, with I its information beside what else is
        unknown: this is compared with the noncentrality at which the likelihood ratio test has that power.
        """
        places = len(self.useful)
        deviations = _projector(tip.slopes[3:])
        free = tip.slopes[:3] - tip.slopes[:3] @ deviations
        tangents = self.tangents_at(tip)
        # Across the body only: what pushes along it hardly bends it.
        across = np.linalg.svd(tangents[-1:])[2][1:]
        least = np.linalg.eigvalsh(across @ free @ free.T @ across.T)[0]
        at_tip = math.sqrt(_noncentrality(3, FALSE_ALARM_RATE) / max(least, 1e-300))
        inside = _projector(tip.slopes)
        needed = _noncentrality(3, FALSE_ALARM_RATE / places)
        found = []
        for slope, tangent in zip(tip.body_slopes, tangents, strict=True):
            free = slope - slope @ inside
            across = np.linalg.svd(tangent[None])[2][1:]
            least = np.linalg.eigvalsh(across @ free @ free.T @ across.T)[0]
            found.append(math.sqrt(needed / max(least, 1e-300)))
        return at_tip, np.array(found)

    def tangents_at(self, fit: _Fit) -> Array:
        """Return the unit tangents (K, 3) of a fitted robot at the middles of its pieces."""
        sigma = self.middles[self.useful] / self.robot.split(self.q[None])[1][0, -1]
        return self.curves_of(fit.states, sigma)[1][0]


def _projector(rows: Array) -> Array:
    """Return the projector (n, n) onto the span of rows (k, n)."""
    if not len(rows):
        return np.zeros((rows.shape[1], rows.shape[1]))
    return np.asarray(np.linalg.pinv(rows) @ rows)


def _noncentrality(freedom: int, rate: float) -> float:
    """Return the noncentrality at which a chi-square test of a false alarm rate has DETECTION_RATE."""
    bound = chi2.isf(rate, freedom)
    return float(brentq(lambda x: ncx2.sf(bound, freedom, x) - DETECTION_RATE, 1e-6, 1e4))


def _distinct(fits: list[_Fit]) -> list[_Fit]:
    """Return fits without those that ended at the same place as a better one."""
    kept: list[_Fit] = []
    for fit in sorted(fits, key=lambda each: each.misfit):
        if not any(abs(fit.place - other.place) < SAME_PLACE_MM for other in kept):
            kept.append(fit)
    return kept


class _Fit:
    """A fit of forces of one kind to an observation; `run` makes it.

    tip, body (3,): forces, N; 0 where there is none. place_or_zero: arc length of the force along the body, mm.
    u (r,): deviations of the tubes. states: the equilibrium. values (m,): predicted values. residual (m + r,),
    slopes (k, m + r): weighted residuals, and their derivatives over the k unknowns. misfit: the sum of squares.
    """

    tip: Array
    body: Array
    place_or_zero: float
    u: Array
    states: States
    values: Array
    residual: Array
    slopes: Array
    misfit: float

    def __init__(self, of: _Observation, has_tip: bool, has_body: bool) -> None:
        self.of, self.has_tip, self.has_body = of, has_tip, has_body
        self.force_count = 3 * has_tip + 4 * has_body
        self.place_index = 3 * has_tip + 3
        kinds = ["force"] * 3 * has_tip + (["force"] * 3 + ["place"]) * has_body
        kinds += ["deviation"] * of.root.shape[1]
        self.steps = np.array([STEPS[kind] for kind in kinds])
        self.is_force = np.array([kind == "force" for kind in kinds], dtype=bool)

    def split(self, z: Array) -> tuple[Array, Array, Array, Array]:
        """Split unknowns z (n, k) into tip, body (n, 3), place (n,) and deviations u (n, r)."""
        rows = len(z)
        nothing = np.zeros((rows, 3))
        tip = z[:, :3] if self.has_tip else nothing
        at = 3 * self.has_tip
        body = z[:, at : at + 3] if self.has_body else nothing
        place = z[:, at + 3] if self.has_body else np.zeros(rows)
        return tip, body, place, z[:, self.force_count :]

    def run(self, first: _Fit | None, place: float) -> _Fit:
        """Minimise the sum of squares from another fit, with a force along the body at first at `place`, mm."""
        of, forces = self.of, self.force_count
        z, states = np.zeros(forces + of.root.shape[1]), of.start
        if first is not None and first.has_tip <= self.has_tip and not first.has_body:
            # The other fit is this one with a force of zero: its equilibrium is where this one begins.
            z[: 3 * first.has_tip], z[forces:], states = first.tip[: 3 * first.has_tip], first.u, first.states
        if self.has_body:
            z[self.place_index] = place
        values, states = of.predict(states, *self.split(z[None]))
        residual = of.residuals(values, z[None, forces:])[0]
        damping = FIRST_DAMPING
        for _ in range(MAX_FIT_ITERATIONS):
            slopes = self._slopes(z, states, values[0])
            gained = 0.0
            while damping < MAX_DAMPING:
                tried = self._step(z, slopes, residual, damping)
                new, there = of.predict(states, *self.split(tried[None]))
                after = of.residuals(new, tried[None, forces:])[0]
                # NaN, where the branch of equilibria ends on the way, is no gain.
                if (better := residual @ residual - after @ after) > 0:
                    z, values, states, residual, gained = tried, new, there, after, better
                    damping /= 10
                    break
                damping *= 10
            if not gained > FIT_TOLERANCE:
                break
        self.states, self.values, self.residual = states, values[0], residual
        self.slopes = self._slopes(z, states, values[0])
        tip, body, at, u = self.split(z[None])
        self.tip, self.body, self.place_or_zero, self.u = tip[0], body[0], float(at[0]), u[0]
        self.misfit = float(residual @ residual)
        return self

    def _step(self, z: Array, slopes: Array, residual: Array, damping: float) -> Array:
        """Return the unknowns after a damped Gauss-Newton step; forces change by MAX_FORCE_STEP_N at most."""
        if not len(z):
            return z
        normal = slopes @ slopes.T
        damped = normal + damping * np.diag(np.maximum(np.diag(normal), MIN_CURVATURE))
        step = -np.linalg.solve(damped, slopes @ residual)
        largest = abs(step[self.is_force]).max(initial=0.0)
        tried = z + step * min(1.0, MAX_FORCE_STEP_N / max(largest, MIN_CURVATURE))
        if self.has_body:
            tried[self.place_index] = np.clip(tried[self.place_index], *self.of.place_range)
        return np.asarray(tried)

    def _slopes(self, z: Array, states: States, values: Array) -> Array:
        """Return derivatives (k, m + r) of the residuals over the unknowns: differences in one batch."""
        if not len(z):
            return np.zeros((0, len(self.of.values) + self.of.root.shape[1]))
        steps = self.steps.copy()
        # Beyond the last piece a place is the same as on it: the difference is taken backwards there.
        if self.has_body and z[self.place_index] + steps[self.place_index] > self.of.place_range[1]:
            steps[self.place_index] *= -1
        probes = z + np.diag(steps)
        found, _ = self.of.predict(states.rows(np.zeros(len(z), dtype=int)), *self.split(probes))
        before = self.of.residuals(values[None], z[None, self.force_count :])
        change = self.of.residuals(found, probes[:, self.force_count :]) - before
        return np.nan_to_num(change / steps[:, None])

    @property
    def place(self) -> float:
        """Arc length of the force along the body, mm; NaN without one."""
        return self.place_or_zero if self.has_body else math.nan

    @property
    def present(self) -> Index:
        """Indices of what the fit has among tip, body and place, 7 in all."""
        return np.flatnonzero([self.has_tip] * 3 + [self.has_body] * 4)

    @cached_property
    def body_slopes(self) -> Array:
        """Derivatives (K, 3, m + r) of the residuals over a force on each piece."""
        return self.of.body_slopes(self)

    @cached_property
    def force_covariance(self) -> Array:
        """Covariance (7, 7) of tip, body and place; 0 for what the fit does not have."""
        every = np.linalg.pinv(self.slopes @ self.slopes.T)[: self.force_count, : self.force_count]
        found = np.zeros((7, 7))
        found[np.ix_(self.present, self.present)] = every
        return found

    def evidence(self, scale: float) -> tuple[float, Array, Array]:
        """Return the logarithm of the evidence, and mean (3,) and covariance (3, 3) of the force at the tip.

        scale: standard deviation of each component of a force beforehand, N. The likelihood is normal around the
        fit (Laplace's approximation), so that with a normal prior of the same mean and variance as that of places
        the integral is one of normal distributions.
        """
        rows = self.present
        if not len(rows):
            return -self.misfit / 2, np.zeros(3), np.zeros((3, 3))
        low, high = self.of.place_range
        before = np.diag([*[scale**2] * 6, (high - low) ** 2 / 12])[np.ix_(rows, rows)]
        middle = np.array([*[0.0] * 6, (low + high) / 2])[rows]
        at = np.array([*self.tip, *self.body, self.place_or_zero])[rows]
        likely = self.force_covariance[np.ix_(rows, rows)] + MIN_CURVATURE * np.eye(len(rows))
        both = likely + before
        away = at - middle
        log_evidence = (
            -self.misfit / 2
            + np.linalg.slogdet(likely)[1] / 2
            - np.linalg.slogdet(both)[1] / 2
            - away @ np.linalg.solve(both, away) / 2
        )
        gain = before @ np.linalg.inv(both)
        mean = middle + gain @ away
        covariance = before - gain @ before
        tip = np.zeros(3), np.zeros((3, 3))
        return (float(log_evidence), mean[:3], covariance[:3, :3]) if self.has_tip else (float(log_evidence), *tip)
