"""Batches of a study's cases that last about equally long, and retries of the cases of a lost batch.

Durations are learned for each kind of case. Where the worker of a batch dies, any of its cases may be the cause:
each is given again in a batch of its own, so that a further death names the case.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from ctr_nlp.studies.grid.case import Case

MIN_BATCH_S, FIRST_BATCH_CASES, MAX_BATCH_CASES = 2.0, 2, 200
"""Least duration of a batch, s; number of cases in a first batch of a kind, and largest number in any."""
MIN_BATCH_SPACING_S = 0.04
"""Least mean time between the ends of two batches, s, so that client and scheduler keep up with many workers."""
MAX_WORKER_DEATHS = 3
"""Number of workers that may die of a case, each with only this case at work on it, before it is given up."""


@dataclass
class Batches:
    """Waiting cases, given out in batches of one kind whose size follows from the durations so far.

    waiting: cases by kind. durations: of each kind the total, s, and the number of cases. isolated_cases: cases
    that are given alone, since a worker has died with them.
    """

    waiting: dict[tuple[str, ...], deque[Case]] = field(default_factory=lambda: defaultdict(deque))
    durations: dict[tuple[str, ...], tuple[float, int]] = field(default_factory=dict)
    isolated_cases: deque[Case] = field(default_factory=deque)
    deaths: Counter[str] = field(default_factory=Counter)
    """Number of workers that died of a case alone, by its digest."""

    @classmethod
    def of(cls, cases: Iterable[Case]) -> Batches:
        """Make batches of cases of unknown duration."""
        found = cls()
        for case in cases:
            found.waiting[case.kind].append(case)
        return found

    def __bool__(self) -> bool:
        return bool(self.isolated_cases) or any(self.waiting.values())

    def next(self, seconds: float = MIN_BATCH_S) -> list[Case]:
        """Return the next batch, which should last `seconds`."""
        if self.isolated_cases:
            return [self.isolated_cases.popleft()]
        kind, cases = max(self.waiting.items(), key=lambda one: len(one[1]))
        return [cases.popleft() for _ in range(min(self._size(kind, seconds), len(cases)))]

    def has_suspects(self, at_work: Iterable[Sequence[Case]]) -> bool:
        """Return whether a case of which a worker may die waits or is at work; at_work: batches that were given.

        Nothing else may be queued on its worker then, since it would be lost with it.
        """
        return bool(self.isolated_cases) or any(len(cases) == 1 for cases in at_work)

    def _size(self, kind: tuple[str, ...], seconds: float) -> int:
        lasted, count = self.durations.get(kind, (0.0, 0))
        return (
            FIRST_BATCH_CASES
            if not count
            else min(MAX_BATCH_CASES, max(1, round(seconds * count / max(lasted, 1e-3))))
        )

    def record_duration(self, cases: Sequence[Case], seconds: float) -> None:
        """Record that a batch of cases, all of one kind, has lasted `seconds`."""
        before, count = self.durations.get(cases[0].kind, (0.0, 0))
        self.durations[cases[0].kind] = before + seconds, count + len(cases)

    def record_death(self, cases: Sequence[Case], late: Collection[str]) -> list[Case]:
        """Record that the worker of a batch has died.

        late: digests of cases that exceeded the time limit. Returns the cases that are given up: a late one, and
        one of which MAX_WORKER_DEATHS workers have died. All others will be given again, each alone.
        """
        # In a larger batch any case may have been the cause, and it counts for none.
        if len(cases) == 1:
            self.deaths[cases[0].digest] += 1
        lost = [case for case in cases if case.digest in late or self.deaths[case.digest] == MAX_WORKER_DEATHS]
        self.isolated_cases.extend(case for case in cases if case not in lost)
        return lost


def target_batch_seconds(workers: int) -> float:
    """Return how long a batch should last, s, so that client and scheduler keep up with so many workers."""
    return max(MIN_BATCH_S, MIN_BATCH_SPACING_S * workers)
