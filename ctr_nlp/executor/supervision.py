"""When playing must stop: every tolerance and every decision. docs/hardware.md tells what follows from each."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ctr_nlp.executor.devices import Progress
from ctr_nlp.executor.results import Outcome

Array = npt.NDArray[np.float64]

SILENCE = 0.5
"""s without news from the device."""

STALLED = 1.0
"""s in which nothing moves and nothing is acknowledged, and yet something should."""

HOLDING = 2.0
"""s in which a hold must have come to rest."""

EARLY = 0.25
"""s by which the device may run ahead of its schedule: reports are late, never early."""


@dataclass(frozen=True)
class Tolerances:
    """What a motion on some hardware may deviate by.

    late: s behind its schedule. at_rest (m,): how far the axes may be found from where they were held, in their
    units. The tolerance of the path is in Progress.away, whose unit it is.
    """

    late: float
    at_rest: Array


@dataclass(frozen=True)
class Violation:
    """What must end a motion: how it is typed, and a sentence with the value and what is allowed."""

    outcome: Outcome
    what: str


@dataclass
class Supervisor:
    """Looks at every progress of one motion before anything more is given to the device."""

    tolerances: Tolerances
    _since: tuple[float, float] | None = field(default=None, init=False)
    """When (s of the clock) and where (s of the motion) the schedule began, anew after every hold."""
    _holding: float | None = field(default=None, init=False)
    _rest: Array | None = field(default=None, init=False)

    def resumed(self) -> None:
        """The player lets a held device go on: from now on it may move, and keeps a new schedule."""
        self._since = self._holding = self._rest = None

    def violation(self, progress: Progress, now: float) -> Violation | None:
        """What is wrong at a moment (s of the clock), None where nothing is; the gravest first."""
        return (
            self._unexpected(progress)
            or self._path(progress)
            or self._held(progress, now)
            or self._silent(progress, now)
            or self._pace(progress, now)
        )

    def _unexpected(self, progress: Progress) -> Violation | None:
        signs = progress.signs
        if signs.said:
            return Violation(Outcome.DEVICE_FAULT, signs.said)
        if signs.override is not None and signs.override != 100:
            return Violation(
                Outcome.DEVICE_FAULT,
                f"the feed override is {signs.override:g} %, and must be 100 %: somebody changed it",
            )
        if signs.stalled > STALLED:
            return Violation(
                Outcome.DEVICE_FAULT,
                f"nothing has moved for {signs.stalled:.2g} s, though the device was given more to do: replies or "
                "lines were lost",
            )
        return None

    def _path(self, progress: Progress) -> Violation | None:
        if progress.away > 1.0:
            return Violation(
                Outcome.PATH_TOLERANCE_VIOLATED,
                f"the axes are {progress.away:.3g} tolerances from their way; 1 is allowed",
            )
        return None

    def _held(self, progress: Progress, now: float) -> Violation | None:
        """A hold comes to rest in time, and nobody but the player ends it."""
        if progress.state == "held":
            if self._rest is None:
                self._rest = progress.position
            moved = abs(progress.position - self._rest) - self.tolerances.at_rest
            if (moved > 0).any():
                return Violation(
                    Outcome.DEVICE_FAULT,
                    f"an axis has moved by {abs(progress.position - self._rest).max():.3g} in a hold",
                )
        elif self._rest is not None:
            return Violation(
                Outcome.DEVICE_FAULT, "the motion goes on after a hold, though the player did not resume it"
            )
        elif progress.state == "holding":
            self._holding = now if self._holding is None else self._holding
            if now - self._holding > HOLDING:
                return Violation(Outcome.DEVICE_FAULT, f"a hold has not come to rest in {HOLDING:g} s")
        return None

    def _silent(self, progress: Progress, now: float) -> Violation | None:
        if now - progress.stamp > SILENCE:
            return Violation(
                Outcome.DEVICE_FAULT,
                f"the device has not told its position for {now - progress.stamp:.2g} s; {SILENCE:g} s are allowed",
            )
        return None

    def _pace(self, progress: Progress, now: float) -> Violation | None:
        """A running device keeps its schedule, which begins with the first progress and after every hold."""
        if progress.state != "running":
            return None
        if self._since is None:
            self._since = now, progress.time
        begun, at = self._since
        late = (now - begun) - (progress.time - at)
        early = (progress.time - at) - (now - begun)
        if early > EARLY:
            return Violation(
                Outcome.PATH_TOLERANCE_VIOLATED,
                f"the axes are {early:.2g} s ahead of their schedule; {EARLY:g} s are allowed",
            )
        if late > self.tolerances.late:
            return Violation(
                Outcome.PATH_TOLERANCE_VIOLATED,
                f"the axes are {late:.2g} s behind their schedule; {self.tolerances.late:g} s are allowed",
            )
        return None
