"""Closed-loop tracking of a plan: observe, correct, and fall back to the plan where sensing fails."""

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
"""Least number of points for which predictions are compiled, so that robots of a kind share the compiled code
whatever their sensors."""
PLAN_PULL_COST_MM2, MIN_PLAN_PULL_SHARE = 0.03, 0.1
"""Cost, mm^2, of a mm away from the planned configuration (W as in the motion term) while the robot is uncertain,
and the share of it that remains once the robot is identified."""
FULL_PULL_UNCERTAINTY_MM = 0.5
"""Uncertainty of the estimated shape, mm, root mean square over points, at which the full pull applies."""
TRACKER_STABILITY_MARGIN = 0.25
"""Least stability margin of the estimated robot without uncertainty; at most the planned one."""
MARGIN_RAISE_DEVIATIONS = 2.0
"""Standard deviations of the margin by which the least one is raised, up to the planned one."""
THIN_MARGIN_PULL_FACTOR = 1000.0
"""Growth of the pull as the margin falls from its safe value to 0: near a snap the plan, which was made for all
robots within the tolerances, is safer than a correction for the estimated one.
"""
MAX_CORRECTION_RAD_MM_RAD = 0.3, 3.0, 0.1
"""Largest corrections of the planned configuration: of alpha in rad, beta in mm, theta in rad."""
OMITTED_CORRECTION_SHARES = 0.0, 0.5, 0.75, 1.0
"""Shares of a correction that are left out, one after the other, where the robot might snap with all of it."""
STOP_MARGIN_DEVIATIONS = 2.0
"""Standard deviations of the margin that must remain where sensors are rejected, or the robot stops."""
ROLLBACK_READINGS = 6
"""Number of readings before a rejected one that are undone, too."""


class TrackerState(Enum):
    """State of a tracker; its value is the text for the operator."""

    TRACKING = "tracking"
    UNCORRECTED = "on its plan, not corrected"
    STOPPED = "stopped"


class Note(NamedTuple):
    """Message to the operator at a time, s: the state of the tracker from then on, and why."""

    time: float
    state: TrackerState
    why: str


class Tracker:
    """Closed-loop tracker of one robot along a plan.

    notes: messages to the operator, in order. reference: trajectory of the tubes, the plan's until it is
    re-planned.

    Where readings are rejected, the estimate is rolled back and frozen, and the motors return to the plan, which
    is stable for all robots within the tolerances. Tracking resumes after silence only: a registration that has
    jumped may seem right again where readings have little information. The robot stops where its margin is not
    safe then, and after a snap.

    Before every command, the estimated robot and a less stable one are simulated
    (:func:`~ctr_nlp.identify.closed_loop.lookahead.objection`). Where one would snap, less of the correction is
    commanded, down to nothing. Where that does not help, the robot stops.
    """

    def __init__(
        self,
        plan: Plan,
        sensors: Sensors,
        tolerances: Tolerances | None = None,
        prior: tuple[Array, Array] | None = None,
    ) -> None:
        """Compile, and wait for it.

        plan: to track, completely solved. sensors: of the robot. tolerances: of the robot, None for the plan's;
        with a tip force, that is estimated, too, and the robot must have Young's moduli in MPa. prior: mean (k,)
        and covariance (k, k) of the robot's differences, None for those of the tolerances. Raises LoadError,
        OptionError, RobotError.
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
        """Whether measurements are used."""
        return self.state is TrackerState.TRACKING

    def step(self, frame: int, q: Array, time: float, readings: Sequence[Reading]) -> Array:
        """Return the command for the motors (2d + 2,) in the next frame, within limits of position and speed.

        frame: just reached, from 0. q: (2d + 2,), configuration of the motors there. time: s. readings: that have
        arrived since the last step.
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
        """Return the start of a re-planned rest of the motion, by the present estimate.

        ahead: (n, 2d + 2), configurations that the motors pass until `frame`. frame: the next one to be commanded.
        first: the first one of the rest; both from 0. Raises RobotError where the estimated tubes are not valid.
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
        """The estimated robot, with the remaining uncertainty as tolerances; raises RobotError."""
        return self.observer.differences.robot_at(self.observer.mean, self.observer.covariance)

    @property
    def zeros(self) -> Array:
        """Estimated motors' zeros (d,), rad."""
        return self.observer.differences.offsets(self.observer.mean)

    @property
    def motion_start(self) -> ReplanningStart:
        """Start of the whole motion, before it has begun; raises RobotError as replanning_start."""
        return ReplanningStart(0, self.estimated_robot, self.zeros, self.reference.q[:0], self.reference)

    def switch_reference(self, start: ReplanningStart, rest: ReferenceTrajectory) -> None:
        """Track another trajectory; start: where it begins. rest: the trajectory from there on."""
        self.reference = (
            self.reference.splice_at(start.first, start.passed_configurations[-1], rest) if start.first else rest
        )

    def apply_past_motion(self, configurations: Array) -> None:
        """Simulate a past motion through configurations (n, 2d + 2) in which nothing was measured."""
        self._passed += list(configurations)
        self.observer.apply_past_motion(configurations)

    def observe(self, q: Array, time: float, readings: Sequence[Reading]) -> None:
        """Update the estimate; q: (2d + 2,), of the motors at a time, s. readings: that have arrived since."""
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
        """Use a reading for the estimate, or reject it with a message."""
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
            # A fault is noticed late: the estimate before the last ROLLBACK_READINGS readings is free of it.
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
        """Stop the robot where a reading fits another equilibrium than the estimated one."""
        shape = self.observer.find_other_equilibrium(reading)
        if shape is None:
            return
        tip = self._at.stop - 1
        jump = float(np.linalg.norm(shape[tip] - self.observer.predicted.points[tip]))
        self._set_state(
            TrackerState.STOPPED,
            f"the robot has snapped {self._where}: what is measured fits another equilibrium, whose tip is "
            f"{jump:.0f} mm from where commands should have moved it",
        )

    @property
    def _where(self) -> str:
        """Text with the present frame."""
        return f"about frame {self._frame + 1}"

    def compute_command(self, frame: int, last: int, ahead: Array, least: Array, most: Array) -> Array:
        """Return the command for the motors (2d + 2,) in a coming frame; a stopped robot stays.

        frame: from 0. last: frame, from 0, of the last configuration ahead, or the present one. ahead: (n, 2d +
        2), commands that are fixed already. least, most: (2d + 2,), limits of the command.
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
        # Limits and commands are of motors, the reference and the correction of tubes: `off` is between them.
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
        # The pull to the plan falls with the variance of the shape: what is not identified is left as planned.
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
        """Return the first of candidates (2d + 2,) to which the robot may be moved; its present q if none is.

        there: the estimated robot before the motion. predicted: its shape, with slopes of its margin. frame: from
        0.
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
        """Return the estimated robot with its tubes at q (2d + 2,), linearised; margin: of stability there."""
        points = predicted.points[self._at]
        slopes = predicted.of_points[: self._size, self._at]
        return LinearisedRobot(q, points, slopes, margin, predicted.of_margin[: self._size])

    def _limits(self, planned: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Return limits of the tubes: within MAX_CORRECTION_RAD_MM_RAD of `planned`, clipped to low and high.

        All are (2d + 2,), rad and mm.
        """
        return np.clip(planned - self._near, low, high), np.clip(planned + self._near, low, high)
