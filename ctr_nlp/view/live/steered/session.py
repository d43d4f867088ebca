"""Live steering without a screen: requests to the robot, and its state after every step."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import DEFAULT_MODEL, model_named, model_with_load
from ctr_nlp.models.loads import Load
from ctr_nlp.models.walker import Walker
from ctr_nlp.ocp.compiled_wall import WallDistance
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import ShapeDistance
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.measures import rms_over_sigma
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.support.value_checks import check_choice, number, whole_number
from ctr_nlp.typing import Array, Flags
from ctr_nlp.view.live.steered.drive import Drive, PendingDrive, suitable_models
from ctr_nlp.view.live.steered.ghosts import GHOST_SHAPE_STRIDE, Ghosts
from ctr_nlp.view.live.steered.goal import Goal
from ctr_nlp.view.live.steered.history import MoveHistory, SteeringState
from ctr_nlp.view.live.steered.joints import retracted_configuration, slide_joint, step_towards
from ctr_nlp.view.live.steered.recording import Moment, Recording

STEP_RATE_HZ = 30.0
"""Steps in a second."""
MAX_SAMPLED_ROBOTS = 20
"""Largest number of simulated robots that are moved beside the nominal one."""
NOBODY = np.zeros((0, len(SIGMA_GRID[::GHOST_SHAPE_STRIDE]), 3))
PLAYBACK_TOLERANCE = 1e-9
"""Distance of each joint, rad or mm, from a recorded configuration at which the robot is there."""
EMPTY = "nothing has been recorded; begin to record, and steer"
SHAPE_METHOD, TIP_METHOD, HAND_METHOD = "whole shape", "tip alone", "by hand"
"""Methods: the whole shape follows the target, or the tip alone, or joints go where the sliders are."""
DISTANCES = {
    SHAPE_METHOD: ShapeDistance(),
    TIP_METHOD: ShapeDistance(depth_weights=np.asarray(SIGMA_GRID == 1.0, dtype=float)),
}
STEERING_METHODS = (*DISTANCES, HAND_METHOD)


class SessionState(NamedTuple):
    """State of a session after one step.

    target, shape (101, 3) mm; shape is NaN where no equilibrium is found. q (2d + 2,). error (101,) mm: distance
    at equal sigma; e2 mm: its root mean square over sigma; e3 mm: root mean square of e2 over the recording, NaN
    without one. margin: of stability, NaN where the model has none. clearance (101,) mm, None where no wall is
    known. ghosts (n, 26, 3) mm: shapes of the simulated robots. lost (n,): which of them snapped or left their
    branch. snapped: whether the robot snapped in this step. force (3,) N: dead force at the tip. seconds: duration
    of the step's computation.
    """

    target: Array
    shape: Array
    q: Array
    error: Array
    e2: float
    e3: float
    margin: float
    clearance: Array | None
    ghosts: Array
    lost: Flags
    snapped: bool
    force: Array
    seconds: float


@dataclass
class PlayedMotion:
    """Recorded motion: q (T, 2d + 2), targets (T, 101, 3) mm, and the frame, from 0, that is played next."""

    q: Array
    target: Array
    frame: int = 0

    @property
    def is_finished(self) -> bool:
        """Whether the last frame was reached."""
        return self.frame == len(self.q)

    @property
    def next_configuration(self) -> Array:
        """Configuration (2d + 2,) that the robot goes to next; the last one at the end."""
        return np.asarray(self.q[min(self.frame, len(self.q) - 1)])

    def next_target(self, q: Array) -> Array:
        """Go to the next frame once a robot at q (2d + 2,) has reached this one; return its target (101, 3) mm."""
        # Steps as fast as the motors are end at their goal but for rounding.
        self.frame += bool(np.allclose(q, self.q[self.frame], rtol=0.0, atol=PLAYBACK_TOLERANCE))
        return np.asarray(self.target[min(self.frame, len(self.q) - 1)])


class Session:
    """A robot that is steered step by step. Only one thread may use it."""

    def __init__(
        self,
        problem: Problem,
        model: str = DEFAULT_MODEL,
        settings: Settings = DEFAULT_PLANNER_SETTINGS,
        rate: float = STEP_RATE_HZ,
        load: Load | None = None,
    ) -> None:
        """Place the robot, retracted, at the beginning of a problem's path.

        problem: robot and target. model: name of the kinematic model. settings: weights of steering. rate: steps a
        second. load: constant load on the robot. Until the programs for model and load are compiled, the robot is
        steered unloaded on the simplest model. Raises OptionError where nothing can be compiled, or the model does
        not describe the robot, or knows no load; LoadError where the load cannot be applied to the robot.
        """
        number(OptionError, "rate", rate, lambda x: 0 < x < np.inf, "be a finite number > 0", " 1/s")
        self.problem = problem
        self.settings = settings
        self.dt = 1.0 / rate
        self.load = load
        if load is not None:
            model_with_load(model, load).check(problem.robot)
        self.goal = Goal(problem.target_frames, problem.robot.reach)
        self.method = SHAPE_METHOD
        self.hand = retracted_configuration(problem.robot, problem.target_frames[-1].points)
        self._beside = None if problem.wall is None else WallDistance(problem.wall)
        self._count = 0
        self._ghosts: Ghosts | None = None
        self._recording: Recording | None = None
        self._moves = MoveHistory()
        self._played: PlayedMotion | None = None
        self._drive = Drive.interim(problem, self.hand, self.dt, settings)
        self._robot = self._resting(self.hand)
        self._awaited: PendingDrive | None = None
        self.use_model(model)

    @property
    def q(self) -> Array:
        """Configuration (2d + 2,) in which the motors stand."""
        return self._robot.q

    @property
    def model(self) -> str:
        """Name of the model on which the robot is shown and steered now."""
        return self._drive.model.name

    @property
    def active_load(self) -> Load | None:
        """Load on the robot now; None until the model that knows the load has been compiled."""
        return None if self._drive.model.applied_load is None else self.load

    @property
    def requested_model(self) -> str:
        """Name of the model that was requested last."""
        return self.model if self._awaited is None else self._awaited.model.name

    @property
    def sample_count(self) -> int:
        """Number of simulated robots that are moved beside the nominal one."""
        return self._count

    @property
    def pending_drive(self) -> PendingDrive | None:
        """Drive that is being compiled, or could not be; None where the requested one is in use."""
        return self._awaited

    @property
    def within_lumen(self) -> bool:
        """Whether steps keep the robot within the lumen."""
        return self._drive.within_lumen and self.method != HAND_METHOD

    def use_model(self, model: str) -> None:
        """Show and steer the robot on another model, as soon as its programs are compiled; raises OptionError."""
        check_choice("model", model, suitable_models(self.problem, self.load))
        if self._awaited is not None:
            self._awaited.cancel()
        described = model_named(model) if self.load is None else model_with_load(model, self.load)
        self._awaited = PendingDrive(self.problem, described, self.q, self.dt, self.settings)

    def follow(self, method: str) -> None:
        """Steer by another method, one of STEERING_METHODS; raises OptionError."""
        check_choice("method", method, STEERING_METHODS)
        self._played = None
        if self.method == HAND_METHOD and method != HAND_METHOD:
            # The steerer did not see how a hand has moved the joints since.
            self._drive.steerer.set_configuration(self.q, self._robot.x)
        self.method = method
        self.hand = self.q
        if method != HAND_METHOD:
            self._drive.steerer.set_shape_weights(DISTANCES[method])

    def pull(self, handle: int, point: Array) -> None:
        """Take a handle of the target, from 0, to a point (3,) mm, and end steering by hand; raises
        OptionError.
        """
        before = self._state()
        self.goal.pull(handle, point)
        self._moves.note(f"handle {handle}", before)
        self._played = None
        if self.method == HAND_METHOD:
            self.follow(SHAPE_METHOD)

    def slide(self, joint: int, value: float) -> None:
        """Move joint `joint` of q, from 0, by hand towards a value, rad or mm; raises OptionError."""
        if whole_number(OptionError, "joint", joint, 0) >= len(self.q):
            raise OptionError(f"joint is {joint}; it must be a whole number from 0 to {len(self.q) - 1}")
        number(OptionError, f"the value of joint {joint}", value, np.isfinite, "be a finite number")
        self._moves.note(f"joint {joint}", self._state())
        self._played = None
        if self.method != HAND_METHOD:
            self.follow(HAND_METHOD)
        self.hand = slide_joint(self.problem.robot, self.hand, joint, value)

    def advance(self, progress: float) -> None:
        """Let the target be that of another place along the path, from 0 to 1; raises OptionError."""
        before = self._state()
        self.goal.advance(progress)
        self._moves.note("progress", before)
        self._played = None

    def release(self) -> None:
        """Let the target be the path itself."""
        self._moves.note("release", self._state())
        self.goal.release()
        self._played = None

    def undo(self) -> None:
        """Return target, method and sliders to where they were before the last move; raises OptionError."""
        before = self._moves.pop()
        if before is None:
            raise OptionError("there is no move to undo: nothing was dragged or slid yet")
        self.goal.restore(before.progress, before.displacement)
        self.follow(before.method)
        self.hand = before.hand.copy()

    def play_back(self, plan: Plan) -> None:
        """Move the robot to the first configuration of a recorded plan, and then as it was recorded.

        plan: a recording of this session's robot. Whatever a person moves ends the playback. Raises OptionError
        where the plan is of another robot.
        """
        if plan.robot != self.problem.robot:
            raise OptionError("the recording is of another robot; choose that robot, or record again")
        self.follow(HAND_METHOD)
        self._played = PlayedMotion(plan.q, plan.target)

    @property
    def is_playing_back(self) -> bool:
        """Whether a recording is being played."""
        return self._played is not None

    def _state(self) -> SteeringState:
        """Return what a move may change."""
        return SteeringState(self.goal.progress, self.goal.displacement, self.method, self.hand.copy())

    def set_sample_count(self, count: int) -> None:
        """Move `count` simulated robots beside the nominal one, from rest where it is; raises OptionError."""
        if whole_number(OptionError, "draws", count, 0) > MAX_SAMPLED_ROBOTS:
            raise OptionError(f"draws is {count}; it must be at most {MAX_SAMPLED_ROBOTS}")
        self._count = count
        self._ghosts = Ghosts(self.problem.robot, self._drive.model, self.q, count) if count else None

    def record(self) -> None:
        """Begin to record, and drop an earlier recording; until it ends, the model stays what it is."""
        self._recording = Recording(self.problem, self._drive.model, self.settings, self.dt)

    @property
    def moment_count(self) -> int | None:
        """Number of moments recorded so far; None while no recording is on."""
        return None if self._recording is None else len(self._recording.moments)

    def end_recording(self) -> Recording:
        """End the recording and return it; raises OptionError where nothing was recorded."""
        found = self._recording
        self._recording = None
        if found is None or not found.moments:
            raise OptionError(EMPTY)
        return found

    def plan(self) -> Plan:
        """End the recording and return it as a plan; raises OptionError where nothing was recorded."""
        return self.end_recording().plan()

    def step(self) -> SessionState:
        """Move the robot by dt s, and return the state after it."""
        begin = time.perf_counter()
        # Never within a recording, whose frames must all be of one model.
        if self._awaited is not None and self._awaited.drive is not None and self._recording is None:
            self._switch_drive(self._awaited.drive)
        moment = self._move_robot(self._next_target())
        robot = self.problem.robot
        q = self.q
        shape = self._drive.model.points(robot, self._robot.x[None], SIGMA_GRID)[0]
        ghosts = self._ghosts
        if ghosts is not None:
            ghosts.go(q, self._robot.x)
        error = np.linalg.norm(shape - moment.target, axis=1)
        clearance = None
        if self._beside is not None:
            clearance = self._beside.clearances(robot, robot.split(q)[1][None], shape[None], SIGMA_GRID)[0]
        e2 = float(rms_over_sigma(error))
        if self._recording is not None:
            self._recording.add(moment, e2)
        return SessionState(
            target=moment.target,
            shape=shape,
            q=q,
            error=error,
            e2=e2,
            e3=np.nan if self._recording is None else self._recording.e3,
            margin=self._robot.margin(),
            clearance=clearance,
            ghosts=NOBODY if ghosts is None else ghosts.shapes,
            lost=np.zeros(0, dtype=bool) if ghosts is None else ghosts.lost.copy(),
            snapped=moment.snapped,
            force=np.zeros(3) if self.active_load is None else self.active_load.numbers(robot.d)[:3],
            seconds=time.perf_counter() - begin,
        )

    def _next_target(self) -> Array:
        """Return the target (101, 3) mm of this step; while a recording is played, take the joints along it."""
        if self._played is None:
            return self.goal.points
        target = self._played.next_target(self.q)
        self.hand = self._played.next_configuration
        if self._played.is_finished:
            self._played = None
        return target

    def _switch_drive(self, drive: Drive) -> None:
        """Continue on another drive from where the robot stands."""
        q = self.q
        self._drive = drive
        self._awaited = None
        self._robot = self._resting(q)
        drive.steerer.set_configuration(q, self._robot.x)
        self.follow(self.method)
        self.set_sample_count(self._count)

    def _resting(self, q: Array) -> Walker:
        """Return the robot at rest at q (2d + 2,), without a history."""
        robot = self.problem.robot
        return self._drive.model.walker(robot.structure, robot.numbers, q)

    def _move_robot(self, target: Array) -> Moment:
        """Move the robot by one step to `target` (101, 3) mm; a robot that loses its equilibrium comes to rest, a
        snap.
        """
        steerer = self._drive.steerer
        begin = time.perf_counter()
        if self.method == HAND_METHOD:
            q = step_towards(self.problem.robot, self.q, self.hand, self.dt)
            solved = (np.nan, np.nan, np.nan)
        else:
            q = steerer.step(target, self.goal.progress)
            solved = steerer.objective, steerer.kkt, time.perf_counter() - begin
        snapped = bool(self._robot.move_to(q))
        if not np.isfinite(self._robot.x).all():
            self._robot = self._resting(q)
            snapped = True
        if snapped:
            # The steerer predicts from its own equilibrium, which the snap has left behind.
            steerer.set_configuration(q, self._robot.x)
        return Moment(q, target, snapped, *solved)
