"""Steering along a plan by what sensors tell of the robot: observe, correct, and fall back where sensing fails."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.closed_loop.correction import Correction, LinearisedRobot
from ctr_nlp.identify.closed_loop.lookahead import LEAST_MARGIN, SNAP_SAFETY_DEVIATIONS, objection
from ctr_nlp.identify.closed_loop.observer import Innovation, Observer
from ctr_nlp.identify.closed_loop.parameter_differences import ParameterDifferences
from ctr_nlp.identify.closed_loop.prediction import PredictedShape, Predictor
from ctr_nlp.identify.closed_loop.replanning.reference_trajectory import (
    TRACKED_SHAPE_POINTS,
    ReferenceTrajectory,
    ReplanningStart,
)
from ctr_nlp.identify.closed_loop.sensor_monitor import SensorMonitor
from ctr_nlp.identify.closed_loop.sensors import Reading, Sensors
from ctr_nlp.models import model_for_tip_forces
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot, Tolerances
from ctr_nlp.typing import Array

MIN_PREDICTION_PLACES = 24
"""Places for which predictions are compiled at least, so that robots of a kind share them whatever their sensors.
"""
PLAN_PULL_COST_MM2, MIN_PLAN_PULL_SHARE = 0.03, 0.1
"""mm^2 that a mm away from the planned configuration costs, W as in the motion term, while the robot is not known;
and the part of that which is left once it is."""
FULL_PULL_UNCERTAINTY_MM = 0.5
"""mm by which the estimated shape is uncertain, as root mean square over places, where the whole pull counts."""
TRACKER_STABILITY_MARGIN = 0.25
"""The least stability margin of the estimated robot, where nothing is uncertain; not more than was planned."""
MARGIN_RAISE_DEVIATIONS = 2.0
"""Standard deviations of the margin by which that is raised for what is uncertain, up to the planned one."""
THIN_MARGIN_PULL_FACTOR = 1000.0
"""How many times the pull grows until nothing is left of a margin that is thinner than TRACKER_STABILITY_MARGIN
and what is uncertain: there the plan decides whether robots survive, which was made for all of them.
"""
MAX_CORRECTION_RAD_MM_RAD = 0.3, 3.0, 0.1
"""How far corrections lead from the planned configuration: alpha and theta in rad, beta in mm."""
OMITTED_CORRECTION_SHARES = 0.0, 0.5, 0.75, 1.0
"""Parts of a correction that are left out, one after the other, where the robot might snap with all of it."""
STOP_MARGIN_DEVIATIONS = 2.0
"""Standard deviations of the margin that must be left where sensors cannot be believed, or the robot stops."""
ROLLBACK_READINGS = 6
"""Readings before a doubtful one from which on nothing is believed."""


class TrackerState(Enum):
    """Of a tracker; the value is what a person reads."""

    TRACKING = "tracking"
    UNCORRECTED = "on its plan, not corrected"
    STOPPED = "stopped"


class Note(NamedTuple):
    """What the operator is told at a time, s: in which state the tracker is from then on, and why."""

    time: float
    state: TrackerState
    why: str


class Tracker:
    """Leads one robot through a plan. notes: what the operator was told, in order. reference: what tubes are led
    along, the plan's until it is planned anew.

    Where sensors cannot be believed, the estimate goes back to what it was before, and is kept, and the motors go
    back to the plan, which decides whether robots survive. It tracks again after silence alone: a registration
    that has jumped may seem right again where little can be told apart. It stops where its margin is not safe by
    then, and after a snap.

    Before anything is commanded, the estimated robot and a less stable one that is likely are moved there, as in
    :func:`~ctr_nlp.identify.closed_loop.lookahead.objection`. Where one would snap, less of the correction is
    commanded, down to nothing of it. Where that does not help, the robot stops where it is.
    """

    def __init__(
        self,
        plan: Plan,
        sensors: Sensors,
        tolerances: Tolerances | None = None,
        prior: tuple[Array, Array] | None = None,
    ) -> None:
        """Compile, and wait for it; tolerances: of the robot, None for the plan's.

        prior: mean (k,) and covariance (k, k) of the robot's differences, None for what the tolerances say. Where
        these let a force act at the tip, it is estimated, too, and the robot must tell its moduli. Raises
        LoadError, OptionError, RobotError.
        """
        if not plan.complete:
            raise OptionError("the plan has frames without a solution, and cannot be tracked")
        self.plan = plan
        self._robot = plan.robot
        model = plan.evaluated_model
        differences = ParameterDifferences.of(plan.robot, tolerances)
        pushed = len(differences.force_indices) > 0
        model = model_for_tip_forces(model, pushed)
        model.check(plan.robot)
        if prior is not None:
            differences = replace(differences, mean=prior[0], covariance=prior[1])
        places = np.linspace(0.0, 1.0, TRACKED_SHAPE_POINTS)
        count = len(sensors.sigma)
        spare = np.zeros(max(MIN_PREDICTION_PLACES - count - TRACKED_SHAPE_POINTS, 0))
        structure = differences.perturbed_robots(differences.mean[None]).structure
        seen = np.concatenate([sensors.sigma, places, spare])
        predictor = Predictor(model, structure, seen, differences.tube_parts, pushed)
        self.observer = Observer(model, differences, sensors, predictor)
        weights = np.full(TRACKED_SHAPE_POINTS, 1.0)
        weights[[0, -1]] /= 2
        self._correction = Correction(plan.robot, np.sqrt(weights / weights.sum()))
        self.reference = ReferenceTrajectory.from_plan(plan, model, np.zeros(plan.robot.d))
        self._passed = list[Array]()
        alpha, beta, theta = MAX_CORRECTION_RAD_MM_RAD
        d = plan.robot.d
        self._near = np.concatenate([np.full(d, alpha), np.full(d, beta), np.full(2, theta)])
        self._betas = slice(d, 2 * d)
        self._at = slice(count, count + TRACKED_SHAPE_POINTS)
        self._size = len(plan.robot.axes)
        self._doubts = SensorMonitor()
        self.state = TrackerState.TRACKING
        self.notes = list[Note]()
        self._known = deque[tuple[Array, Array]](maxlen=ROLLBACK_READINGS)
        self._warned = ""
        self.innovations = list[Innovation]()
        self._silent = False
        self._time = 0.0
        self._frame = 0
        self._begun: float | None = None

    @property
    def is_tracking(self) -> bool:
        """Whether measurements are believed."""
        return self.state is TrackerState.TRACKING

    def step(self, frame: int, q: Array, time: float, readings: Sequence[Reading]) -> Array:
        """Where motors are to be (2d + 2,) in the next frame, within the plan's limits of position and speed.

        frame, from 0, was just reached, with the motors at q (2d + 2,) at a time, s; readings: what arrived since.
        """
        self._frame = frame
        self.observe(q, time, readings)
        if frame + 1 >= len(self.reference.q):
            return q
        reach = self._robot.speed * (self.plan.time[frame + 1] - self.plan.time[frame])
        least = np.maximum(self._robot.lower, q - reach)
        most = np.minimum(self._robot.upper, q + reach)
        return self.compute_command(frame + 1, frame, q[:0].reshape(0, len(q)), least, most)

    def replanning_start(self, ahead: Array, frame: int, first: int) -> ReplanningStart:
        """Where the rest of the motion will begin, from a later frame, first, on, by what is known now.

        ahead (n, 2d + 2): where the motors will have gone until they are led to a frame; both frames from 0.
        Raises RobotError where no robot is made of tubes as they are estimated.
        """
        there = self.observer.copy_after_motion(ahead)
        known = self.estimated_robot
        betas = self._betas
        beside = there.tubes - self.reference.q[frame - 1]
        later = np.clip(self.reference.q[frame:first] + beside, known.lower, known.upper)
        later[:, betas] = np.maximum.accumulate(later[:, betas], axis=1)
        before = np.vstack([np.vstack([*self._passed, *ahead]) + there.tubes - there.q, later])
        return ReplanningStart(
            first, known, self.zeros, before, ReferenceTrajectory(*(rows[first:] for rows in self.reference))
        )

    @property
    def estimated_robot(self) -> Robot:
        """The robot as it is estimated, with what is left to doubt as tolerances; raises RobotError as outset."""
        return self.observer.differences.robot_at(self.observer.mean, self.observer.covariance)

    @property
    def zeros(self) -> Array:
        """What motors' zeros are estimated to be off by (d,) rad."""
        return self.observer.differences.offsets(self.observer.mean)

    @property
    def motion_start(self) -> ReplanningStart:
        """The outset of a motion that has not begun; raises RobotError as outset."""
        return ReplanningStart(0, self.estimated_robot, self.zeros, self.reference.q[:0], self.reference)

    def switch_reference(self, start: ReplanningStart, rest: ReferenceTrajectory) -> None:
        """Lead the robot along another way from an outset on."""
        self.reference = (
            self.reference.splice_at(start.first, start.passed_configurations[-1], rest) if start.first else rest
        )

    def apply_past_motion(self, configurations: Array) -> None:
        """The motors have come through configurations (n, 2d + 2), where nothing was measured."""
        self._passed += list(configurations)
        self.observer.apply_past_motion(configurations)

    def observe(self, q: Array, time: float, readings: Sequence[Reading]) -> None:
        """The motors are at q (2d + 2,) at a time, s; readings: what arrived since it was last told."""
        self._time = time
        self._begun = time if self._begun is None else self._begun
        self._passed.append(q)
        self.observer.move_motors(q, time)
        if self.observer.jumps and self.state is not TrackerState.STOPPED:
            self._set_state(TrackerState.STOPPED, f"the robot has snapped, by what is known of it, {self._where}")
        for reading in readings:
            self._read(reading)
        silent = self._doubts.silence_reason(time, self._begun)
        if silent and self.is_tracking:
            self._silent = True
            self._set_state(TrackerState.UNCORRECTED, silent)

    def _set_state(self, state: TrackerState, why: str) -> None:
        self.state = state
        self.notes.append(Note(self._time, state, why))

    def _read(self, reading: Reading) -> None:
        """Believe a reading, or tell why not."""
        time = self._time
        if self.state is not TrackerState.STOPPED:
            self._look_for_snap(reading)
        if self.state is TrackerState.STOPPED:
            return
        seen = self.observer.compute_innovation(reading)
        rates = self.observer.rates(reading.time)
        why, outliers = self._doubts.check_reading(time, reading, seen, rates)
        self.innovations.append(seen)
        if outliers and not self._warned:
            self.notes.append(Note(time, self.state, outliers))
        self._warned = outliers
        if why and self._silent:
            self._silent = False
            self._set_state(TrackerState.UNCORRECTED, why)
        elif why and self.is_tracking:
            if self._known:
                self.observer.restore_estimate(*self._known[0])
            self._known.clear()
            self._set_state(TrackerState.UNCORRECTED, why)
        elif self.state is TrackerState.UNCORRECTED and self._silent and self._doubts.sound:
            self._silent = False
            self._set_state(TrackerState.TRACKING, "measurements agree again with what is known")
        if self.is_tracking:
            self._known.append((self.observer.mean, self.observer.covariance))
            self.observer.update_estimate(reading)

    def _look_for_snap(self, reading: Reading) -> None:
        """Stop where a reading shows the robot in another equilibrium than the estimated one."""
        shape = self.observer.find_other_equilibrium(reading)
        if shape is None:
            return
        tip = self._at.stop - 1
        jump = float(np.linalg.norm(shape[tip] - self.observer.predicted.points[tip]))
        self._set_state(
            TrackerState.STOPPED,
            f"the robot has snapped {self._where}: what is measured fits another equilibrium, whose tip is "
            f"{jump:.0f} mm from where commands should have led it",
        )

    @property
    def _where(self) -> str:
        """Near which frame the robot is, in words."""
        return f"about frame {self._frame + 1}"

    def compute_command(self, frame: int, last: int, ahead: Array, least: Array, most: Array) -> Array:
        """Where motors are best (2d + 2,), between least and most, in a frame, from 0, that has not begun.

        ahead (n, 2d + 2): where they will have gone by then, and stay on the way; last: the frame, from 0, that
        the last of these belongs to, or where they are. A robot that is stopped stays.
        """
        there = self.observer.copy_after_motion(ahead)
        self._frame = last
        if self.state is TrackerState.STOPPED:
            return there.q
        if len(there.jumps) > len(self.observer.jumps):
            self._set_state(
                TrackerState.STOPPED, f"the robot as it is estimated would snap on the way ahead {self._where}"
            )
            return there.q
        off = there.tubes - there.q
        held = self.state is TrackerState.UNCORRECTED
        planned = self.reference.q[frame]
        low, high = self._limits(planned, least + off, most + off)
        start = np.clip(
            self.reference.motors[frame] + off if held else there.tubes + planned - self.reference.q[last],
            low,
            high,
        )
        walker = there.walker.copy()
        walker.move_to(start)
        predicted, margin = there.predict_at(walker)
        deviation = there.deviation(predicted.of_margin)
        if held and margin - STOP_MARGIN_DEVIATIONS * deviation < 0:
            self._set_state(
                TrackerState.STOPPED, f"what is uncertain of the robot exceeds its stability margin {self._where}"
            )
            return there.q
        if held:
            return self._safest(there, predicted, frame, [start - off])
        at = self._linearise_at(start, predicted, margin)
        safe = TRACKER_STABILITY_MARGIN + MARGIN_RAISE_DEVIATIONS * deviation
        least_margin = float(np.nan_to_num(np.fmin(self.reference.stability[frame], safe)))
        thin = 1 - margin / safe if margin < safe else 0.0
        unknown = there.uncertainty(predicted.of_points[:, self._at]) / FULL_PULL_UNCERTAINTY_MM
        pull = PLAN_PULL_COST_MM2 * (
            min(1.0, max(MIN_PLAN_PULL_SHARE, unknown**2)) + THIN_MARGIN_PULL_FACTOR * thin
        )
        tubes = self._correction(at, self.reference.shape[frame], planned, low, high, least_margin, pull)
        motors = np.clip(there.motors(start if tubes is None else tubes), least, most)
        motors[self._betas] = np.maximum.accumulate(motors[self._betas])
        uncorrected = np.clip(start - off, least, most)
        return self._safest(
            there, predicted, frame, [motors + part * (uncorrected - motors) for part in OMITTED_CORRECTION_SHARES]
        )

    def _safest(
        self, there: Observer, predicted: PredictedShape, frame: int, candidates: Sequence[Array]
    ) -> Array:
        """The first of candidates (2d + 2,) that the robot may be moved to; where it is if it has to stop.

        there: the estimated robot before it is moved to a frame, from 0. predicted: for slopes of its margin.
        """
        if np.isnan(there.margin):  # on this model nothing can snap
            return candidates[0]
        least_margin = min(LEAST_MARGIN, float(self.reference.stability[frame]) / 2)
        weaker = there.weaker_robot(predicted.of_margin, SNAP_SAFETY_DEVIATIONS)
        why = ""
        for motors in candidates:
            why = objection(there, weaker, motors, least_margin)
            if not why:
                return motors
        self._set_state(
            TrackerState.STOPPED, f"frame {frame + 1} is not commanded, and the robot stays {self._where}: {why}"
        )
        return there.q

    def _linearise_at(self, q: Array, predicted: PredictedShape, margin: float) -> LinearisedRobot:
        """The estimated robot with its tubes at q (2d + 2,)."""
        points = predicted.points[self._at]
        slopes = predicted.of_points[: self._size, self._at]
        return LinearisedRobot(q, points, slopes, margin, predicted.of_margin[: self._size])

    def _limits(self, planned: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Those of the tubes between low and high that are MAX_CORRECTION_RAD_MM_RAD the planned configuration, or
        nearest to it.
        """
        return np.clip(planned - self._near, low, high), np.clip(planned + self._near, low, high)
