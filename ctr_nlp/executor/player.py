"""Playing a program: a state machine around a device, and an arm that keeps in step with it."""

from __future__ import annotations

from collections.abc import Callable
from queue import Empty, SimpleQueue

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import DeviceFault, JournalError, ProgramError
from ctr_nlp.executor.clock import Clock, RealClock
from ctr_nlp.executor.devices import Device, Progress, Standing
from ctr_nlp.executor.devices.ur import ArmFollower
from ctr_nlp.executor.journal import Journal
from ctr_nlp.executor.program import Program
from ctr_nlp.executor.results import Outcome, Result, State

Array = npt.NDArray[np.float64]

TICK = 0.005
"""s between two looks at the device."""

AHEAD = 0.1
"""s for which the arm goes on without news from the device."""

IN_STEP = 0.005
"""rad by which the arm may be off where the device's progress, within the skew tolerance, puts it."""

Seen = Callable[[Program, Progress], None]


class Player:
    """One device, and an arm or None, from connecting to closing; everything that happens is in the journal.

    pause, resume and abort may be called from anywhere, also from the callback of play. After any stop nothing
    moves and nothing is sent until the next call.
    """

    def __init__(
        self, device: Device, arm: ArmFollower | None, journal: Journal, clock: Clock | None = None
    ) -> None:
        self.device, self._arm, self.journal = device, arm, journal
        self._clock = RealClock() if clock is None else clock
        self._wishes: SimpleQueue[str] = SimpleQueue()
        self.state = State.DISCONNECTED

    def connect(self, stop_first: bool = False) -> Standing:
        """Open the device and the arm; where the axes stand. Raises DeviceFault.

        stop_first: a device that moves, since its player died, is stopped; else that is a fault.
        """
        try:
            self.device.connect()
            standing = self.device.abort() if stop_first else self.device.standing()
            if self._arm is not None:
                self._arm.connect()
        except (DeviceFault, JournalError):
            self._to(State.FAULT)
            raise
        self._to(State.HOMED if standing.homed else State.IDLE)
        return standing

    def home(self) -> Standing:
        """Let the device find its position; raises DeviceFault."""
        try:
            self.device.home()
            standing = self.device.standing()
        except DeviceFault:
            self._to(State.FAULT)
            raise
        self._to(State.HOMED)
        return standing

    def tilt(self) -> Array:
        """Measured tilt (2,) rad; 0 without an arm."""
        return np.zeros(2) if self._arm is None else self._arm.tilt()

    def pause(self) -> None:
        """Stop on the way, so that it can go on."""
        self._wishes.put("pause")

    def resume(self) -> None:
        """Go on after a pause."""
        self._wishes.put("resume")

    def abort(self) -> None:
        """Stop for good."""
        self._wishes.put("abort")

    def close(self) -> None:
        """Let go of device and arm; nothing is sent to the device."""
        for part in (self._arm, self.device):
            if part is not None:
                part.close()
        self._to(State.DISCONNECTED)

    def play(self, program: Program, seen: Seen | None = None) -> Result:
        """Play a program that was checked, from where it starts; returns when everything stands still.

        seen is told of the program and its progress every few ms. Nothing is sent where axes are not at the start.
        """
        if self.state is not State.HOMED:
            raise DeviceFault(f"the player is {self.state.value}; only a homed one plays")
        self._frame, self._program = int(program.frames[0]), program
        try:
            self._check_start(program)
            self._to(State.RUNNING)
            self.device.start(program.commands())
            return self._played(program, seen)
        except ProgramError as error:
            return self._ended(Outcome.INVALID_PLAN, str(error), self.device.standing())
        except (DeviceFault, JournalError) as error:
            return self._stopped(Outcome.DEVICE_FAULT, str(error))
        except BaseException:
            self._stopped(Outcome.CANCELLED, "the program that plays was interrupted")
            raise

    def _check_start(self, program: Program) -> None:
        start, standing = program.positions(np.zeros(1))[0], self.device.standing()
        for axis, wanted, there in zip(program.hardware.axes, start, standing.position, strict=True):
            if abs(wanted - there) > axis.tolerance:
                raise ProgramError(
                    f"axis {axis.letter} ({axis.joint}) stands at {there:.4g} {axis.unit}, and frame "
                    f"{program.frames[0]} is at {wanted:.4g}: nothing jumps by more than {axis.tolerance:g}"
                )

    def _played(self, program: Program, seen: Seen | None) -> Result:
        while True:
            progress = self.device.update()
            self._tell(progress, program)
            if seen is not None:
                seen(program, progress)
            if progress.away > 1.0:
                return self._stopped(
                    Outcome.PATH_TOLERANCE_VIOLATED,
                    f"the axes are {progress.away:.3g} tolerances from their way, after frame {self._frame}",
                )
            if progress.state == "done":
                return self._arrived(program, progress)
            if self._wished(progress):
                return self._stopped(Outcome.CANCELLED, f"stopped on request, after frame {self._frame}")
            self._lead(program, progress)
            self._clock.sleep(TICK)

    def _wished(self, progress: Progress) -> bool:
        """Do what was asked for; whether that was to abort."""
        try:
            wish = self._wishes.get_nowait()
        except Empty:
            wish = ""
        if wish:
            self.journal.record("wish", wish=wish)
        if wish == "pause" and progress.state == "running":
            self.device.hold()
        if wish == "resume" and self.state is State.HOLD:
            self.device.resume()
            self._to(State.RUNNING)
        if progress.state == "held" and self.state is State.RUNNING and wish != "resume":
            if self._arm is not None:
                self._arm.hold()
            self._to(State.HOLD)
        return wish == "abort"

    def _tell(self, progress: Progress, program: Program) -> None:
        """Record every frame that has been passed."""
        passed = program.frames[program.frame_time <= progress.time + 1e-9]
        if progress.state == "done":
            passed = program.frames
        if len(passed) and passed[-1] > self._frame:
            self._frame = int(passed[-1])
            self.journal.record("frame", frame=self._frame, position=progress.position.tolist())

    def _lead(self, program: Program, progress: Progress) -> None:
        """Let the arm follow the device's progress, and see that it does."""
        if self._arm is None or self.state is State.HOLD:
            return
        late = self._clock.now() - progress.stamp
        ahead = min(late, AHEAD) if progress.state == "running" else 0.0
        self._arm.follow(program.at(np.array([progress.time + ahead]))[0][0, -2:])
        tolerance = program.hardware.arm.skew_tolerance if program.hardware.arm else 0.0
        around = progress.time + ahead + np.linspace(-1.0, 1.0, 21) * tolerance
        away = np.linalg.norm(program.at(around)[0][:, -2:] - self._arm.tilt(), axis=1).min()
        if away > IN_STEP:
            raise DeviceFault(
                f"the arm is not in step: {np.degrees(away):.2g} deg from every tilt within {tolerance:g} s"
            )

    def _arrived(self, program: Program, progress: Progress) -> Result:
        goal = program.positions(np.array([program.duration]))[0]
        standing = Standing(progress.position, True)
        off = abs(progress.position - goal) / self.device.resolution
        if off.max() > 1.0:
            axis = program.hardware.axes[int(off.argmax())]
            message = f"axis {axis.letter} ({axis.joint}) stands {off.max():.3g} steps from the last frame"
            return self._ended(Outcome.GOAL_TOLERANCE_VIOLATED, message, standing)
        if self._arm is not None:
            self._arm.hold()
        return self._ended(Outcome.SUCCESS, f"frame {self._frame} reached", standing)

    def _stopped(self, outcome: Outcome, message: str) -> Result:
        """Stop everything that can be stopped."""
        try:
            if self._arm is not None:
                self._arm.stop()
        except DeviceFault as error:
            message += f"; {error}"
        try:
            standing = self.device.abort()
        except (DeviceFault, JournalError) as error:
            return self._ended(outcome, f"{message}; {error}", None)
        return self._ended(outcome, message, standing)

    def _ended(self, outcome: Outcome, message: str, standing: Standing | None) -> Result:
        position = None if standing is None else standing.position
        result = Result(outcome, message, self._frame, position, standing is not None)
        fine = standing is not None and outcome in (Outcome.SUCCESS, Outcome.INVALID_PLAN, Outcome.CANCELLED)
        try:
            self.journal.record(
                "result",
                outcome=outcome.name,
                message=message,
                frame=result.frame,
                position=None if position is None else position.tolist(),
                trusted=result.trusted,
            )
        except JournalError as error:
            result = Result(outcome, f"{message}; {error}", result.frame, position, result.trusted)
        self._to(State.HOMED if fine else State.FAULT)
        return result

    def _to(self, state: State) -> None:
        self.state = state
        try:
            self.journal.record("state", state=state.value)
        except JournalError:
            if state is State.RUNNING:
                raise
