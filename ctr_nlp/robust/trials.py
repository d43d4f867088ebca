"""Statistical test of motions on Monte Carlo samples: is the share of robots that are lost small enough?

Where k of n samples are lost, the share of all such robots that are lost is with confidence c at most the quantile
c of the beta distribution of k + 1 and n - k (Clopper and Pearson, Biometrika 26, 1934). A sample is lost where it
snaps, has no equilibrium, or leaves the nominal robot's branch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import count
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import Model
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import CONFIDENCE, MOST_LOST, upper_bound
from ctr_nlp.plan.sample_motions import find_failure_frames
from ctr_nlp.plan.sample_outcomes import sample_outcomes
from ctr_nlp.plan.verdicts import option, outcome_sentence
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import perturb_robot, sample_robots
from ctr_nlp.support.value_checks import number
from ctr_nlp.typing import Array, Index

MAX_JOINING_SAMPLES = 6
"""Largest number of lost samples that join the scenarios in one round."""
MIN_TRIAL_SAMPLES, DRAFT_TRIAL_SAMPLES, TRIAL_SAMPLES_PER_BATCH = 500, 200, 50
"""Least number of samples for a whole motion, number for a draft, and after how many a test may end."""
SEARCH_CONFIDENCE, MAX_SEARCH_SAMPLES = 0.998, 5000
"""Confidence that few robots are lost on a motion, for planning to go on from it, and most samples for that. The
best of some 40 motions is partly lucky, so that it has to be clearly better than the certificate asks.
"""
MAX_TRIAL_SAMPLES_PER_CALL = 1000
"""Largest number of samples that are simulated in one call, for the memory that their motions take."""
TRIAL_FIRST_SAMPLE_SEED = 2**40
"""Seed of the first motion's samples, from which seeds count on: far from those that users evaluate plans with."""
CERTIFICATION_SAMPLES = 200
"""Fresh samples on which the chosen plan is checked for arrival and contact: where at most 4 of them fail, 95 % of
all such robots or more pass, with 95 % confidence.
"""
TOLERANCE_PART_BISECTIONS = 6
"""Bisection steps for the part of the tolerances at which few robots are lost."""


class FailedSamples(NamedTuple):
    """The L samples that are lost on a motion.

    numbers (L, d, 8): numbers of their tubes. offsets (L, d): their motors' zeros, rad. forces (L, 3): at their
    tips, N. frames (L,): in which each was lost, from 1. sample_count: number of samples simulated. few: whether
    so few are lost that the share of all such robots is small enough.
    """

    numbers: Array
    offsets: Array
    forces: Array
    frames: Index
    sample_count: int
    few: bool

    @property
    def share(self) -> float:
        """Share of the simulated samples that are lost."""
        return len(self.frames) / self.sample_count


