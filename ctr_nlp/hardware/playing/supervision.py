"""Supervision: when playing must stop, with all tolerances. docs/hardware.md lists what follows from each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.playing.results import Ending, PlaybackOutcome
from ctr_nlp.typing import Array

MAX_DEVICE_SILENCE_S = 0.5
"""s without a report of the device."""

HELD_UP = 0.5
"""s between two updates of the player, whose process may be suspended or whose machine too busy."""

MAX_STALL_TIME_S = 1.0
"""s in which nothing moves and nothing is acknowledged although the device was given more to do."""

HOLDING = 2.0
"""s in which a hold must have come to rest."""

UNASKED = 10.0
"""s for which somebody else may hold the motion; then it is stopped, and can be resumed from there."""

MISPLACED = 1.0
"""Distance from where the axes should be, in tolerances, beyond which a position is not trusted: steppers that
follow their commands are never so far off, so the controller has lost count, was sent something else or is not
understood. All that is trusted must be true within one tolerance."""

MAX_AHEAD_OF_SCHEDULE_S = 0.25
"""s by which the device may run ahead of its schedule: reports are late, never early."""


@dataclass
class Supervisor:
    """Supervisor of one motion, which checks every progress before the device is given more.

    late: s that the motion may be behind its schedule. at_rest (m,): how far the axes may move in a hold, in their
    units. tolerance (m,): of the axes; MotionProgress.away counts in it. due: returns where the axes (m,) should
    be at a time (s) of the motion.
    """

    late: float
    at_rest: Array
    tolerance: Array
    due: Callable[[float], Array]
    _since: tuple[float, float] | None = field(default=None, init=False)
    """When (s of the clock) and where (s of the motion) the schedule began, again after every hold."""
    _looked: float | None = field(default=None, init=False)
    _holding: float | None = field(default=None, init=False)
    _paused: bool = field(default=False, init=False)
    _rest: Array | None = field(default=None, init=False)

    def note_pause(self) -> None:
        """Note that the player has asked for a hold, which may last as long as its user wants."""
        self._paused = True

    def note_resume(self) -> None:
        """Note that the player resumes a hold: from now on the device may move, on a new schedule."""
        self._since = self._looked = self._holding = self._rest = None
        self._paused = False

    def violation(self, progress: MotionProgress, now: float) -> Ending | None:
        """Return the ending that a progress requires, None where nothing is wrong; the gravest first.

        progress: of the device. now: s of the clock.
        """
        fault = PlaybackOutcome.DEVICE_FAULT
        off_path = PlaybackOutcome.PATH_TOLERANCE_VIOLATED
        # All are checked before one is chosen, since the checks also update the schedule and the state of a hold.
        found = (
            (fault, self._check_signs(progress)),
            (off_path, self._check_path(progress)),
            (fault, self._check_hold(progress, now)),
            (fault, self._check_silence(progress, now)),
            (off_path, self._check_pace(progress, now)),
        )
        ending = next((Ending(outcome, what) for outcome, what in found if what), None)
        return None if ending is None else ending._replace(misplaced=self._is_misplaced(progress, now))

    def _is_misplaced(self, progress: MotionProgress, now: float) -> bool:
        """Return whether axes are reported so far off, or so early, that their position is not to be trusted."""
        if self._time_ahead(progress, now) > MAX_AHEAD_OF_SCHEDULE_S or progress.signs.off_path_cause:
            return True
        moved = 0.0 if self._rest is None else (abs(progress.position - self._rest) / self.tolerance).max()
        return max(progress.away, moved) > MISPLACED

    def _check_signs(self, progress: MotionProgress) -> str:
        """Return what is wrong with the signs of a device, "" for nothing."""
        signs = progress.signs
        if signs.anomaly:
            return signs.anomaly
        if signs.override is not None and signs.override != 100:
            return (
                f"the feed override is {signs.override:g} %, and must be 100 %: somebody changed it, or a byte "
                "was changed on the way"
            )
        if signs.stalled > MAX_STALL_TIME_S:
            cause = signs.cause or "replies or lines were lost"
            return f"nothing has moved for {signs.stalled:.2g} s, though the device was given more to do: {cause}"
        return ""

    def _check_path(self, progress: MotionProgress) -> str:
        """Return how far the axes are from their path, "" where they are near enough for such a device."""
        away = progress.away
        astray = progress.signs.off_path_cause
        if away <= 1.0:
            return astray
        return f"the axes are {away:.3g} tolerances from their path; 1 is allowed{': ' * bool(astray)}{astray}"

    def _check_hold(self, progress: MotionProgress, now: float) -> str:
        """Return what is wrong with a hold, "" for nothing.

        It must come to rest in time, nothing may move in it, and only the player may end it.
        """
        if progress.state not in ("holding", "held"):
            # A hold that had come to rest and was not resumed by note_resume, which clears _rest. Somebody else
            # sent a resume.
            on = self._rest is not None
            return "the motion goes on after a hold, though the player did not resume it" if on else ""
        self._holding = now if self._holding is None else self._holding
        lasted = now - self._holding
        if progress.state == "holding":
            if self._rest is not None:
                return "the axes no longer rest in a hold, though the player did not resume the motion"
            return f"a hold has not come to rest in {HOLDING:g} s" if lasted > HOLDING else ""
        if self._rest is None:
            self._rest = progress.position
        moved = abs(progress.position - self._rest)
        if (moved > self.at_rest).any():
            return f"an axis has moved by {moved.max():.3g} in a hold"
        asked = self._paused or lasted <= UNASKED
        return (
            ""
            if asked
            else f"somebody else has held the motion for {UNASKED:g} s, or a byte was changed on the way"
        )

    def _check_silence(self, progress: MotionProgress, now: float) -> str:
        """Return for how long the device or the player itself was away, "" where it may be."""
        away = 0.0 if self._looked is None else now - self._looked
        self._looked = now
        # A suspended player has let the device run on what it had, unsupervised; in a hold nothing could happen.
        if away > HELD_UP and progress.state != "held":
            return f"the player itself was held up for {away:.2g} s; {HELD_UP:g} s are allowed"
        silent = now - progress.stamp
        if silent > MAX_DEVICE_SILENCE_S:
            return (
                f"the device has reported no position for {silent:.2g} s; {MAX_DEVICE_SILENCE_S:g} s are allowed"
            )
        return ""

    def _check_pace(self, progress: MotionProgress, now: float) -> str:
        """Return how far a running device is off its schedule, "" where it may be.

        The schedule begins with the first progress and after every hold. Axes within their tolerances of where
        they should be now are not late, however long the motion lingers there. Of a device that has stalled the
        cause is reported instead, once it is certain.
        """
        if progress.state != "running":
            return ""
        if self._since is None:
            self._since = now, progress.time
        late = -self._time_ahead(progress, now)
        if -late > MAX_AHEAD_OF_SCHEDULE_S:
            return f"the axes are {-late:.2g} s ahead of their schedule; {MAX_AHEAD_OF_SCHEDULE_S:g} s are allowed"
        if late > self.late and not progress.signs.stalled and self._is_behind(progress, late):
            return f"the axes are {late:.2g} s behind their schedule; {self.late:g} s are allowed"
        return ""

    def _time_ahead(self, progress: MotionProgress, now: float) -> float:
        """Return by how many s a running device is ahead of its schedule, negative where it is behind."""
        if progress.state != "running" or self._since is None:
            return 0.0
        begun, at = self._since
        return (progress.time - at) - (now - begun)

    def _is_behind(self, progress: MotionProgress, late: float) -> bool:
        """Return whether an axis is beyond its tolerance of where it should be, late s further in the motion."""
        away = abs(progress.position - self.due(progress.time + late))
        return bool((away > self.tolerance).any())
