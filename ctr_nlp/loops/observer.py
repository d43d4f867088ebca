"""What measurements say of a robot's tubes, zeros and lags: an extended Kalman filter over its differences."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

from ctr_nlp.loops.differences import Differences
from ctr_nlp.loops.prediction import Predicted, Predictor
from ctr_nlp.loops.sensors import Reading, Seen, Sensors
from ctr_nlp.models import Model
from ctr_nlp.models.walker import Walker
from ctr_nlp.typing import Array, Flags

GATE = {1: 10.83, 2: 13.82, 3: 16.27}
"""Squared distances, in standard deviations, that values which belong together exceed once in a thousand: chi-square."""
MODEL = 0.1
"""Part of a sensor's noise that is added for what the model does not know."""
STILL = 1e-4
"""rad: tubes that are to turn by less are left where they are within their lags."""
KEPT = 1.0
"""s for which what was predicted is remembered, for readings that come late."""


class Record(NamedTuple):
    """What was predicted at a time: values (m,), their slopes (m, k) over differences, and the mean (k,) then."""

    time: float
    values: Array
    slopes: Array
    mean: Array


class Innovation(NamedTuple):
    """A reading beside what was predicted for its time: what it exceeds that by (m,), and the deviation (m,) expected.

    accepted (m,): which values were taken; missing ones were not. size: the mean square of accepted innovations in
    expected deviations, about 1; NaN without any.
    """

    time: float
    excess: Array
    expected: Array
    accepted: Flags
    size: float


