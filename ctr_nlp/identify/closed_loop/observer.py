"""Observer of a robot's tubes, motor zeros, backlash and tip force: an extended Kalman filter over these.

A reading y = h(x, z) + noise of covariance R, with x the equilibrium that the robot is in, changes the estimate z
(k,) and its covariance P by

    S = H P H' + R,   K = P H' S^-1,   z <- z + K (y - h),   P <- (1 - K H) P

with H = dh / dz at fixed motors. z is constant, so that there is no prediction step for P. Where the estimated
robot snaps, there are two hypotheses: the robot has snapped, or a likely one close to it has not ("Closed
loop" in docs/method.md).
"""

from __future__ import annotations

import copy
import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

from ctr_nlp.identify.closed_loop.parameter_differences import ParameterDifferences
from ctr_nlp.identify.closed_loop.prediction import PredictedShape, Predictor
from ctr_nlp.identify.closed_loop.prediction_history import PastPrediction, PredictionHistory
from ctr_nlp.identify.closed_loop.sensors import Reading, SensedShape, Sensors
from ctr_nlp.identify.closed_loop.sensors.gate import count_groups, gate_values
from ctr_nlp.models import Model
from ctr_nlp.models.loads import require_constant_load
from ctr_nlp.models.walker import Walker
from ctr_nlp.typing import Array, Flags

MODEL_NOISE_SHARE = 0.1
"""Part of a sensor's variance that is added for errors of the model."""
MIN_TUBE_TURN_RAD = 1e-4
"""rad: tubes that are to turn by less keep their position within their play."""
UNSNAPPED_SEARCH_DEVIATIONS = 0.5, 1.0, 1.5, 2.0, 3.0
"""Standard deviations of the margin at which a robot is sought that has not snapped when the estimate has."""
DECISIVE_LOG_ODDS, MAX_COUNTED_INNOVATION_DEVIATIONS = 10.0, 5.0
"""Log odds at which one of two hypotheses is dropped; innovations are clipped to so many standard deviations."""
WEAKER_STEPS = 10
"""Continuation steps from the estimated robot to a less stable one."""
SNAP_FIT_RATIO = 3.0
"""Factor by which a reading must be nearer to another equilibrium than to the expected one to prove a snap."""
MIN_SNAP_MISFIT_DEVIATIONS = 6.0
"""Standard deviations, root mean square over values, beyond which a misfit is not due to chance."""
MIN_MARGIN_VARIANCE = 1e-300
"""Replaces 0 in denominators."""


class Innovation(NamedTuple):
    """A reading compared with the prediction for its time.

    time: of the reading, s. excess (m,): measured less predicted. expected_deviations (m,): standard deviations of
    that. accepted (m,): mask of the values that are used; missing ones are not. size: mean square of accepted
    innovations over their expected deviations, about 1; NaN without any. groups: number of groups measured, whose
    values are right or wrong together; rejected: number of these that are not used.
    """

    time: float
    excess: Array
    expected_deviations: Array
    accepted: Flags
    size: float
    groups: int
    rejected: int


