"""The cases of a study in batches that last about equally long, and what becomes of the cases of a lost batch."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from ctr_nlp.studies.grid.case import Case

SECONDS, FIRST, MOST = 2.0, 2, 200
"""Least duration of a batch, s; cases of the first one of a kind, and most cases of any."""
SPACING = 0.04
"""s between the ends of two batches, on average, so that client and scheduler keep up with many workers."""
TRIES = 3
"""Workers that a case may cost, each with nothing else at work on it, before it is given up."""


@dataclass
class Batches:
    """Cases in batches, each of one kind and as large as cases of that kind have lasted so far."""

    waiting: dict[tuple[str, ...], deque[Case]] = field(default_factory=lambda: defaultdict(deque))
    lasted: dict[tuple[str, ...], tuple[float, int]] = field(default_factory=dict)
    alone: deque[Case] = field(default_factory=deque)
    deaths: Counter[str] = field(default_factory=Counter)
    """Workers that died of a case alone, by its digest."""

    @classmethod
    def of(cls, cases: Iterable[Case]) -> Batches:
        """Make batches of cases, when nothing is known of how long they last."""
        found = cls()
        for case in cases:
            found.waiting[case.kind].append(case)
        return found

    def __bool__(self) -> bool:
        return bool(self.alone) or any(self.waiting.values())

    def next(self, seconds: float = SECONDS) -> list[Case]:
        """Return the next batch, which is to last `seconds`."""
        if self.alone:
            return [self.alone.popleft()]
        kind, cases = max(self.waiting.items(), key=lambda one: len(one[1]))
        return [cases.popleft() for _ in range(min(self._size(kind, seconds), len(cases)))]

    def suspects(self, at_work: Iterable[Sequence[Case]]) -> bool:
        """Whether a case of which a worker may die waits or is at work: nothing else may wait on its worker."""
        return bool(self.alone) or any(len(cases) == 1 for cases in at_work)

    def _size(self, kind: tuple[str, ...], seconds: float) -> int:
        lasted, count = self.lasted.get(kind, (0.0, 0))
        return FIRST if not count else min(MOST, max(1, round(seconds * count / max(lasted, 1e-3))))

    def took(self, cases: Sequence[Case], seconds: float) -> None:
        """Remember that a batch has lasted `seconds`."""
        before, count = self.lasted.get(cases[0].kind, (0.0, 0))
        self.lasted[cases[0].kind] = before + seconds, count + len(cases)

    def died(self, cases: Sequence[Case], late: Collection[str]) -> list[Case]:
        """Note that the worker of a batch has died; late: digests of cases that took longer than they may.

        Returns the cases that are given up: a late one, and one that has cost its last worker alone. All others
        will be given again, each alone.
        """
        if len(cases) == 1:
            self.deaths[cases[0].digest] += 1
        lost = [case for case in cases if case.digest in late or self.deaths[case.digest] == TRIES]
        self.alone.extend(case for case in cases if case not in lost)
        return lost


def worth(workers: int) -> float:
    """Return how long a batch is to last, s, so that client and scheduler keep up with so many workers."""
    return max(SECONDS, SPACING * workers)
