"""Playback of one trajectory on a started device to its last frame, with the arm in step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from ctr_nlp.exceptions import DeviceFault, TrajectoryError
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.devices import MotionProgress, RunningMotion, Standing
from ctr_nlp.hardware.devices.arms import ArmFollower, OutOfStep
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.motion.lookahead import FollowedPath
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.results import Ending, PlaybackOutcome, PlayerState, Wishes
from ctr_nlp.hardware.playing.supervision import MISPLACED, Supervisor
from ctr_nlp.typing import Array

MAX_ARM_EXTRAPOLATION_S = 0.1
"""s for which the arm goes on without a report of the device."""

CATCHING_UP = 0.5
"""s after a gap in the device's reports for which the arm may still be out of step because of it."""

IN_STEP = 0.005
"""rad by which the arm may be off the tilts that the device's progress, within the skew tolerance, requires."""

ARM_GOAL_TOLERANCE_RAD = 1e-3
"""rad by which the arm may be off the last frame, ARM_SETTLING_TIME_S s after the axes are there."""

ARM_SETTLING_TIME_S = 0.5

SEEN_LATE = 0.1
"""s of motion by which reported progress may be ahead of the axes, as reports are rounded."""

STOP_OVERRUN_S = 0.5
"""s of motion beyond what the device was given within which a stop comes to rest on the path."""

PLAYBACK_PERIOD_S = 0.005
"""s between two updates of the device, or of the arm while it settles."""

Seen = Callable[[Trajectory, MotionProgress], None]


class TrajectoryCorrector(Protocol):
    """Corrector of a motion while it is played.

    wrong: why the motion must stop, "" where it need not.
    """

    @property
    def wrong(self) -> str:
        """Reason to stop as of the last look, "" for none."""

    def look(self, progress: MotionProgress, committed_time: float) -> Trajectory:
        """Return the motion as it is from now on.

        progress: of the device. committed_time: s of the motion up to which it must not be changed.
        """


