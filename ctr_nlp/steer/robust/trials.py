"""Motions tried on robots within tolerances: at their corners, where most are lost, and drawn, which tells how
certain it is that hardly any is lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import Model
from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.plan.robustness import CONFIDENCE, upper_bound
from ctr_nlp.plan.verdicts import MOST_LOST
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import Draws, drawn, drawn_from
from ctr_nlp.simulation.drawn import lost_draws
from ctr_nlp.steer.robust.tolerated import extremes_of
from ctr_nlp.support.values import number
from ctr_nlp.typing import Array, Flags, Index

JOINING = 12
"""Lost robots that join the scenarios in one round, at most."""
LEAST_DRAWS, GROUP = 500, 50
"""Robots that are drawn at least for a motion; those moved at a time."""
OF_DRAFTS, SPARED = 128, 0.02
"""Extreme robots on which a draft is tried; the part of them that may be lost on a motion."""
SEED = 2**40
"""Of the first motion's draws, from which seeds count on: none that anybody tries plans with."""
HALVINGS = 6
"""Of the range in which the part of the tolerances lies that a motion bears."""


class Lost(NamedTuple):
    """Robots that were lost of those tried: numbers (L, d, 6) of their tubes and offsets (L, d) of their motors,
    rad; frames (L,): in which each was, from 1. allowed: how many may be lost.
    """

    numbers: Array
    offsets: Array
    frames: Index
    tried: int
    allowed: int

    @property
    def few(self) -> bool:
        """Whether no more than may be are lost."""
        return self.room >= 0

    @property
    def room(self) -> int:
        """How many more may be."""
        return self.allowed - len(self.frames)

    @property
    def share(self) -> float:
        """Of those tried."""
        return len(self.frames) / max(self.tried, 1)

    def beside(self, scenarios: Scenarios) -> Lost:
        """Those that are not among scenarios."""
        new = ~self.among(scenarios)
        return self._replace(numbers=self.numbers[new], offsets=self.offsets[new], frames=self.frames[new])

    def among(self, scenarios: Scenarios) -> Flags:
        """Which (L,) of them are scenarios already."""
        same = (self.numbers[:, None] == scenarios.numbers).all(axis=(2, 3))
        return np.asarray((same & (self.offsets[:, None] == scenarios.offsets).all(axis=2)).any(axis=1))


class Trial(NamedTuple):
    """What was lost on a motion, of the extreme robots and of those drawn; none are drawn for a draft."""

    extremes: Lost
    draws: Lost

    @property
    def few(self) -> bool:
        """Whether so few of both that nothing more is asked for."""
        return self.extremes.few and self.draws.few

    @property
    def worst(self) -> Lost:
        """Those from which one learns most of what to plan for."""
        return self.draws if self.extremes.few else self.extremes

    @property
    def rank(self) -> tuple[bool, bool, float]:
        """The least is the best: draws count first, then extremes, and the share lost where these are not few."""
        share = 0.0 if self.few else (self.extremes if self.draws.few else self.draws).share
        return not self.draws.few, not self.extremes.few, share


@dataclass(frozen=True)
class Trials:
    """Robots within a robot's tolerances: extreme ones, and drawn ones, anew for every motion that is tried, at
    most so many of them.

    most_lost: the share of all such robots that may be lost. So that what is said of the last motion holds with
    95 % confidence, however many were tried before it, each has its part of the 5 % (Bonferroni). Raises
    OptionError.
    """

    robot: Robot
    model: Model
    motions: int
    most_lost: float = MOST_LOST

    def __post_init__(self) -> None:
        number(OptionError, "most_lost", self.most_lost, lambda x: 0 < x < 1, "be more than 0 and less than 1")

    @property
    def confidence(self) -> float:
        """With which a single motion is judged."""
        return 1 - (1 - CONFIDENCE) / self.motions

    @property
    def draws(self) -> int:
        """Robots drawn for a motion: enough that none of them being lost says what is asked for."""
        return max(LEAST_DRAWS, math.ceil(math.log(1 - self.confidence) / math.log1p(-self.most_lost)))

    @property
    def allowed(self) -> int:
        """How many of these may be lost."""
        bounds = (upper_bound(lost, self.draws, self.confidence) for lost in count())
        return next(lost for lost, bound in enumerate(bounds) if bound > self.most_lost) - 1

    def __call__(self, q: Array, number: int, draft: bool = False) -> Trial:
        """What is lost on motion q (T, 2d + 2), the number-th that is tried, or on a draft, filled up."""
        extremes = self._extremes[:OF_DRAFTS] if draft else self._extremes
        draws = drawn(self.robot, self.draws, SEED + number)[: 0 if draft else None]
        return Trial(self._lost(extremes, q, int(SPARED * len(extremes))), self._lost(draws, q, self.allowed))

    @cached_property
    def _extremes(self) -> Draws:
        return extremes_of(self.robot)

    def _lost(self, robots: Draws, q: Array, allowed: int) -> Lost:
        """Those lost of robots; no more are moved once enough are."""
        frames = np.zeros(0, dtype=int)
        while len(frames) < len(robots) and (frames > 0).sum() < allowed + JOINING:
            group = robots[len(frames) : len(frames) + GROUP]
            frames = np.append(frames, lost_draws(self.robot, group, q, self.model))
        gone = np.flatnonzero(frames)
        return Lost(robots.numbers[gone], robots.offsets[gone], frames[gone], len(frames), allowed)

    def borne(self, q: Array, number: int) -> float:
        """The part of the tolerances, below 1, at which few are lost on motion q; 0 where many are at any."""
        draws, (low, high) = drawn(self.robot, self.draws, SEED + number), (0.0, 1.0)
        for _ in range(HALVINGS):
            part = (low + high) / 2
            shrunk = drawn_from(self.robot, part * draws.parts, part * draws.lags)
            few = (lost_draws(self.robot, shrunk, q, self.model) > 0).sum() <= self.allowed
            low, high = (part, high) if few else (low, part)
        return low

    def certificate(self, trial: Trial, q: Array, number: int) -> dict[str, Any]:
        """For a plan's meta: what was found of its motion q, and where too many are lost, what it would bear."""
        lost, extremes = trial.draws, trial.extremes
        frames, counts = np.unique(lost.frames, return_counts=True)
        return {
            "held": lost.few,
            "most_lost": self.most_lost,
            "draws": lost.tried,
            "lost": len(lost.frames),
            "lost_in": dict(zip(map(str, frames.tolist()), counts.tolist(), strict=True)),
            "extremes": extremes.tried,
            "extremes_lost": len(extremes.frames),
            "borne": 1.0 if lost.few else self.borne(q, number),
        }