@dataclass(frozen=True)
class Trials:
    """Tests motions on samples of a robot: those of a search, and then, once, the chosen one for its certificate.

    robot: with its tolerances. model: on which samples are simulated. most_lost: share of all robots within the
    tolerances that may be lost. Raises OptionError.
    """

    robot: Robot
    model: Model
    most_lost: float = MOST_LOST

    def __post_init__(self) -> None:
        number(OptionError, "most_lost", self.most_lost, lambda x: 0 < x < 1, "be more than 0 and less than 1")

    @property
    def search_samples(self) -> int:
        """Number of samples for a motion of the search."""
        return min(self._least_samples(SEARCH_CONFIDENCE), MAX_SEARCH_SAMPLES)

    @property
    def search_failures(self) -> int:
        """Number of these that may be lost."""
        return self.allowed_failures(self.search_samples, SEARCH_CONFIDENCE)

    @property
    def certificate_samples(self) -> int:
        """Number of samples for the certificate: enough to show, where none is lost, that few robots are."""
        return self._least_samples(CONFIDENCE)

    def allowed_failures(self, samples: int, confidence: float = CONFIDENCE) -> int:
        """Return how many of so many samples may be lost; none where there are too few for the confidence."""
        # The bound grows with the number lost: the last number below it is wanted.
        bounds = (upper_bound(lost, samples, confidence) for lost in count(1))
        return next(lost for lost, bound in enumerate(bounds) if bound > self.most_lost)

    def __call__(self, q: Array, number: int, draft: bool = False) -> FailedSamples:
        """Simulate fresh samples on a motion q (T, 2d + 2) and return those that are lost.

        number: of the motion. draft: whether it is a draft's motion, for which there are fewer samples, and few
        means none. The simulation ends as soon as the test has failed.
        """
        if draft:
            return self._test(q, number, DRAFT_TRIAL_SAMPLES, 0)
        return self._test(q, number, self.search_samples, self.search_failures)

    def _least_samples(self, confidence: float) -> int:
        """Return the number of samples, at least MIN_TRIAL_SAMPLES, that suffices where none of them is lost."""
        # None of n lost: (1 - p)^n <= 1 - c, with p the share that may be lost and c the confidence.
        return max(MIN_TRIAL_SAMPLES, math.ceil(math.log(1 - confidence) / math.log1p(-self.most_lost)))

    def _test(self, q: Array, number: int, samples: int, allowed: int) -> FailedSamples:
        """Simulate up to so many samples, of which `allowed` may be lost; number: the samples' own."""
        # Fresh samples for every motion: those of earlier tests have joined its scenarios, and would bias the
        # test.
        draws = sample_robots(self.robot, samples, TRIAL_FIRST_SAMPLE_SEED + number)
        frames = np.zeros(0, dtype=int)
        # The verdict is no once more than `allowed` are lost; but MAX_JOINING_SAMPLES of them are wanted as
        # scenarios.
        wanted = max(MAX_JOINING_SAMPLES, allowed + 1)
        while len(frames) < len(draws) and (frames > 0).sum() < wanted:
            # As many as are known already: a motion that fails soon costs little, and a long test has few calls.
            size = min(max(TRIAL_SAMPLES_PER_BATCH, len(frames)), MAX_TRIAL_SAMPLES_PER_CALL)
            group = draws[len(frames) : len(frames) + size]
            found = find_failure_frames(self.robot, group, q, self.model)
            for first in range(0, len(found), TRIAL_SAMPLES_PER_BATCH):
                # Samples after the end of the test do not count, whatever the size of a call.
                if (frames > 0).sum() < wanted:
                    frames = np.append(frames, found[first : first + TRIAL_SAMPLES_PER_BATCH])
        gone = np.flatnonzero(frames)
        lost = draws[gone]
        own = lost.numbers, lost.offsets, lost.forces
        return FailedSamples(*own, frames[gone], len(frames), len(gone) <= allowed)

    def tolerated_part(self, q: Array, number: int) -> float:
        """Return the part of the tolerances, from 0 to 1, at which few robots are lost on a motion q (T, 2d + 2).

        number: of the motion, whose samples are taken again and scaled.
        """
        draws = sample_robots(self.robot, self.search_samples, TRIAL_FIRST_SAMPLE_SEED + number)
        allowed = self.search_failures
        low, high = 0.0, 1.0
        # The same samples at every scale, so that the number lost is nearly monotonic in the part.
        for _ in range(TOLERANCE_PART_BISECTIONS):
            part = (low + high) / 2
            shrunk = perturb_robot(self.robot, part * draws.deviations, part * draws.backlash, part * draws.forces)
            few = (find_failure_frames(self.robot, shrunk, q, self.model) > 0).sum() <= allowed
            low, high = (part, high) if few else (low, part)
        # The lower end: few are known to be lost there.
        return low

    def certify_plan(self, plan: Plan, number: int) -> Plan:
        """Certify a plan on fresh samples, which neither planning nor the choice among motions has used.

        It is the only test whose confidence counts, so that the number of motions that were tested before it does
        not matter.

        Parameters
        ----------
        plan : Plan
            The chosen plan.
        number : int
            Number of a motion that was not tested, so that its samples are fresh; nor was any with a larger one.

        Returns
        -------
        Plan
            The same plan with these samples, and with ``meta["certificate"]``: ``held``, whether few enough robots
            are lost; ``draws``, ``lost``, ``lost_in`` and ``borne`` of the test of that (samples, how many were
            lost and in which frames, and the part of the tolerances at which few are); ``samples``, ``outcome``,
            ``holds`` and ``holds_at_least``: other fresh samples, how many also arrive and keep off the wall, and
            the least share of all robots that does, with 95 % confidence (Clopper and Pearson); ``certified``:
            whether few are lost and that share is as large as asked for.
        """
        most = self.certificate_samples
        lost = self._test(plan.q, number + 1, most, self.allowed_failures(most))
        frames, counts = np.unique(lost.frames, return_counts=True)
        # The seed of a number that no test has used.
        plan = plan.with_samples(CERTIFICATION_SAMPLES, TRIAL_FIRST_SAMPLE_SEED + number)
        outcomes = sample_outcomes(plan)
        holds = int(outcomes.passed_all_checks.sum())
        # The lower bound of the share that passes is 1 minus the upper bound of the share that fails.
        at_least = 1 - upper_bound(CERTIFICATION_SAMPLES - holds, CERTIFICATION_SAMPLES)
        found = {
            "held": lost.few,
            "most_lost": self.most_lost,
            "draws": lost.sample_count,
            "lost": len(lost.frames),
            "lost_in": dict(zip(map(str, frames.tolist()), counts.tolist(), strict=True)),
            # Known without a search where few are lost at the whole tolerances.
            "borne": 1.0 if lost.few else self.tolerated_part(plan.q, number),
            "samples": CERTIFICATION_SAMPLES,
            "outcome": outcome_sentence(outcomes),
            "holds": holds,
            "holds_at_least": at_least,
            "certified": bool(lost.few and at_least >= float(option(plan, "share"))),
        }
        return replace(plan, meta=plan.meta | {"certificate": found})