class Playback:
    """Playback of a trajectory, with an arm or None that follows the device's progress and must keep in step.

    journal: of the session. wishes: of the operator. report_state: called with the states running and hold.
    corrector: changes what is still ahead, None for nothing. frame: the last that was passed.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        arm: ArmFollower | None,
        journal: Journal,
        clock: Clock,
        wishes: Wishes,
        report_state: Callable[[PlayerState], None],
        corrector: TrajectoryCorrector | None = None,
    ) -> None:
        self._trajectory = trajectory
        self._arm = arm
        self._corrects = corrector
        self._journal = journal
        self._clock = clock
        self._wishes = wishes
        self._to = report_state
        self._held = False
        self._between = (0.0, 0.0)
        """s of the motion between which the axes are: from the reported progress to what was sent."""
        self._stamp = self._gap_end = -np.inf
        self._gap = 0.0
        """s without a report of the device, the longest gap lately, which ended at _gap_end (s of the clock)."""
        self.frame = int(trajectory.frames[0])

    def check_start(self, standing: Standing) -> None:
        """Raise TrajectoryError unless the axes stand where the trajectory starts.

        standing: of the device at rest.
        """
        start = self._trajectory.positions(0.0)
        for axis, wanted, there in zip(self._trajectory.hardware.axes, start, standing.position, strict=True):
            if abs(wanted - there) > axis.tolerance:
                raise TrajectoryError(
                    f"axis {axis.letter} ({axis.joint}) stands at {there:.4g} {axis.unit}, and frame "
                    f"{self.frame} is at {wanted:.4g}: nothing jumps by more than {axis.tolerance:g}"
                )

    def explain_misplacement(self, position: Array) -> str:
        """Return why axes at rest at a position (m,) are not to be trusted, "" where they are."""
        tolerance = self._trajectory.hardware.tolerance
        path = FollowedPath(self._trajectory.positions(0.0), self._trajectory.commands(), tolerance)
        pieces = len(path.ends) - 1
        first, last = np.clip(np.searchsorted(path.ends, self._between, "right") - 1, 0, pieces - 1)
        away = path.nearest(position, int(first), int(last) + 1).away
        if away <= MISPLACED:
            return ""
        return f"the axes rest {away:.3g} tolerances from where they should: their position is not to be trusted"

    def run(self, played: RunningMotion, resolution: Array, callback: Seen | None) -> Ending:
        """Play until the end, or until something is wrong; raises DeviceFault, JournalError.

        played: the started motion. resolution (m,): of the device's axes, in their units. callback: called with
        the trajectory and the progress every few ms, None for nothing.
        """
        hardware = self._trajectory.hardware
        supervisor = Supervisor(hardware.late, resolution, hardware.tolerance, self._due)
        while True:
            progress = played.update()
            self._between = progress.time - SEEN_LATE, played.committed_time + STOP_OVERRUN_S
            self._note_gap(progress.stamp)
            self._tell(progress)
            wrong = supervisor.violation(progress, self._clock.now())
            if wrong is None and self._corrects is not None:
                wrong = self._apply_correction(self._corrects, played, progress)
            if wrong is not None:
                where = f"{progress.time:.2f} s after the start, frame {self.frame} being the last passed"
                return wrong._replace(message=f"{wrong.message} ({where})")
            if callback is not None:
                callback(self._trajectory, progress)
            if progress.state == "done":
                return self._check_goal(progress, resolution)
            if self._wishes.is_abort_requested():
                return Ending(PlaybackOutcome.CANCELLED, f"stopped on request, after frame {self.frame}")
            self._obey(played, progress, supervisor)
            if self._arm is not None and not self._held:
                self._lead(self._arm, progress)
            # Last: more motion is given only after everything has been checked in this round.
            played.feed()
            self._clock.sleep(PLAYBACK_PERIOD_S)

    def _due(self, time: float) -> Array:
        """Return where the axes (m,) should be at a time of the motion, s; after its end they rest."""
        return self._trajectory.positions(min(time, self._trajectory.duration))

    def _tell(self, progress: MotionProgress) -> None:
        """Record every frame that has been passed, with the position when that was reported."""
        passed = self._trajectory.frames[self._trajectory.frame_time <= progress.time + 1e-9]
        if progress.state == "done":
            passed = self._trajectory.frames
        for frame in passed[passed > self.frame].tolist():
            self.frame = frame
            self._journal.record("frame", frame=frame, position=progress.position.tolist())

    def _apply_correction(
        self, corrector: TrajectoryCorrector, played: RunningMotion, progress: MotionProgress
    ) -> Ending | None:
        """Let the corrector change what is still ahead; return the ending where it must stop."""
        trajectory = corrector.look(progress, played.committed_time)
        if trajectory is not self._trajectory:
            self._trajectory = trajectory
            played.amend(trajectory.commands())
        return Ending(PlaybackOutcome.PATH_TOLERANCE_VIOLATED, corrector.wrong) if corrector.wrong else None

    def _obey(self, played: RunningMotion, progress: MotionProgress, supervisor: Supervisor) -> None:
        """Pause or resume as the operator wishes, once the device can."""
        wish = self._wishes.latest
        if progress.state == "held" and not self._held:
            if self._arm is not None:
                self._arm.hold()
            self._rest(True)
        if progress.state == "holding" and wish == "resume":
            return
        if progress.state == "running" and wish == "pause":
            played.hold()
            supervisor.note_pause()
        if progress.state == "held" and wish == "resume":
            played.resume()
            supervisor.note_resume()
            self._rest(False)
        self._wishes.clear_wish()

    def _rest(self, held: bool) -> None:
        """Note and report that the motion rests in a hold, or that it does not."""
        self._held = held
        self._to(PlayerState.HOLD if held else PlayerState.RUNNING)

    def _note_gap(self, stamp: float) -> None:
        """Remember the longest recent gap between reports, for as long as the arm may suffer from it; stamp: s."""
        gap = stamp - self._stamp if np.isfinite(self._stamp) else 0.0
        if gap >= self._gap or stamp - self._gap_end > CATCHING_UP:
            self._gap = gap
            self._gap_end = stamp
        self._stamp = stamp

    def _lead(self, arm: ArmFollower, progress: MotionProgress) -> None:
        """Let the arm follow the device's progress; raises DeviceFault where it does not, or cannot."""
        try:
            self._follow(arm, progress)
        except OutOfStep as exception:
            gap = max(self._gap, self._clock.now() - progress.stamp)
            if gap <= MAX_ARM_EXTRAPOLATION_S:
                raise
            raise DeviceFault(
                f"the device reported no position for {gap:.2g} s: its reports are late, and the arm, which goes "
                f"on for {MAX_ARM_EXTRAPOLATION_S:g} s without them, cannot make up for that ({exception})"
            ) from exception

    def _follow(self, arm: ArmFollower, progress: MotionProgress) -> None:
        """Command the arm's tilt of now and check its measured one; raises DeviceFault."""
        described = self._trajectory.hardware.arm
        tolerance = 0.0 if described is None else described.skew_tolerance
        late = self._clock.now() - progress.stamp
        # The report is old by `late`: a running device has gone on since, a slowing one by an unknown part of it.
        now = progress.time + (min(late, MAX_ARM_EXTRAPOLATION_S) if progress.state == "running" else 0.0)
        arm.follow(self._trajectory.tilt(now))
        # In step means within a time, not an angle: a fast tilt may be further off than a slow one.
        around = self._trajectory.tilt(now + np.linspace(-1.0, 1.0, 21) * tolerance)
        away = np.linalg.norm(around - arm.tilt(), axis=1).min()
        if away > IN_STEP:
            raise OutOfStep(
                f"the arm is not in step: {np.degrees(away):.2g} deg from every tilt within {tolerance:g} s"
            )

    def _settle_arm(self, arm: ArmFollower) -> float:
        """Let the arm come to the last tilt and rest; return by how much it stays off, rad."""
        end = self._clock.now() + ARM_SETTLING_TIME_S
        theta = self._trajectory.tilt(self._trajectory.duration)
        arm.follow(theta)
        while (
            off := float(np.linalg.norm(arm.tilt() - theta))
        ) > 0.1 * ARM_GOAL_TOLERANCE_RAD and self._clock.now() < end:
            self._clock.sleep(PLAYBACK_PERIOD_S)
            arm.follow(theta)
        arm.hold()
        return off

    def _check_goal(self, progress: MotionProgress, resolution: Array) -> Ending:
        """Return the ending of a motion whose device is done: success, or how far axes or arm are off."""
        goal = self._trajectory.positions(self._trajectory.duration)
        tilted = 0.0 if self._arm is None else self._settle_arm(self._arm)
        standing = Standing(progress.position, True)
        self._between = self._trajectory.duration, self._trajectory.duration
        off = abs(progress.position - goal) / resolution
        if off.max() > 1.0:
            axis = self._trajectory.hardware.axes[int(off.argmax())]
            message = f"axis {axis.letter} ({axis.joint}) stands {off.max():.3g} steps from the last frame"
            return Ending(PlaybackOutcome.GOAL_TOLERANCE_VIOLATED, message, standing)
        if tilted > ARM_GOAL_TOLERANCE_RAD:
            message = f"the arm stands {np.degrees(tilted):.2g} deg from the last frame"
            return Ending(PlaybackOutcome.GOAL_TOLERANCE_VIOLATED, message, standing)
        return Ending(PlaybackOutcome.SUCCESS, f"frame {self.frame} reached", standing)
