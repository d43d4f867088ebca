"""Playing a program: a state machine around a device, and an arm that keeps in step with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue

import numpy as np

from ctr_nlp.exceptions import DeviceFault, HardwareError, JournalError, ProgramError, Stopped
from ctr_nlp.hardware.clock import Clock, RealClock
from ctr_nlp.hardware.devices import Device, Progress, Standing
from ctr_nlp.hardware.devices.arms import ArmFollower
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.motion.program import Program
from ctr_nlp.hardware.playing.results import Outcome, Result, State
from ctr_nlp.hardware.playing.supervision import Supervisor, Tolerances
from ctr_nlp.hardware.playing.trust import Memory, Remembered, doubt
from ctr_nlp.typing import Array

TICK = 0.005
"""s between two looks at the device."""

AHEAD = 0.1
"""s for which the arm goes on without news from the device."""

IN_STEP = 0.005
"""rad by which the arm may be off where the device's progress, within the skew tolerance, puts it."""

LEVEL = 1e-3
"""rad by which the arm may be off the last frame, SETTLING s after the axes are there."""

SETTLING = 0.5

Seen = Callable[[Program, Progress], None]


class Player:
    """One device, and an arm or None, from connecting to closing; everything that happens is in the journal.

    pause, resume and abort may be called from anywhere, also from the callback of play; the last word counts, but
    an abort is final, and works in every state. What is asked for while nothing plays holds for the next program.
    After any stop nothing moves and nothing is sent until the next call. memory: of whether the device's position
    was to be trusted when sessions before this one ended, None to forget. A call that the state does not allow
    raises DeviceFault.
    """

    def __init__(
        self,
        device: Device,
        arm: ArmFollower | None,
        journal: Journal,
        clock: Clock | None = None,
        memory: Memory | None = None,
    ) -> None:
        self.device, self._arm, self.journal, self._memory = device, arm, journal, memory
        self._clock = RealClock() if clock is None else clock
        self._wishes: SimpleQueue[str] = SimpleQueue()
        self._wish, self._frame = "", 0
        self.state = State.DISCONNECTED
        self.doubt = ""
        """Why the position of the connected device is not to be trusted, "" where nothing speaks against it."""
        self._vouched = False
        """Whether its memory, its homing or a person speaks for the position, so that what follows counts."""

    def connect(self, stop_first: bool = False, home: bool = False, session: str = "") -> Standing:
        """Open the device and the arm; where the axes stand. Raises DeviceFault.

        stop_first: a device that moves, since its player died, is stopped; else that is a fault. home: let the
        device find its position, which also ends its alarm. session: the journal's, of one that is to be gone on
        with. Where an abort is asked for meanwhile, the device is stopped, and Stopped is raised.
        """
        self._expect("connects", State.DISCONNECTED)
        with self._faults():
            if self._memory is not None:
                self._memory.claim()
            standing = self._opened(stop_first, home)
            if self._arm is not None:
                self._arm.connect()
            self._look_back(standing, home, session)
            self._to(State.HOMED if standing.homed and not self.doubt else State.IDLE)
        return standing

    def _opened(self, stop_first: bool, home: bool) -> Standing:
        """Connect the device, home or stop it as wanted, and tell where it stands; an abort ends that."""
        homing = False
        try:
            self.device.connect(self._aborted)
            homing = home
            if home:
                self.device.home(self._aborted)
            return self._cleared() if stop_first else self.device.standing()
        except BaseException as error:
            if self._aborted() and isinstance(error, DeviceFault):
                result = self._stopped(Outcome.CANCELLED, "stopped on request, before anything was played")
                raise Stopped(result) from error
            if homing and not isinstance(error, HardwareError):
                self._stopped(Outcome.DEVICE_FAULT, f"homing failed: {error!r}")
            raise

    def _cleared(self) -> Standing:
        """Stop what a dead player left behind; where that fails the position is lost, which is recorded."""
        try:
            return self.device.abort()
        except DeviceFault as error:
            self._ended(Outcome.DEVICE_FAULT, str(error), None)
            raise

    def _look_back(self, standing: Standing, homed: bool = False, session: str = "") -> None:
        """Whether a device that stands somewhere can be trusted, by what is remembered of it."""
        if self._memory is not None and not homed:
            left = self._memory.read(self.device.identity)
            self.doubt = doubt(left, standing.position, self.device.resolution, session)
        self._vouched = not self.doubt

    def trust(self) -> None:
        """Take the position that the device tells for true, since a person has made sure of it."""
        self._expect("can be told to trust a position", State.IDLE, State.HOMED)
        self.doubt, self._vouched = "", True
        self._to(State.HOMED)

    def tilt(self) -> Array:
        """Measured tilt (2,) rad; 0 without an arm."""
        return np.zeros(2) if self._arm is None else self._arm.tilt()

    def pause(self) -> None:
        """Stop on the way, so that it can go on."""
        self._wishes.put("pause")

    def resume(self) -> None:
        """Go on after a pause, once it has come to rest."""
        self._wishes.put("resume")

    def abort(self) -> None:
        """Stop for good."""
        self._wishes.put("abort")

    def close(self) -> None:
        """Let go of device and arm; nothing is sent to the device."""
        for part in (self._arm, self.device):
            if part is not None:
                part.close()
        if self._memory is not None:
            self._memory.release()
        with self.journal.forgiving():
            self._to(State.DISCONNECTED)

    def play(self, program: Program, seen: Seen | None = None) -> Result:
        """Play a program that was checked, from where it starts; returns when everything stands still.

        seen is told of the program and its progress every few ms. Nothing is sent where axes are not at the start.
        """
        self._expect("plays", State.HOMED)
        self._frame = int(program.frames[0])
        try:
            standing = self.device.standing()
            try:
                self._check_start(program, standing)
                self.device.start(program.commands())
            except ProgramError as error:
                return self._ended(Outcome.INVALID_PLAN, str(error), standing)
            if self._aborted():
                return self._ended(Outcome.CANCELLED, "stopped on request, before anything moved", standing)
            self._remember(
                Remembered(False, "a motion had begun, and its end was never told", session=self.journal.session)
            )
            self._to(State.RUNNING)
            return self._played(program, seen)
        except (DeviceFault, JournalError) as error:
            return self._stopped(Outcome.DEVICE_FAULT, str(error))
        except BaseException as error:
            self._stopped(Outcome.CANCELLED, f"playing was interrupted by {error!r}")
            raise

    def _remember(self, left: Remembered) -> None:
        if self._memory is not None:
            self._memory.write(self.device.identity, left)

    def _check_start(self, program: Program, standing: Standing) -> None:
        start = program.positions(np.zeros(1))[0]
        for axis, wanted, there in zip(program.hardware.axes, start, standing.position, strict=True):
            if abs(wanted - there) > axis.tolerance:
                raise ProgramError(
                    f"axis {axis.letter} ({axis.joint}) stands at {there:.4g} {axis.unit}, and frame "
                    f"{program.frames[0]} is at {wanted:.4g}: nothing jumps by more than {axis.tolerance:g}"
                )

    def _played(self, program: Program, seen: Seen | None) -> Result:
        supervisor = Supervisor(Tolerances(program.hardware.late, self.device.resolution))
        while True:
            progress = self.device.update()
            self._tell(progress, program)
            wrong = supervisor.violation(progress, self._clock.now())
            if wrong is not None:
                where = f"{progress.time:.2f} s after the start, frame {self._frame} being the last passed"
                return self._stopped(wrong.outcome, f"{wrong.what} ({where})")
            if seen is not None:
                seen(program, progress)
            if progress.state == "done":
                return self._arrived(program, progress)
            if self._aborted():
                return self._stopped(Outcome.CANCELLED, f"stopped on request, after frame {self._frame}")
            self._obey(progress, supervisor)
            self._lead(program, progress)
            self.device.feed()
            self._clock.sleep(TICK)

    def _aborted(self) -> bool:
        """Whether an abort has been asked for."""
        return self._asked() == "abort"

    def _asked(self) -> str:
        """What is wished for now: "" for nothing, "pause", "resume" or "abort"."""
        while True:
            try:
                wish = self._wishes.get_nowait()
            except Empty:
                return self._wish
            self.journal.record("wish", wish=wish)
            if self._wish != "abort":
                self._wish = wish

    def _obey(self, progress: Progress, supervisor: Supervisor) -> None:
        """Pause or go on as wished, once the device can."""
        if progress.state == "held" and self.state is State.RUNNING:
            if self._arm is not None:
                self._arm.hold()
            self._to(State.HOLD)
        if progress.state == "holding" and self._wish == "resume":
            return
        if progress.state == "running" and self._wish == "pause":
            self.device.hold()
            supervisor.paused()
        if progress.state == "held" and self._wish == "resume":
            self.device.resume()
            supervisor.resumed()
            self._to(State.RUNNING)
        self._wish = ""

    def _tell(self, progress: Progress, program: Program) -> None:
        """Record every frame that has been passed, with the position when that was seen."""
        passed = program.frames[program.frame_time <= progress.time + 1e-9]
        if progress.state == "done":
            passed = program.frames
        for frame in passed[passed > self._frame].tolist():
            self._frame = frame
            self.journal.record("frame", frame=frame, position=progress.position.tolist())

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
        goal, end = program.positions(np.array([program.duration]))[0], program.at(np.array([program.duration]))
        tilted = self._levelled(end[0][0, -2:])
        standing = Standing(progress.position, True)
        off = abs(progress.position - goal) / self.device.resolution
        if off.max() > 1.0:
            axis = program.hardware.axes[int(off.argmax())]
            message = f"axis {axis.letter} ({axis.joint}) stands {off.max():.3g} steps from the last frame"
            return self._ended(Outcome.GOAL_TOLERANCE_VIOLATED, message, standing)
        if tilted > LEVEL:
            message = f"the arm stands {np.degrees(tilted):.2g} deg from the last frame"
            return self._ended(Outcome.GOAL_TOLERANCE_VIOLATED, message, standing)
        return self._ended(Outcome.SUCCESS, f"frame {self._frame} reached", standing)

    def _levelled(self, theta: Array) -> float:
        """Let the arm come to a tilt (2,) rad and rest; by how much it stays off, rad."""
        if self._arm is None:
            return 0.0
        end = self._clock.now() + SETTLING
        self._arm.follow(theta)
        while (off := float(np.linalg.norm(self._arm.tilt() - theta))) > 0.1 * LEVEL and self._clock.now() < end:
            self._clock.sleep(TICK)
            self._arm.follow(theta)
        self._arm.hold()
        return off

    def _stopped(self, outcome: Outcome, message: str) -> Result:
        """Stop everything that can be stopped; the axes first, since an arm that is not led stands still."""
        standing = None
        with self.journal.forgiving():
            try:
                standing = self.device.abort()
            except DeviceFault as error:
                message += f"; {error}"
            finally:
                try:
                    if self._arm is not None:
                        self._arm.hold() if outcome is Outcome.CANCELLED else self._arm.stop()
                except DeviceFault as error:
                    outcome, message = Outcome.DEVICE_FAULT, f"{message}; {error}"
        return self._ended(outcome, message, standing)

    def _ended(self, outcome: Outcome, message: str, standing: Standing | None) -> Result:
        """The result, recorded if that is possible; what was asked for is done with."""
        if standing is not None and not self._vouched:
            self._look_back(standing)
        position = None if standing is None else standing.position
        trusted = standing is not None and standing.homed and not self.doubt
        result = Result(outcome, message, self._frame, position, trusted)
        fine = result.trusted and outcome in (Outcome.SUCCESS, Outcome.INVALID_PLAN, Outcome.CANCELLED)
        with self.journal.forgiving():
            self.journal.record(
                "result",
                outcome=outcome.name,
                message=message,
                frame=result.frame,
                position=None if position is None else position.tolist(),
                trusted=result.trusted,
            )
            self._to(State.HOMED if fine else State.FAULT)
        self._remembered(result)
        if self._wish == "abort":
            self._wish = ""
        return result

    def _remembered(self, result: Result) -> None:
        """How a session left the device; where that cannot be written, what was written before it distrusts it.

        A session that nobody vouched for leaves what is remembered as it is.
        """
        if self._vouched or result.position is None:
            position = None if result.position is None else tuple(result.position.tolist())
            with suppress(DeviceFault):
                self._remember(Remembered(result.trusted, "" if result.trusted else result.message, position))

    def _expect(self, what: str, *states: State) -> None:
        if self.state not in states:
            wanted = " or ".join(state.value for state in states)
            raise DeviceFault(f"the player is {self.state.value}; only one that is {wanted} {what}")

    @contextmanager
    def _faults(self) -> Iterator[None]:
        """Whatever goes wrong within ends in the state fault."""
        try:
            yield
        except BaseException:
            with self.journal.forgiving():
                self._to(State.FAULT)
            raise

    def _to(self, state: State) -> None:
        self.state = state
        self.journal.record("state", state=state.value)