class Observer:
    """One hypothesis of a robot: a mean and a covariance of its differences, and the equilibrium that it is in.

    q (2d + 2,): where the motors are. margin: of the estimated robot, NaN where nothing can be unstable. predicted:
    its shape at the predictor's places, of which the sensors' come first. jumps: by what its tips jumped so far.
    """

    def __init__(self, model: Model, differences: Differences, sensors: Sensors, predictor: Predictor) -> None:
        self._model, self.differences, self._sensors, self._predict = model, differences, sensors, predictor
        self.mean, self.covariance = differences.mean.copy(), differences.covariance.copy()
        self._described, self._d = differences.robot.numbers, differences.robot.d
        self._behind, self._engaged = np.zeros((2, self._d))
        self._records = list[Record]()
        self._walker: Walker | None = None
        self.jumps = list[Array]()
        self._take_mean()

    def _take_mean(self) -> None:
        draw = self.differences.draws(self.mean[None])
        self._numbers, self._offsets, self._lags = draw.numbers[0], draw.offsets[0], draw.lags[0]
        self._structure = draw.structure

    @property
    def walker(self) -> Walker:
        """The estimated robot, after its motors have moved at least once."""
        assert self._walker is not None
        return self._walker

    @property
    def tubes(self) -> Array:
        """The configuration (2d + 2,) of the estimated robot's tubes."""
        found = self.q.copy()
        found[: self._d] += self._offsets + self._behind
        return found

    def motors(self, tubes: Array) -> Array:
        """Where motors must go to turn tubes to a configuration (2d + 2,): past it by their lags."""
        found, d = tubes.copy(), self._d
        turn = tubes[:d] - self.tubes[:d]
        found[:d] -= self._offsets - np.where(abs(turn) > STILL, np.sign(turn), -self._engaged) * self._lags
        return found

    def at(self, walker: Walker) -> tuple[Predicted, float]:
        """What is predicted of the estimated robot where a walker stands, and the margin there."""
        margin = walker.margin()
        return self._predict(walker.x, self._numbers, self._described, margin), margin

    def moved(self, q: Array, time: float) -> None:
        """The motors have moved to q (2d + 2,) at a time, s."""
        d = self._d
        before = np.full(d, q[d - 1]) if self._walker is None else self.q[:d]
        free = self._behind - (q[:d] - before)
        self._behind = np.clip(free, -self._lags, self._lags)
        self._engaged = np.where(self._behind != free, np.sign(self._behind), self._engaged)
        self.q = np.array(q)
        if self._walker is None:
            self._walker = self._model.walker(self._structure, self._numbers, self.tubes)
        else:
            self.jumps += self._walker.go(self.tubes)
        self._look(time)

    def _look(self, time: float) -> None:
        """Predict what is measured now."""
        self.predicted, self.margin = self.at(self.walker)
        rows, signs, n = self._rows_over, self._signs_over[:, None, None], len(self._sensors.sigma)
        points, tangents, of_points, of_tangents, self._of_phi, self._of_margin = self.predicted
        slopes = (signs * of[rows, :n] for of in (of_points, of_tangents))
        seen = Seen(points[:n], tangents[:n], *slopes, float(self.q[2 * self._d - 1]))
        values, over = self._sensors.values(seen).copy(), self._sensors.slopes(seen)
        record = Record(time, values, over, self.mean)
        self._records = [old for old in self._records if old.time > time - KEPT] + [record]

    @property
    def _rows_over(self) -> Array:
        """Over which of alpha, beta, theta and parts each difference acts."""
        d, freed = self._d, len(self.differences.freed)
        return np.concatenate([2 * d + 2 + np.arange(freed), self.differences.zeros[1], self.differences.late[1]])

    @property
    def _signs_over(self) -> Array:
        """By how much of each difference it does."""
        ones = np.ones(len(self.differences) - len(self.differences.late[1]))
        return np.concatenate([ones, self._engaged[self.differences.late[1]]])

    def expected(self, time: float) -> tuple[Array, Array]:
        """What is predicted of a reading at a time, (m,), and its slopes (m, k), by what is known now."""
        records = self._records
        after = next((k for k, each in enumerate(records) if each.time >= time - 1e-9), len(records) - 1)
        ends, part = [records[after]], 1.0
        if after and time < ends[0].time - 1e-9:
            ends.insert(0, records[after - 1])
            part = (time - ends[0].time) / (ends[1].time - ends[0].time)
        values = [each.values + each.slopes @ (self.mean - each.mean) for each in ends]
        if len(ends) == 1:
            return values[0], ends[0].slopes
        return values[0] + part * (values[1] - values[0]), ends[0].slopes + part * (ends[1].slopes - ends[0].slopes)

    def measured(self, reading: Reading) -> Innovation:
        """Take a reading of a moment that the motors have passed: what is right of it changes the estimate."""
        values, slopes = self.expected(reading.time)
        excess, spread = reading.values - values, slopes @ self.covariance @ slopes.T
        spread[np.diag_indices_from(spread)] += self._sensors.noise**2 * (1 + MODEL)
        accepted, expected = self._accepted(excess, spread), np.sqrt(spread.diagonal())
        count = int(np.count_nonzero(accepted))
        if count == 0:
            return Innovation(reading.time, excess, expected, accepted, float("nan"))
        if count < len(accepted):
            spread, slopes, right = spread[accepted][:, accepted], slopes[accepted], excess[accepted]
        else:
            right = excess
        _, solved, _ = lapack.dposv(spread, np.column_stack([slopes @ self.covariance, right]))
        taken = slopes.T @ solved
        covariance = self.covariance @ (np.eye(len(self.mean)) - taken[:, :-1])
        change = self.covariance @ taken[:, -1]
        self.covariance = (covariance + covariance.T) / 2
        self._changed(change)
        return Innovation(reading.time, excess, expected, accepted, float(right @ solved[:, -1] / count))

    def _accepted(self, excess: Array, spread: Array) -> Flags:
        """Which values are no further from what was expected than once in a thousand readings."""
        found = np.zeros(len(excess), dtype=bool)
        for rows in self._sensors.grouped:
            away = excess[rows]
            known = np.isfinite(away).all(axis=1)
            there = np.where(known[:, None], away, 0.0)
            solved = np.linalg.solve(spread[rows[:, :, None], rows[:, None, :]], there[..., None])[..., 0]
            found[rows] = (known & ((solved * there).sum(axis=1) <= GATE[rows.shape[1]]))[:, None]
        return found

    def _changed(self, change: Array) -> None:
        """The mean moves by so much (k,), and the estimated robot with it."""
        d, freed = self._d, len(self.differences.freed)
        self.mean = self.mean + change
        rows, tubes = self.differences.late
        self._behind[tubes] += self._engaged[tubes] * change[rows]
        self._take_mean()
        self._behind = np.clip(self._behind, -self._lags, self._lags)
        x = self.walker.x.copy()
        x[:d] += change[:freed] @ self._of_phi[2 * d + 2 :]
        self.jumps += self.walker.become(self._numbers, x)
        self.jumps += self.walker.go(self.tubes)
