"""When playing must stop: every tolerance and every decision. docs/hardware.md tells what follows from each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from ctr_nlp.hardware.devices import Progress
from ctr_nlp.hardware.playing.results import Ending, Outcome
from ctr_nlp.typing import Array

SILENCE = 0.5
"""s without news from the device."""

HELD_UP = 0.5
"""s in which the player itself did not look, since its process was suspended or its machine too busy."""

STALLED = 1.0
"""s in which nothing moves and nothing is acknowledged, and yet something should."""

HOLDING = 2.0
"""s in which a hold must have come to rest."""

UNASKED = 10.0
"""s for which somebody else may hold the motion; then it is stopped, from where it can be resumed."""

MISPLACED = 1.0
"""Tolerances from where the axes should be beyond which a report is not to be trusted: steppers that follow their
commands are never so far off, so the controller has lost count, was told something else or is not understood. All
that is trusted must be true within one tolerance."""

EARLY = 0.25
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

    def paused(self) -> None:
        """The player has asked for a hold, which may last as long as its user wants."""
        self._paused = True

    def resumed(self) -> None:
        """The player lets a held device go on: from now on it may move, and keeps a new schedule."""
        self._since = self._looked = self._holding = self._rest = None
        self._paused = False

    def violation(self, progress: Progress, now: float) -> Ending | None:
        """What is wrong at a moment (s of the clock), None where nothing is; the gravest first."""
        fault, off_path = Outcome.DEVICE_FAULT, Outcome.PATH_TOLERANCE_VIOLATED
        found = (
            (fault, self._unexpected(progress)),
            (off_path, self._path(progress)),
            (fault, self._held(progress, now)),
            (fault, self._silent(progress, now)),
            (off_path, self._pace(progress, now)),
        )
        ending = next((Ending(outcome, what) for outcome, what in found if what), None)
        return None if ending is None else ending._replace(misplaced=self._misplaced(progress, now))

    def _misplaced(self, progress: Progress, now: float) -> bool:
        """Whether axes are reported far from their path or from where they rested, or ahead of time, or astray."""
        if self._early(progress, now) > EARLY or progress.signs.astray:
            return True
        moved = 0.0 if self._rest is None else (abs(progress.position - self._rest) / self.tolerance).max()
        return max(progress.away, moved) > MISPLACED

    def _unexpected(self, progress: Progress) -> str:
        """The device shows nothing that no device shows that plays as it should."""
        signs = progress.signs
        if signs.said:
            return signs.said
        if signs.override is not None and signs.override != 100:
            return (
                f"the feed override is {signs.override:g} %, and must be 100 %: somebody changed it, or a byte "
                "was changed on the way"
            )
        if signs.stalled > STALLED:
            cause = signs.cause or "replies or lines were lost"
            return f"nothing has moved for {signs.stalled:.2g} s, though the device was given more to do: {cause}"
        return ""

    def _path(self, progress: Progress) -> str:
        """The axes are within their tolerances of the path, and as near to it as those of such a device."""
        away, astray = progress.away, progress.signs.astray
        if away <= 1.0:
            return astray
        return f"the axes are {away:.3g} tolerances from their path; 1 is allowed{': ' * bool(astray)}{astray}"

    def _held(self, progress: Progress, now: float) -> str:
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

    def _silent(self, progress: Progress, now: float) -> str:
        """Neither the device nor the player itself is away for long."""
        away, self._looked = 0.0 if self._looked is None else now - self._looked, now
        if away > HELD_UP and progress.state != "held":
            return f"the player itself was held up for {away:.2g} s; {HELD_UP:g} s are allowed"
        silent = now - progress.stamp
        if silent > SILENCE:
            return f"the device has told no position for {silent:.2g} s; {SILENCE:g} s are allowed"
        return ""

    def _pace(self, progress: Progress, now: float) -> str:
        """A running device keeps its schedule, which begins with the first progress and after every hold.

        Axes within their tolerances of where they should be now are not late, however long the motion lingers
        there. Of a device that has stalled it is told why it has, once that is sure.
        """
        if progress.state != "running":
            return ""
        if self._since is None:
            self._since = now, progress.time
        late = -self._early(progress, now)
        if -late > EARLY:
            return f"the axes are {-late:.2g} s ahead of their schedule; {EARLY:g} s are allowed"
        if late > self.late and not progress.signs.stalled and self._behind(progress, late):
            return f"the axes are {late:.2g} s behind their schedule; {self.late:g} s are allowed"
        return ""

    def _early(self, progress: Progress, now: float) -> float:
        """By how many s a running device is ahead of its schedule, negative where it is behind it."""
        if progress.state != "running" or self._since is None:
            return 0.0
        begun, at = self._since
        return (progress.time - at) - (now - begun)

    def _behind(self, progress: Progress, late: float) -> bool:
        """Whether an axis is further than its tolerance from where it should be, so many s later in the motion."""
        away = abs(progress.position - self.due(progress.time + late))
        return bool((away > self.tolerance).any())
