"""Steering along a plan by what sensors tell of the robot: observe, correct, and fall back where sensing fails."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.loops.anew.way import PLACES, Outset, Way
from ctr_nlp.loops.correction import Correction, Place
from ctr_nlp.loops.differences import Differences
from ctr_nlp.loops.doubts import Doubts
from ctr_nlp.loops.lookahead import DEVIATIONS, LEAST_MARGIN, objection
from ctr_nlp.loops.observer import Innovation, Observer
from ctr_nlp.loops.prediction import Predicted, Predictor
from ctr_nlp.loops.sensors import Reading, Sensors
from ctr_nlp.models import bearing
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot, Tolerances
from ctr_nlp.typing import Array

ROOM = 24
"""Places for which predictions are compiled at least, so that robots of a kind share them whatever their sensors.
"""
PULL, LEAST = 0.03, 0.1
"""mm^2 that a mm away from the planned configuration costs, W as in the motion term, while the robot is not known;
and the part of that which is left once it is."""
UNKNOWN = 0.5
"""mm by which the estimated shape is uncertain, as root mean square over places, where the whole pull counts."""
MARGIN = 0.25
"""The least stability margin of the estimated robot, where nothing is uncertain; not more than was planned."""
UNCERTAIN = 2.0
"""Standard deviations of the margin by which that is raised for what is uncertain, up to the planned one."""
THIN = 1000.0
"""How many times the pull grows until nothing is left of a margin that is thinner than MARGIN and what is
uncertain: there the plan decides whether robots survive, which was made for all of them."""
NEAR = 0.3, 3.0, 0.1
"""How far corrections lead from the planned configuration: alpha and theta in rad, beta in mm."""
EASED = 0.0, 0.5, 0.75, 1.0
"""Parts of a correction that are left out, one after the other, where the robot might snap with all of it."""
STOPS = 2.0
"""Standard deviations of the margin that must be left where sensors cannot be believed, or the robot stops."""
BACK = 6
"""Readings before a doubtful one from which on nothing is believed."""


class State(Enum):
    """Of a tracker; the value is what a person reads."""

    TRACKING = "tracking"
    HELD = "on its plan, not corrected"
    STOPPED = "stopped"


class Note(NamedTuple):
    """What the operator is told at a time, s: in which state the tracker is from then on, and why."""

    time: float
    state: State
    why: str


class Tracker:
    """Leads one robot through a plan. notes: what the operator was told, in order. way: what tubes are led along,
    the plan's until it is planned anew.

    Where sensors cannot be believed, the estimate goes back to what it was before, and is kept, and the motors go
    back to the plan, which decides whether robots survive. It tracks again after silence alone: a registration
    that has jumped may seem right again where little can be told apart. It stops where its margin is not safe by
    then, and after a snap.

    Before anything is commanded, the estimated robot and a less stable one that is likely are moved there, as in
    :func:`~ctr_nlp.loops.lookahead.objection`. Where one would snap, less of the correction is commanded, down to
    nothing of it. Where that does not help, the robot stops where it is.
    """

    def __init__(
        self,
        plan: Plan,
        sensors: Sensors,
        tolerances: Tolerances | None = None,
        known: tuple[Array, Array] | None = None,
    ) -> None:
        """Compile, and wait for it; tolerances: of the robot, None for the plan's.

        known: mean (k,) and covariance (k, k) of the robot's differences, None for what the tolerances say. Where
        these let a force act at the tip, it is estimated, too, and the robot must tell its moduli. Raises
        LoadError, OptionError, RobotError.
        """
        if not plan.complete:
            raise OptionError("the plan has frames without a solution, and cannot be tracked")
        self.plan, self._robot, model = plan, plan.robot, plan.evaluated_on
        differences = Differences.of(plan.robot, tolerances)
        pushed = len(differences.forced) > 0
        model = bearing(model, pushed)
        model.check(plan.robot)
        if known is not None:
            differences = replace(differences, mean=known[0], covariance=known[1])
        places = np.linspace(0.0, 1.0, PLACES)
        count = len(sensors.sigma)
        spare = np.zeros(max(ROOM - count - PLACES, 0))
        structure = differences.draws(differences.mean[None]).structure
        seen = np.concatenate([sensors.sigma, places, spare])
        predictor = Predictor(model, structure, seen, differences.freed, pushed)
        self.observer = Observer(model, differences, sensors, predictor)
        weights = np.full(PLACES, 1.0)
        weights[[0, -1]] /= 2
        self._correction = Correction(plan.robot, np.sqrt(weights / weights.sum()))
        self.way, self._passed = Way.of(plan, model, np.zeros(plan.robot.d)), list[Array]()
        alpha, beta, theta = NEAR
        d = plan.robot.d
        self._near = np.concatenate([np.full(d, alpha), np.full(d, beta), np.full(2, theta)])
        self._betas = slice(d, 2 * d)
        self._at, self._size = slice(count, count + PLACES), len(plan.robot.axes)
        self._doubts, self.state, self.notes = Doubts(), State.TRACKING, list[Note]()
        self._known, self._warned = deque[tuple[Array, Array]](maxlen=BACK), ""
        self.innovations = list[Innovation]()
        self._silent, self._time, self._frame = False, 0.0, 0
        self._begun: float | None = None

    @property
    def tracks(self) -> bool:
        """Whether measurements are believed."""
        return self.state is State.TRACKING

    def step(self, frame: int, q: Array, time: float, readings: Sequence[Reading]) -> Array:
        """Where motors are to be (2d + 2,) in the next frame, within the plan's limits of position and speed.

        frame, from 0, was just reached, with the motors at q (2d + 2,) at a time, s; readings: what arrived since.
        """
        self._frame = frame
        self.observe(q, time, readings)
        if frame + 1 >= len(self.way.q):
            return q
        reach = self._robot.speed * (self.plan.time[frame + 1] - self.plan.time[frame])
        least, most = np.maximum(self._robot.lower, q - reach), np.minimum(self._robot.upper, q + reach)
        return self.wanted(frame + 1, frame, q[:0].reshape(0, len(q)), least, most)

    def outset(self, ahead: Array, frame: int, first: int) -> Outset:
        """Where the rest of the motion will begin, from a later frame, first, on, by what is known now.

        ahead (n, 2d + 2): where the motors will have gone until they are led to a frame; both frames from 0.
        Raises RobotError where no robot is made of tubes as they are estimated.
        """
        there, known, betas = self.observer.ahead(ahead), self.known, self._betas
        beside = there.tubes - self.way.q[frame - 1]
        later = np.clip(self.way.q[frame:first] + beside, known.lower, known.upper)
        later[:, betas] = np.maximum.accumulate(later[:, betas], axis=1)
        before = np.vstack([np.vstack([*self._passed, *ahead]) + there.tubes - there.q, later])
        return Outset(first, known, self.zeros, before, Way(*(rows[first:] for rows in self.way)))

    @property
    def known(self) -> Robot:
        """The robot as it is estimated, with what is left to doubt as tolerances; raises RobotError as outset."""
        return self.observer.differences.robot_at(self.observer.mean, self.observer.covariance)

    @property
    def zeros(self) -> Array:
        """What motors' zeros are estimated to be off by (d,) rad."""
        return self.observer.differences.offsets(self.observer.mean)

    @property
    def beginning(self) -> Outset:
        """The outset of a motion that has not begun; raises RobotError as outset."""
        return Outset(0, self.known, self.zeros, self.way.q[:0], self.way)

    def go_on(self, outset: Outset, rest: Way) -> None:
        """Lead the robot along another way from an outset on."""
        self.way = self.way.then(outset.first, outset.before[-1], rest) if outset.first else rest

    def led(self, places: Array) -> None:
        """The motors have come through places (n, 2d + 2), where nothing was measured."""
        self._passed += list(places)
        self.observer.led(places)

    def observe(self, q: Array, time: float, readings: Sequence[Reading]) -> None:
        """The motors are at q (2d + 2,) at a time, s; readings: what arrived since it was last told."""
        self._time, self._begun = time, time if self._begun is None else self._begun
        self._passed.append(q)
        self.observer.moved(q, time)
        if self.observer.jumps and self.state is not State.STOPPED:
            self._tell(State.STOPPED, f"the robot has snapped, by what is known of it, {self._where}")
        for reading in readings:
            self._read(reading)
        silent = self._doubts.silent(time, self._begun)
        if silent and self.tracks:
            self._silent = True
            self._tell(State.HELD, silent)

    def _tell(self, state: State, why: str) -> None:
        self.state = state
        self.notes.append(Note(self._time, state, why))

    def _read(self, reading: Reading) -> None:
        """Believe a reading, or tell why not."""
        time = self._time
        if self.state is not State.STOPPED:
            self._look_for_snap(reading)
        if self.state is State.STOPPED:
            return
        seen, rates = self.observer.judged(reading), self.observer.rates(reading.time)
        why, outliers = self._doubts.looked(time, reading, seen, rates)
        self.innovations.append(seen)
        if outliers and not self._warned:
            self.notes.append(Note(time, self.state, outliers))
        self._warned = outliers
        if why and self._silent:
            self._silent = False
            self._tell(State.HELD, why)
        elif why and self.tracks:
            if self._known:
                self.observer.restored(*self._known[0])
            self._known.clear()
            self._tell(State.HELD, why)
        elif self.state is State.HELD and self._silent and self._doubts.sound:
            self._silent = False
            self._tell(State.TRACKING, "measurements agree again with what is known")
        if self.tracks:
            self._known.append((self.observer.mean, self.observer.covariance))
            self.observer.measured(reading)

    def _look_for_snap(self, reading: Reading) -> None:
        """Stop where a reading shows the robot in another equilibrium than the estimated one."""
        shape = self.observer.elsewhere(reading)
        if shape is None:
            return
        tip = self._at.stop - 1
        jump = float(np.linalg.norm(shape[tip] - self.observer.predicted.points[tip]))
        self._tell(
            State.STOPPED,
            f"the robot has snapped {self._where}: what is measured fits another equilibrium, whose tip is "
            f"{jump:.0f} mm from where commands should have led it",
        )

    @property
    def _where(self) -> str:
        """Near which frame the robot is, in words."""
        return f"about frame {self._frame + 1}"

    def wanted(self, frame: int, last: int, ahead: Array, least: Array, most: Array) -> Array:
        """Where motors are best (2d + 2,), between least and most, in a frame, from 0, that has not begun.

        ahead (n, 2d + 2): where they will have gone by then, and stay on the way; last: the frame, from 0, that
        the last of these belongs to, or where they are. A robot that is stopped stays.
        """
        there = self.observer.ahead(ahead)
        self._frame = last
        if self.state is State.STOPPED:
            return there.q
        if len(there.jumps) > len(self.observer.jumps):
            self._tell(State.STOPPED, f"the robot as it is estimated would snap on the way ahead {self._where}")
            return there.q
        off = there.tubes - there.q
        held, planned = self.state is State.HELD, self.way.q[frame]
        low, high = self._limits(planned, least + off, most + off)
        start = np.clip(
            self.way.motors[frame] + off if held else there.tubes + planned - self.way.q[last], low, high
        )
        walker = there.walker.copy()
        walker.go(start)
        predicted, margin = there.at(walker)
        deviation = there.deviation(predicted.of_margin)
        if held and margin - STOPS * deviation < 0:
            self._tell(State.STOPPED, f"what is uncertain of the robot exceeds its stability margin {self._where}")
            return there.q
        if held:
            return self._safest(there, predicted, frame, [start - off])
        at, safe = self._place(start, predicted, margin), MARGIN + UNCERTAIN * deviation
        least_margin = float(np.nan_to_num(np.fmin(self.way.stability[frame], safe)))
        thin = 1 - margin / safe if margin < safe else 0.0
        unknown = there.uncertainty(predicted.of_points[:, self._at]) / UNKNOWN
        pull = PULL * (min(1.0, max(LEAST, unknown**2)) + THIN * thin)
        tubes = self._correction(at, self.way.shape[frame], planned, low, high, least_margin, pull)
        motors = np.clip(there.motors(start if tubes is None else tubes), least, most)
        motors[self._betas] = np.maximum.accumulate(motors[self._betas])
        uncorrected = np.clip(start - off, least, most)
        return self._safest(there, predicted, frame, [motors + part * (uncorrected - motors) for part in EASED])

    def _safest(self, there: Observer, predicted: Predicted, frame: int, candidates: Sequence[Array]) -> Array:
        """The first of candidates (2d + 2,) that the robot may be moved to; where it is if it has to stop.

        there: the estimated robot before it is moved to a frame, from 0. predicted: for slopes of its margin.
        """
        if np.isnan(there.margin):  # on this model nothing can snap
            return candidates[0]
        least_margin = min(LEAST_MARGIN, float(self.way.stability[frame]) / 2)
        weaker, why = there.weaker(predicted.of_margin, DEVIATIONS), ""
        for motors in candidates:
            why = objection(there, weaker, motors, least_margin)
            if not why:
                return motors
        self._tell(State.STOPPED, f"frame {frame + 1} is not commanded, and the robot stays {self._where}: {why}")
        return there.q

    def _place(self, q: Array, predicted: Predicted, margin: float) -> Place:
        """The estimated robot with its tubes at q (2d + 2,)."""
        points, slopes = predicted.points[self._at], predicted.of_points[: self._size, self._at]
        return Place(q, points, slopes, margin, predicted.of_margin[: self._size])

    def _limits(self, planned: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Those of the tubes between low and high that are NEAR the planned configuration, or nearest to it."""
        return np.clip(planned - self._near, low, high), np.clip(planned + self._near, low, high)
