"""When playing must stop: every tolerance and every decision. docs/hardware.md tells what follows from each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.playing.results import Ending, PlaybackOutcome
from ctr_nlp.typing import Array

MAX_DEVICE_SILENCE_S = 0.5
"""s without news from the device."""

HELD_UP = 0.5
"""s in which the player itself did not look, since its process was suspended or its machine too busy."""

MAX_STALL_TIME_S = 1.0
"""s in which nothing moves and nothing is acknowledged, and yet something should."""

HOLDING = 2.0
"""s in which a hold must have come to rest."""

UNASKED = 10.0
"""s for which somebody else may hold the motion; then it is stopped, from where it can be resumed."""

MISPLACED = 1.0
"""Tolerances from where the axes should be beyond which a report is not to be trusted: steppers that follow their
commands are never so far off, so the controller has lost count, was told something else or is not understood. All
that is trusted must be true within one tolerance."""

MAX_AHEAD_OF_SCHEDULE_S = 0.25
"""s by which the device may run ahead of its schedule: reports are late, never early."""


@dataclass
class Supervisor:
    """Looks at every progress of one motion before anything more is given to the device.

    late: s that it may be behind its schedule. at_rest (m,): how far the axes may be found from where they were
    held, in their units. tolerance (m,): of the axes; Progress.away counts in it. due: where the axes (m,) should
    be at a time (s) of the motion.
    """

    late: float
    at_rest: Array
    tolerance: Array
    due: Callable[[float], Array]
    _since: tuple[float, float] | None = field(default=None, init=False)
    """When (s of the clock) and where (s of the motion) the schedule began, anew after every hold."""
    _looked: float | None = field(default=None, init=False)
    _holding: float | None = field(default=None, init=False)
    _paused: bool = field(default=False, init=False)
    _rest: Array | None = field(default=None, init=False)

    def note_pause(self) -> None:
        """The player has asked for a hold, which may last as long as its user wants."""
        self._paused = True

    def note_resume(self) -> None:
        """The player lets a held device go on: from now on it may move, and keeps a new schedule."""
        self._since = self._looked = self._holding = self._rest = None
        self._paused = False

    def violation(self, progress: MotionProgress, now: float) -> Ending | None:
        """What is wrong at a moment (s of the clock), None where nothing is; the gravest first."""
        fault = PlaybackOutcome.DEVICE_FAULT
        off_path = PlaybackOutcome.PATH_TOLERANCE_VIOLATED
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
        """Whether axes are reported far from their path or from where they rested, or ahead of time, or astray."""
        if self._time_ahead(progress, now) > MAX_AHEAD_OF_SCHEDULE_S or progress.signs.off_path_cause:
            return True
        moved = 0.0 if self._rest is None else (abs(progress.position - self._rest) / self.tolerance).max()
        return max(progress.away, moved) > MISPLACED

    def _check_signs(self, progress: MotionProgress) -> str:
        """The device shows nothing that no device shows that plays as it should."""
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
        """The axes are within their tolerances of the path, and as near to it as those of such a device."""
        away = progress.away
        astray = progress.signs.off_path_cause
        if away <= 1.0:
            return astray
        return f"the axes are {away:.3g} tolerances from their path; 1 is allowed{': ' * bool(astray)}{astray}"

    def _check_hold(self, progress: MotionProgress, now: float) -> str:
        """A hold comes to rest in time, nothing moves in it, and nobody but the player ends it."""
        if progress.state not in ("holding", "held"):
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
        """Neither the device nor the player itself is away for long."""
        away = 0.0 if self._looked is None else now - self._looked
        self._looked = now
        if away > HELD_UP and progress.state != "held":
            return f"the player itself was held up for {away:.2g} s; {HELD_UP:g} s are allowed"
        silent = now - progress.stamp
        if silent > MAX_DEVICE_SILENCE_S:
            return f"the device has told no position for {silent:.2g} s; {MAX_DEVICE_SILENCE_S:g} s are allowed"
        return ""

    def _check_pace(self, progress: MotionProgress, now: float) -> str:
        """A running device keeps its schedule, which begins with the first progress and after every hold.

        Axes within their tolerances of where they should be now are not late, however long the motion lingers
        there. Of a device that has stalled it is told why it has, once that is sure.
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
        """By how many s a running device is ahead of its schedule, negative where it is behind it."""
        if progress.state != "running" or self._since is None:
            return 0.0
        begun, at = self._since
        return (progress.time - at) - (now - begun)

    def _is_behind(self, progress: MotionProgress, late: float) -> bool:
        """Whether an axis is further than its tolerance from where it should be, so many s later in the motion."""
        away = abs(progress.position - self.due(progress.time + late))
        return bool((away > self.tolerance).any())
