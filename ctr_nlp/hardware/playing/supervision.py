"""When playing must stop: every tolerance and every decision. docs/hardware.md tells what follows from each."""

from __future__ import annotations

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

EARLY = 0.25
"""s by which the device may run ahead of its schedule: reports are late, never early."""


@dataclass
class Supervisor:
    """Looks at every progress of one motion before anything more is given to the device.

    late: s that it may be behind its schedule. at_rest (m,): how far the axes may be found from where they were
    held, in their units. The tolerance of the path is in Progress.away, whose unit it is.
    """

    late: float
    at_rest: Array
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
        return (
            self._unexpected(progress)
            or self._path(progress)
            or self._held(progress, now)
            or self._silent(progress, now)
            or self._pace(progress, now)
        )

    def _unexpected(self, progress: Progress) -> Ending | None:
        signs = progress.signs
        if signs.said:
            return _fault(signs.said)
        if signs.override is not None and signs.override != 100:
            return _fault(f"the feed override is {signs.override:g} %, and must be 100 %: somebody changed it")
        if signs.stalled > STALLED:
            return _fault(
                f"nothing has moved for {signs.stalled:.2g} s, though the device was given more to do: replies or "
                "lines were lost"
            )
        return None

    def _path(self, progress: Progress) -> Ending | None:
        if progress.away > 1.0:
            return _off_path(f"the axes are {progress.away:.3g} tolerances from their path; 1 is allowed")
        return None

    def _held(self, progress: Progress, now: float) -> Ending | None:
        """A hold comes to rest in time, nothing moves in it, and nobody but the player ends it."""
        if progress.state not in ("holding", "held"):
            if self._rest is None:
                return None
            return _fault("the motion goes on after a hold, though the player did not resume it")
        self._holding = now if self._holding is None else self._holding
        lasted = now - self._holding
        if progress.state == "holding":
            if self._rest is not None:
                return _fault("the axes no longer rest in a hold, though the player did not resume the motion")
            return _fault(f"a hold has not come to rest in {HOLDING:g} s") if lasted > HOLDING else None
        if self._rest is None:
            self._rest = progress.position
        moved = abs(progress.position - self._rest)
        if (moved > self.at_rest).any():
            return _fault(f"an axis has moved by {moved.max():.3g} in a hold")
        if lasted > UNASKED and not self._paused:
            return _fault(f"somebody else has held the motion for {UNASKED:g} s")
        return None

    def _silent(self, progress: Progress, now: float) -> Ending | None:
        """Neither the device nor the player itself is away for long."""
        away, self._looked = 0.0 if self._looked is None else now - self._looked, now
        if away > HELD_UP and progress.state != "held":
            return _fault(f"the player itself was held up for {away:.2g} s; {HELD_UP:g} s are allowed")
        silent = now - progress.stamp
        if silent > SILENCE:
            return _fault(f"the device has told no position for {silent:.2g} s; {SILENCE:g} s are allowed")
        return None

    def _pace(self, progress: Progress, now: float) -> Ending | None:
        """A running device keeps its schedule, which begins with the first progress and after every hold."""
        if progress.state != "running":
            return None
        if self._since is None:
            self._since = now, progress.time
        begun, at = self._since
        late = (now - begun) - (progress.time - at)
        early = -late
        if early > EARLY:
            return _off_path(f"the axes are {early:.2g} s ahead of their schedule; {EARLY:g} s are allowed")
        if late > self.late:
            return _off_path(f"the axes are {late:.2g} s behind their schedule; {self.late:g} s are allowed")
        return None


def _fault(what: str) -> Ending:
    return Ending(Outcome.DEVICE_FAULT, what)


def _off_path(what: str) -> Ending:
    return Ending(Outcome.PATH_TOLERANCE_VIOLATED, what)