class Observer:
    """One hypothesis of a robot: mean and covariance of its parameter differences, and its equilibrium.

    differences: the k parameters, with their prior. q (2d + 2,): configuration of the motors. margin: of the
    estimated robot, NaN where nothing can be unstable. predicted: its shape at the predictor's points, of which
    the sensors' come first. jumps: of its tips so far, rad. rejected_updates: number of readings that were not
    used because the estimated robot would have snapped. rival: the other hypothesis, None without one.
    """

    def __init__(
        self, model: Model, differences: ParameterDifferences, sensors: Sensors, predictor: Predictor
    ) -> None:
        self._model = model
        self.differences = differences
        self._sensors = sensors
        self._predict = predictor
        self.mean = differences.mean.copy()
        self.covariance = differences.covariance.copy()
        self._described = differences.robot.numbers
        self._d = differences.robot.d
        self._structure = differences.perturbed_robots(self.mean[None]).structure
        load = None if model.applied_load is None else require_constant_load(model.applied_load, "an observer")
        self._borne = np.zeros(0) if load is None else load.numbers(self._d)
        self._behind, self._engaged = np.zeros((2, self._d))
        self.q = np.zeros(len(differences.robot.axes))
        self._recalled = PredictionHistory()
        self._walker: Walker | None = None
        self.jumps = list[Array]()
        self.rejected_updates = 0
        self._odds = 0.0
        self.rival: Observer | None = None
        self._judged: tuple[tuple[Reading, Array, Array], tuple[Innovation, Array, Array]] | None = None
        self._take_mean()

    def _take_mean(self) -> None:
        of = self.differences
        self._numbers, self._offsets, self._lags = (take(self.mean) for take in (of.numbers, of.offsets, of.lags))
        self._load = self._borne.copy()
        self._load[: len(of.force_indices)] += self.mean[of.force_indices]

    @property
    def walker(self) -> Walker:
        """The estimated robot, after its motors have moved at least once."""
        assert self._walker is not None
        return self._walker

    @property
    def tubes(self) -> Array:
        """Configuration (2d + 2,) of the estimated robot's tubes."""
        found = self.q.copy()
        found[: self._d] += self._offsets + self._behind
        return found

    def motors(self, tubes: Array) -> Array:
        """Return the motors' configuration (2d + 2,) that turns tubes to a configuration (2d + 2,)."""
        # Motors overshoot by the play. A tube that is not to turn stays on the side of its play where it is.
        found = tubes.copy()
        d = self._d
        turn = tubes[:d] - self.tubes[:d]
        found[:d] -= (
            self._offsets - np.where(abs(turn) > MIN_TUBE_TURN_RAD, np.sign(turn), -self._engaged) * self._lags
        )
        return found

    def predict_at(self, walker: Walker) -> tuple[PredictedShape, float]:
        """Return the predicted shape at the equilibrium of a walker, and the stability margin there."""
        margin = walker.margin()
        return self._predict(walker.x, self._numbers, self._described, margin, self._load), margin

    def deviation(self, of_margin: Array) -> float:
        """Return the standard deviation of the margin; of_margin: (k,), slopes as in PredictedShape."""
        slopes = self._signs_over * of_margin[self.differences.derivative_indices]
        return math.sqrt(max(float(slopes @ self.covariance @ slopes), 0.0))

    def uncertainty(self, of_points: Array) -> float:
        """Return the standard deviation of the shape, mm, as root mean square over n points.

        of_points: (k, n, 3), slopes of these points, as in PredictedShape.
        """
        slopes = self._signs_over[:, None, None] * of_points[self.differences.derivative_indices]
        over = slopes.reshape(len(slopes), -1)
        return math.sqrt(max(float(np.sum((self.covariance @ over) * over)) / of_points.shape[1], 0.0))

    def move_motors(self, q: Array, time: float) -> None:
        """Update the robot for motors that have moved to q (2d + 2,) by a time, s."""
        stood = None if self._walker is None else self._walker.copy()
        fell = self._move_walker(q)
        if fell and stood is not None and self.rival is None:
            self._split_hypotheses(stood, fell, time)
        else:
            self.jumps = self.jumps + fell
        if self.rival is not None:
            self.rival.move_motors(q, time)
        self._predict_readings(time)

    def _move_walker(self, q: Array) -> list[Array]:
        """Simulate motors that have moved to q (2d + 2,); return the jumps of the estimated robot's tips, rad."""
        d = self._d
        before = np.full(d, q[d - 1]) if self._walker is None else self.q[:d]
        # A tube stays where it is until its motor has taken up the play; then it is dragged along (engaged).
        free = self._behind - (q[:d] - before)
        self._behind = np.clip(free, -self._lags, self._lags)
        self._engaged = np.where(self._behind != free, np.sign(self._behind), self._engaged)
        self.q = np.array(q)
        if self._walker is not None:
            return self._jumps_or_nan(self._walker.move_to(self.tubes))
        self._walker = self._model.walker(self._structure, self._numbers, self.tubes)
        return self._jumps_or_nan(
            self._walker.change_load(self._load) if len(self.differences.force_indices) else []
        )

    def _jumps_or_nan(self, fell: list[Array]) -> list[Array]:
        """Return jumps of the tips; NaN, once, where the equilibrium after a snap is unknown, as under a load."""
        gone = np.isnan(self.walker.x).any() and not (fell or self.jumps)
        return [np.full(self._d, np.nan)] if gone else fell

    def _update_walker(self, x: Array | None = None) -> list[Array]:
        """Move the walker to the robot as estimated now; return jumps of its tips; x: (n_x,), initial guess."""
        fell = self.walker.change_tubes(self._numbers, x)
        if len(self.differences.force_indices):
            fell = [*fell, *self.walker.change_load(self._load)]
        return [*fell, *self.walker.move_to(self.tubes)]

    def apply_past_motion(self, configurations: Array) -> None:
        """Simulate a motion through configurations (n, 2d + 2) without predictions of readings."""
        self._copy_walker()
        for q in configurations:
            self._move_walker(q)

    def independent_copy(self) -> Observer:
        """Return a copy that moves independently of this one."""
        found = copy.copy(self)
        found._copy_walker()
        return found

    def _copy_walker(self) -> None:
        """Replace the walker by a copy: copies of an observer share theirs otherwise."""
        self._walker = None if self._walker is None else self._walker.copy()

    def move_and_check_snap(self, q: Array) -> bool:
        """Move the motors to q (2d + 2,) without predictions of readings; return whether the robot snaps.

        For an independent copy only: other copies share their walker, which moves.
        """
        return bool(self._move_walker(q)) or not np.isfinite(self.walker.x).all()

    def weaker_robot(self, of_margin: Array, deviations: float) -> Observer | None:
        """Return a copy of the robot whose margin is `deviations` standard deviations less, at the same motors.

        of_margin: (k,), slopes of the margin, as in PredictedShape. None where that robot would have snapped.
        """
        # The most likely one of all robots with that margin: of all dz with s . dz = -n sqrt(s' P s), dz' P^-1 dz
        # is least for dz = -n P s / sqrt(s' P s).
        slopes = self._signs_over * of_margin[self.differences.derivative_indices]
        spread = math.sqrt(max(float(slopes @ self.covariance @ slopes), MIN_MARGIN_VARIANCE))
        change = -deviations / spread * (self.covariance @ slopes)
        found = self.independent_copy()
        # In one step the new equilibrium may be missed, which looks like a snap.
        for _ in range(WEAKER_STEPS):
            found._shift_mean(change / WEAKER_STEPS)
            if found._update_walker() or not np.isfinite(found.walker.x).all():
                return None
        return found

    def find_other_equilibrium(self, reading: Reading) -> Array | None:
        """Return the shape (n, 3), mm, of another equilibrium that a reading fits better; None without one.

        None also where the misfit may be due to chance, or where no other equilibrium at the same motors fits
        better by SNAP_FIT_RATIO. Points are the predictor's.
        """
        innovation = self.compute_innovation(reading)
        d = self._d
        away = _misfit(innovation.excess, innovation.expected_deviations)
        if not away > MIN_SNAP_MISFIT_DEVIATIONS:
            return None
        found: Array | None = None
        least = away / SNAP_FIT_RATIO
        # Other equilibria at the same motors are those of a robot with some tubes a whole turn further: a tube
        # that snaps unwinds by about that much.
        for turns in itertools.product((-1.0, 0.0, 1.0), repeat=d - 1):
            tubes = self.tubes
            tubes[: d - 1] += 2 * np.pi * np.array(turns)
            walker = self._model.walker(self._structure, self._numbers, tubes)
            if len(self.differences.force_indices):
                walker.change_load(self._load)
            if not np.isfinite(walker.x).all():
                continue
            predicted, _ = self.predict_at(walker)
            misfit = _misfit(reading.values - self._sensor_values(predicted)[0], innovation.expected_deviations)
            if misfit < least:
                found = predicted.points.copy()
                least = misfit
        self.predicted, self.margin = self.predict_at(
            self.walker
        )  # the predictor overwrites what it returned before
        return found

    def copy_after_motion(self, configurations: Array) -> Observer:
        """Return a copy after its motors have moved through configurations (n, 2d + 2), with its jumps, rad."""
        found = self.independent_copy()
        for q in configurations:
            found._add_jumps(found._move_walker(q))
        return found

    def _split_hypotheses(self, stood: Walker, fell: list[Array], time: float) -> None:
        """Continue as the most likely robot that has not snapped, if any, with the snapped one as rival.

        stood: walker before the snap. fell: jumps of the tips. time: s. Readings then decide between the two.
        """
        # The rival is the robot that has snapped; this object becomes one that has not.
        rival = copy.copy(self)
        slopes = self._signs_over * self.predicted.of_margin[self.differences.derivative_indices]
        # The most likely change of z by which the margin grows by one of its standard deviations.
        towards = (
            self.covariance @ slopes / np.sqrt(max(float(slopes @ self.covariance @ slopes), MIN_MARGIN_VARIANCE))
        )
        for part in UNSNAPPED_SEARCH_DEVIATIONS:
            self._walker = stood.copy()
            self._shift_mean(part * towards)
            before = self._update_walker()
            if not before and np.isfinite(self._walker.x).all():
                self.rival = rival._add_jumps(fell)
                self._odds = 0.0
                return
            self.__dict__.update(rival.__dict__)
        self.jumps = self.jumps + fell

    def _add_jumps(self, fell: list[Array]) -> Observer:
        """Return this hypothesis with the jumps of a snap added."""
        self.jumps = self.jumps + fell
        return self

    def _shift_mean(self, change: Array) -> None:
        """Change the mean by so much (k,), and the positions of tubes within their play."""
        # A tube at the end of its play stays there as the estimated play changes.
        rows, tubes = self.differences.lag_indices
        self.mean, self._behind = self.mean + change, self._behind.copy()
        self._behind[tubes] += self._engaged[tubes] * change[rows]
        self._take_mean()
        self._behind = np.clip(self._behind, -self._lags, self._lags)

    def _predict_readings(self, time: float) -> None:
        """Predict the readings at a time, s, and remember them for late ones."""
        self.predicted, self.margin = self.predict_at(self.walker)
        self._of_phi = self.predicted.of_phi.copy()
        values, over = self._sensor_values(self.predicted)
        self._recalled = self._recalled.with_prediction(PastPrediction(time, values, over, self.mean))

    def _sensor_values(self, predicted: PredictedShape) -> tuple[Array, Array]:
        """Return the values (m,) that sensors would measure, and their slopes (m, k) over differences."""
        rows = self.differences.derivative_indices
        signs = self._signs_over[:, None, None]
        n = len(self._sensors.sigma)
        points, tangents, of_points, of_tangents, *_ = predicted
        of_seen, of_turned = (signs * of[rows, :n] for of in (of_points, of_tangents))
        seen = SensedShape(points[:n], tangents[:n], of_seen, of_turned, float(self.q[2 * self._d - 1]))
        return self._sensors.values(seen).copy(), self._sensors.slopes(seen)

    @property
    def _signs_over(self) -> Array:
        """Signs (k,) of the differences' effect on shapes: 1; for lags the end of its play at which a tube is."""
        ones = np.ones(len(self.differences) - len(self.differences.lag_indices[1]))
        return np.concatenate([ones, self._engaged[self.differences.lag_indices[1]]])

    def expected_reading(self, time: float) -> tuple[Array, Array]:
        """Return the predicted values (m,) for a time, s, with slopes (m, k), by the present estimate."""
        return self._recalled.expected_reading(time, self.mean)

    def rates(self, time: float) -> Array:
        """Return the rates (m,) at which values change at a time, per s; 0 where these are unknown."""
        return self._recalled.rates(time)

    def compute_innovation(self, reading: Reading) -> Innovation:
        """Return the innovation of a reading, without updating the estimate."""
        return self._innovation_and_gain(reading)[0]

    def _innovation_and_gain(self, reading: Reading) -> tuple[Innovation, Array, Array]:
        """Compare a reading with its prediction; return the innovation, the gain (m, k) of accepted values, and
        slopes (m, k).

        Computed once for each reading and estimate.
        """
        known = reading, self.mean, self.covariance
        if self._judged is None or any(a is not b for a, b in zip(self._judged[0], known, strict=True)):
            self._judged = known, self._compute_innovation_and_gain(reading)
        return self._judged[1]

    def _compute_innovation_and_gain(self, reading: Reading) -> tuple[Innovation, Array, Array]:
        values, slopes = self.expected_reading(reading.time)
        excess = reading.values - values
        over = slopes @ self.covariance
        spread = over @ slopes.T
        # The model is not exact either: MODEL_NOISE_SHARE adds to the sensor's noise, so that the covariance does
        # not shrink too far.
        spread[np.diag_indices_from(spread)] += self._sensors.noise**2 * (1 + MODEL_NOISE_SHARE)
        taken = gate_values(self._sensors, excess, spread)
        expected = np.sqrt(spread.diagonal())
        gain = np.zeros_like(slopes)
        size = float("nan")
        if taken.any():
            right = excess[taken]
            _, solved, _ = lapack.dposv(spread[taken][:, taken], np.column_stack([over[taken], right]))
            gain[taken], size = solved[:, :-1], float(right @ solved[:, -1] / len(right))
        counts = count_groups(self._sensors, excess, taken)
        return Innovation(reading.time, excess, expected, taken, size, *counts), gain, slopes

    def update_estimate(self, reading: Reading) -> Innovation:
        """Update the estimate with a reading, of a time up to now, and return its innovation.

        An update with which the estimated robot would snap is rejected.
        """
        innovation, gain, slopes = self._innovation_and_gain(reading)
        if self.rival is not None:
            self._decide(innovation, self.rival.update_estimate(reading))
        if innovation.accepted.any():
            covariance = self.covariance @ (np.eye(len(self.mean)) - slopes.T @ gain)
            change = np.where(innovation.accepted, innovation.excess, 0.0) @ gain
            # Symmetrised: rounding would let P drift from a covariance.
            self._apply_change(change, (covariance + covariance.T) / 2)
        return innovation

    def _decide(self, own: Innovation, other: Innovation) -> None:
        """Replace this hypothesis by its rival, or drop the rival, once readings decide between them.

        own, other: innovations of this hypothesis and of the rival.
        """
        # Log-likelihood ratio of both hypotheses; a single outlier counts at most
        # MAX_COUNTED_INNOVATION_DEVIATIONS deviations.
        away = [
            np.minimum(abs(each.excess / each.expected_deviations), MAX_COUNTED_INNOVATION_DEVIATIONS)
            for each in (own, other)
        ]
        self._odds += float(np.nansum(away[0] ** 2) - np.nansum(away[1] ** 2)) / 2
        if self._odds > DECISIVE_LOG_ODDS and self.rival is not None:
            self.__dict__.update(self.rival.__dict__)
        elif self._odds < -DECISIVE_LOG_ODDS:
            self.rival = None

    def restore_estimate(self, mean: Array, covariance: Array) -> None:
        """Restore an earlier mean (k,) and covariance (k, k)."""
        self._apply_change(mean - self.mean, covariance)

    def _apply_change(self, change: Array, covariance: Array) -> None:
        """Change the mean by so much (k,), set the covariance (k, k), and move the estimated robot accordingly."""
        d = self._d
        freed = len(self.differences.tube_parts)
        before = self.__dict__.copy()
        self._walker = self.walker.copy()
        self.covariance = covariance
        self._shift_mean(change)
        x = self._walker.x.copy()
        # To first order the tips follow the change of the tubes: a guess for the walker, which finds the
        # equilibrium.
        x[:d] += change[:freed] @ self._of_phi[2 * d + 2 : 2 * d + 2 + freed]
        fell = self._update_walker(x)
        if fell or not np.isfinite(self._walker.x).all():
            self.__dict__.update(before)
            self.rejected_updates += 1


def _misfit(excess: Array, expected: Array) -> float:
    """Return the root mean square of excess (m,), NaN where missing, over expected deviations (m,); 0 of none."""
    known = np.isfinite(excess)
    return float(np.sqrt(np.mean((excess[known] / expected[known]) ** 2))) if known.any() else 0.0
