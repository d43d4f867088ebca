"""Player of trajectories: a state machine around a device, and an arm that keeps in step with it."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from ctr_nlp.exceptions import DeviceFault, HardwareError, JournalError, Stopped, TrajectoryError
from ctr_nlp.hardware.clock import Clock, RealClock
from ctr_nlp.hardware.devices import Device, RunningMotion, Standing
from ctr_nlp.hardware.devices.arms import ArmFollower
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.playback import Playback, Seen, TrajectoryCorrector
from ctr_nlp.hardware.playing.results import Ending, PlaybackOutcome, PlayerState, Result, Wishes
from ctr_nlp.hardware.playing.trust import Memory, Trust
from ctr_nlp.typing import Array


class Player:
    """Player of one device, and an arm or None, from connecting to closing; everything is in the journal.

    pause, resume and abort may be called from anywhere, also from the callback of play; the last request counts,
    but an abort is final, and works in every state. What is requested while nothing plays holds for what is played
    next. After any stop nothing moves and nothing is sent until the next call. memory: of whether the device's
    position was trusted when earlier sessions ended, None for none. A call that the state does not allow raises
    DeviceFault.
    """

    def __init__(
        self,
        device: Device,
        arm: ArmFollower | None,
        journal: Journal,
        clock: Clock | None = None,
        memory: Memory | None = None,
    ) -> None:
        self.device = device
        self._arm = arm
        self.journal = journal
        self._clock = RealClock() if clock is None else clock
        self._wishes = Wishes(journal)
        self._trust = Trust(memory)
        self.state = PlayerState.DISCONNECTED

    @property
    def doubt(self) -> str:
        """Reason not to trust the position of the connected device, "" for none."""
        return self._trust.doubt

    def connect(self, stop_first: bool = False, home: bool = False, session: str = "") -> Standing:
        """Open the device and the arm, and return where the axes stand. Raises DeviceFault.

        stop_first: a device that moves, since its player died, is stopped; else that is a fault. home: let the
        device find its position, which also ends its alarm. session: name of the session that is to be resumed,
        from its journal. Where an abort is requested meanwhile, the device is stopped, and Stopped is raised.
        """
        self._expect("connects", PlayerState.DISCONNECTED)
        try:
            self._trust.claim()
            standing = self._open_device(stop_first, home)
            if self._arm is not None:
                self._arm.connect()
            self._trust.look_back(self.device, standing, home, session)
            self._set_state(PlayerState.HOMED if standing.homed and not self.doubt else PlayerState.IDLE)
        except BaseException:
            with self.journal.forgiving():
                self._set_state(PlayerState.FAULT)
            raise
        return standing

    def _open_device(self, stop_first: bool, home: bool) -> Standing:
        """Connect the device, home or stop it as requested, and return where it stands; an abort ends that."""
        homing = False
        try:
            self.device.connect(self._wishes.is_abort_requested)
            homing = home
            if home:
                self.device.home(self._wishes.is_abort_requested)
            return self._clear_leftover_motion() if stop_first else self.device.standing()
        except BaseException as exception:
            if self._wishes.is_abort_requested() and isinstance(exception, DeviceFault):
                result = self._stop_all(
                    Ending(PlaybackOutcome.CANCELLED, "stopped on request, before anything was played")
                )
                raise Stopped(result) from exception
            if homing and not isinstance(exception, HardwareError):
                self._stop_all(Ending(PlaybackOutcome.DEVICE_FAULT, f"homing failed: {exception!r}"))
            raise

    def _clear_leftover_motion(self) -> Standing:
        """Stop the motion of a player that died; where that fails, the lost position is recorded."""
        try:
            return self.device.abort()
        except DeviceFault as exception:
            self._finish_motion(Ending(PlaybackOutcome.DEVICE_FAULT, str(exception)))
            raise

    def trust(self) -> None:
        """Trust the position that the device reports, since a person has checked it."""
        self._expect("can be told to trust a position", PlayerState.IDLE, PlayerState.HOMED)
        self._trust.vouch()
        self._set_state(PlayerState.HOMED)

    def tilt(self) -> Array:
        """Return the measured tilt (2,) rad; 0 without an arm."""
        return np.zeros(2) if self._arm is None else self._arm.tilt()

    def pause(self) -> None:
        """Request a stop on the path that can be resumed."""
        self._wishes.ask("pause")

    def resume(self) -> None:
        """Request to continue after a pause, once the axes are at rest."""
        self._wishes.ask("resume")

    def abort(self) -> None:
        """Request a stop for good."""
        self._wishes.ask("abort")

    def close(self) -> None:
        """Close device and arm; nothing is sent to the device."""
        for part in (self._arm, self.device):
            if part is not None:
                part.close()
        self._trust.release()
        with self.journal.forgiving():
            self._set_state(PlayerState.DISCONNECTED)

    def play(
        self, trajectory: Trajectory, callback: Seen | None = None, corrector: TrajectoryCorrector | None = None
    ) -> Result:
        """Play a checked trajectory from where it starts; return when everything stands still.

        trajectory: to be played; nothing is sent where axes are not at its start. callback: called with the
        trajectory and the progress every few ms, None for nothing. corrector: changes what is still ahead, None
        for nothing.
        """
        self._expect("plays", PlayerState.HOMED)
        playback = Playback(
            trajectory, self._arm, self.journal, self._clock, self._wishes, self._set_state, corrector
        )
        try:
            with _short_garbage_collections():
                played = self._start_device(playback, trajectory)
                ending = (
                    played
                    if isinstance(played, Ending)
                    else playback.run(played, self.device.resolution, callback)
                )
            return (
                self._stop_all(ending, playback)
                if ending.standing is None
                else self._finish_motion(ending, playback)
            )
        except (DeviceFault, JournalError) as exception:
            return self._stop_all(Ending(PlaybackOutcome.DEVICE_FAULT, str(exception)), playback)
        # Ctrl-C and errors of callbacks, too: the axes must stop before the exception goes on.
        except BaseException as exception:
            self._stop_all(
                Ending(PlaybackOutcome.CANCELLED, f"playing was interrupted by {exception!r}"), playback
            )
            raise

    def _start_device(self, playback: Playback, trajectory: Trajectory) -> RunningMotion | Ending:
        """Start the device and return its motion, or the ending where nothing moves."""
        standing = self.device.standing()
        try:
            playback.check_start(standing)
            played = self.device.start(trajectory.commands())
        except TrajectoryError as exception:
            return Ending(PlaybackOutcome.INVALID_PLAN, str(exception), standing)
        if self._wishes.is_abort_requested():
            return Ending(PlaybackOutcome.CANCELLED, "stopped on request, before anything moved", standing)
        # Distrust is on the disk before the first line is sent: a crash from here on leaves it behind.
        self._trust.note_motion_start(self.device, self.journal.session)
        self.journal.record("start", frame=playback.frame, position=standing.position.tolist())
        self._set_state(PlayerState.RUNNING)
        return played

    def _stop_all(self, ending: Ending, playback: Playback | None = None) -> Result:
        """Stop everything and return the result; the axes first, since an arm that is not led stands still."""
        outcome, message, standing, misplaced = ending
        with self.journal.forgiving():
            try:
                standing = self.device.abort()
            except DeviceFault as exception:
                message += f"; {exception}"
            finally:
                try:
                    if self._arm is not None:
                        self._arm.hold() if outcome is PlaybackOutcome.CANCELLED else self._arm.stop()
                except DeviceFault as exception:
                    outcome = PlaybackOutcome.DEVICE_FAULT
                    message = f"{message}; {exception}"
        return self._finish_motion(Ending(outcome, message, standing, misplaced), playback)

    def _finish_motion(self, ending: Ending, playback: Playback | None = None) -> Result:
        """Return the result of a motion, recorded if that is possible, and clear an abort.

        playback: of the motion that ended, None where none had been prepared.
        """
        outcome, message, standing, misplaced = ending
        away = "" if standing is None or playback is None else playback.explain_misplacement(standing.position)
        if away:
            message += f"; {away}"
        elif misplaced and standing is not None:
            message += "; a position that is reported so is not to be trusted"
        trusted = standing is not None and not (away or misplaced) and self._trust.holds(self.device, standing)
        position = None if standing is None else standing.position
        frame = 0 if playback is None else playback.frame
        result = Result(outcome, message, frame, position, trusted)
        fine = result.trusted and outcome in (
            PlaybackOutcome.SUCCESS,
            PlaybackOutcome.INVALID_PLAN,
            PlaybackOutcome.CANCELLED,
        )
        with self.journal.forgiving():
            self.journal.record(
                "result",
                outcome=outcome.name,
                message=message,
                frame=result.frame,
                position=None if position is None else position.tolist(),
                trusted=result.trusted,
            )
            self._set_state(PlayerState.HOMED if fine else PlayerState.FAULT)
        try:
            self._trust.note_motion_end(self.device, result)
        except DeviceFault as exception:
            result = replace(result, memory_error=str(exception))
        self._wishes.clear_abort()
        return result

    def _expect(self, what: str, *states: PlayerState) -> None:
        """Raise DeviceFault unless the player is in one of some states; what: it does, for the message."""
        if self.state not in states:
            wanted = " or ".join(state.value for state in states)
            raise DeviceFault(f"the player is {self.state.value}; only one that is {wanted} {what}")

    def _set_state(self, state: PlayerState) -> None:
        """Change and record the state."""
        self.state = state
        self.journal.record("state", state=state.value)


@contextmanager
def _short_garbage_collections() -> Iterator[None]:
    """Exempt everything that exists by now from garbage collection while a robot moves.

    A full collection of a large process (a notebook with many plans, say) takes longer than supervision may be
    away, and would stop the motion.
    """
    frozen_by_caller = gc.get_freeze_count() > 0
    gc.freeze()
    try:
        yield
    finally:
        if not frozen_by_caller:
            gc.unfreeze()
