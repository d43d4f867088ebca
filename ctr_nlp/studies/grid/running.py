"""A study on Dask's workers: batches of cases that last two seconds or more, their rows kept as they come.

Only a few batches a worker wait at the scheduler at any time, so that it costs the same however large the study
is. A batch whose worker dies is given again case by case; a case whose worker dies alone, or that takes longer
than it may, is a row that says so.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from ctr_nlp.studies.grid.case import FAILED, Case, lost_row
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.support.extras import needed

SECONDS, FIRST, MOST = 2.0, 2, 200
"""What a batch is to last at least; cases of the first one of a kind, and of any at most."""
SPACING = 0.04
"""s between the ends of two batches, on average, so that client and scheduler keep up with many workers."""
WAITING = 3
"""Batches that are given to each worker, those at work included."""
POLL, ROUND = 0.5, 0.1
"""s between looks at whether to stop while nothing is done, and for which batches that are done are collected."""
PATIENCE = 600.0
"""s that a case may take, where nobody says."""
EXIT = 70
"""With which a worker ends itself whose case takes too long."""

Worked = tuple[list[dict[str, Any]], float]
"""What a batch returns: rows, and the seconds that they took."""
Seen = Callable[["Progress"], None]
"""Told of every batch that is done."""


@dataclass
class Progress:
    """done, failed: cases of total; known: of them what an earlier run had done. busy: process time of cases, s;
    seconds: since the run began.
    """

    total: int
    known: int
    done: int = 0
    failed: int = 0
    busy: float = 0.0
    seconds: float = 0.0

    def grow(self, rows: Sequence[Mapping[str, Any]], seconds: float) -> None:
        """Rows have been kept, so many seconds after the run began."""
        times = [row["process_s"] for row in rows if math.isfinite(row["process_s"])]
        self.done, self.busy, self.seconds = self.done + len(rows), self.busy + sum(times), seconds
        self.failed += sum(row["status"] == FAILED for row in rows)

    @property
    def rate(self) -> float:
        """Cases a second in this run."""
        return (self.done - self.known) / self.seconds if self.seconds else 0.0


@dataclass
class Batches:
    """Cases in batches, each of one kind and as large as cases of that kind have lasted so far."""

    waiting: dict[tuple[str, ...], deque[Case]] = field(default_factory=lambda: defaultdict(deque))
    lasted: dict[tuple[str, ...], tuple[float, int]] = field(default_factory=dict)
    alone: deque[Case] = field(default_factory=deque)

    @classmethod
    def of(cls, cases: Iterable[Case]) -> Batches:
        """Of cases, none of which is known."""
        found = cls()
        for case in cases:
            found.waiting[case.kind].append(case)
        return found

    def __bool__(self) -> bool:
        return bool(self.alone) or any(self.waiting.values())

    def next(self, seconds: float = SECONDS) -> list[Case]:
        """The next batch, which is to last so long."""
        if self.alone:
            return [self.alone.popleft()]
        kind, cases = max(self.waiting.items(), key=lambda one: len(one[1]))
        return [cases.popleft() for _ in range(min(self._size(kind, seconds), len(cases)))]

    def _size(self, kind: tuple[str, ...], seconds: float) -> int:
        lasted, count = self.lasted.get(kind, (0.0, 0))
        return FIRST if not count else min(MOST, max(1, round(seconds * count / max(lasted, 1e-3))))

    def took(self, cases: Sequence[Case], seconds: float) -> None:
        """A batch has lasted so long."""
        before, count = self.lasted.get(cases[0].kind, (0.0, 0))
        self.lasted[cases[0].kind] = before + seconds, count + len(cases)


def run(
    study: Study,
    folder: Path,
    client: Any,
    *,
    keep_plans: bool = False,
    patience: float = PATIENCE,
    seen: Seen = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
) -> Progress:
    """Do the cases of a study that a folder has no rows of, on the workers of a distributed.Client.

    patience: s that a case may take; stop: asked now and then, and after a yes no more is begun. Raises
    OutputError where rows cannot be written, which loses only what was at work.
    """
    results, begin = Results(folder), time.monotonic()
    known = results.known()
    left = [case for case in study.cases if case.digest not in known]
    progress = Progress(len(study), len(study) - len(left), len(study) - len(left))
    plans = folder / "plans" if keep_plans else None
    if plans is not None:
        plans.mkdir(parents=True, exist_ok=True)
    batches, at_work, done = Batches.of(left), dict[Any, list[Case]](), SimpleQueue[Any]()
    seen(progress)
    try:
        while batches or at_work:
            for future in _give(client, batches, at_work, plans, patience):
                future.add_done_callback(done.put)
            if not at_work:
                time.sleep(POLL)  # no worker is there yet
                continue
            if finished := _finished(done):
                found = client.gather(dict(enumerate(finished)), errors="skip")  # None of those that failed
                rows = [
                    row
                    for k, one in enumerate(finished)
                    for row in _rows(one, found[k], at_work.pop(one), batches)
                ]
                results.add(rows)
                progress.grow(rows, time.monotonic() - begin)
                seen(progress)
            if stop():
                break
    finally:
        client.cancel(list(at_work), force=True)
    return progress


def worth(workers: int) -> float:
    """What a batch is to last where so many workers end one each, s."""
    return max(SECONDS, SPACING * workers)


def _give(
    client: Any, batches: Batches, at_work: dict[Any, list[Case]], plans: Path | None, patience: float
) -> Iterator[Any]:
    """Batches to workers, until each has enough; the futures of these."""
    workers = sum(client.nthreads().values())
    while batches and len(at_work) < WAITING * workers:
        cases = batches.next(worth(workers))
        future = client.submit(work, cases, plans, patience, pure=False, retries=0)
        at_work[future] = cases
        yield future


def _finished(done: SimpleQueue[Any]) -> list[Any]:
    """Futures that are done within ROUND seconds of the first one; none where POLL seconds bring none."""
    try:
        found = [done.get(timeout=POLL)]
    except Empty:
        return []
    time.sleep(ROUND)
    while not done.empty():
        found.append(done.get())
    return found


def _rows(future: Any, found: Worked | None, cases: list[Case], batches: Batches) -> list[dict[str, Any]]:
    """The rows of a batch; none where its worker died, and its cases are to be given again, each alone."""
    if found is not None:
        rows, seconds = found
        batches.took(cases, seconds)
        return rows
    if len(cases) > 1:
        batches.alone.extend(cases)
        return []
    return [lost_row(cases[0], f"its worker died or took too long: {future.exception()}"[:500])]


def work(cases: list[Case], plans: Path | None, patience: float) -> Worked:
    """The rows of cases, and the seconds that all took; a case that takes longer than it may ends the process."""
    begin, rows = time.monotonic(), list[dict[str, Any]]()
    for case in cases:
        with _limited(patience):
            rows.append(case.row(plans))
    return rows, time.monotonic() - begin


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """The process ends where the block takes longer."""
    timer = threading.Timer(seconds, os._exit, (EXIT,))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def local_client(workers: int, memory: str = "auto") -> Iterator[Any]:
    """A client of so many processes of this machine, which listen on loopback only, with one thread each.

    Dask's statistical profile, of which each worker keeps a tree a second for three hours, is off: it alone grew
    by 40 KB a plan.
    """
    distributed, dask = needed("distributed"), needed("dask")
    quiet = {"distributed.scheduler.allowed-failures": 0, "distributed.admin.tick.limit": "60s"}
    lean = {"distributed.worker.profile.enabled": False, "distributed.admin.low-level-log-length": 100}
    threads = {
        f"distributed.nanny.pre-spawn-environ.{name}": "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    }
    with (
        dask.config.set(quiet | lean | threads),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=memory,
            silence_logs="CRITICAL",
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client
