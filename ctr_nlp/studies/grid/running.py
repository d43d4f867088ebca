"""A study on Dask's workers: batches of cases that last a second or more, their rows kept as they come.

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
from typing import Any

from ctr_nlp.studies.grid.case import FAILED, Case, lost_row
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.support.extras import needed

SECONDS, FIRST, MOST = 2.0, 2, 200
"""What a batch is to last; cases of the first one of a kind, and of any at most."""
WAITING = 3
"""Batches that are given to each worker, those at work included."""
POLL = 0.5
"""s between looks at whether to stop while nothing is done."""
PATIENCE = 600.0
"""s that a case may take, where nobody says."""
EXIT = 70
"""With which a worker ends itself whose case takes too long."""

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

    def next(self) -> list[Case]:
        """The next batch."""
        if self.alone:
            return [self.alone.popleft()]
        kind, cases = max(self.waiting.items(), key=lambda one: len(one[1]))
        return [cases.popleft() for _ in range(min(self._size(kind), len(cases)))]

    def _size(self, kind: tuple[str, ...]) -> int:
        seconds, count = self.lasted.get(kind, (0.0, 0))
        return FIRST if not count else min(MOST, max(1, round(SECONDS * count / max(seconds, 1e-3))))

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
    distributed = needed("distributed")
    results, begin = Results(folder), time.monotonic()
    known = results.known()
    left = [case for case in study.cases if case.digest not in known]
    progress = Progress(len(study), len(study) - len(left), len(study) - len(left))
    plans = folder / "plans" if keep_plans else None
    if plans is not None:
        plans.mkdir(parents=True, exist_ok=True)
    batches, at_work = Batches.of(left), dict[Any, list[Case]]()
    seen(progress)
    try:
        while batches or at_work:
            _give(client, batches, at_work, plans, patience)
            if not at_work:
                time.sleep(POLL)  # no worker is there yet
                continue
            finished = _finished(distributed, at_work)
            for future in finished:
                rows = _rows(future, at_work.pop(future), batches)
                results.add(rows)
                progress.grow(rows, time.monotonic() - begin)
            if finished:
                seen(progress)
            if stop():
                break
    finally:
        client.cancel(list(at_work), force=True)
    return progress


def _give(
    client: Any, batches: Batches, at_work: dict[Any, list[Case]], plans: Path | None, patience: float
) -> None:
    """Batches to workers, until each has enough."""
    wanted = WAITING * sum(client.nthreads().values())
    while batches and len(at_work) < wanted:
        cases = batches.next()
        at_work[client.submit(work, cases, plans, patience, pure=False, retries=0)] = cases


def _finished(distributed: Any, at_work: dict[Any, list[Case]]) -> list[Any]:
    """Futures that are done by now, or as soon as one is; none after POLL seconds."""
    try:
        return list(distributed.wait(list(at_work), timeout=POLL, return_when="FIRST_COMPLETED").done)
    except (TimeoutError, distributed.TimeoutError):
        return []


def _rows(future: Any, cases: list[Case], batches: Batches) -> list[dict[str, Any]]:
    """The rows of a batch; none where its worker died, and its cases are to be given again, each alone."""
    if future.status == "finished":
        rows: list[dict[str, Any]]
        rows, seconds = future.result()
        batches.took(cases, seconds)
        return rows
    if len(cases) > 1:
        batches.alone.extend(cases)
        return []
    return [lost_row(cases[0], f"its worker died or took too long: {future.exception()}"[:500])]


def work(cases: list[Case], plans: Path | None, patience: float) -> tuple[list[dict[str, Any]], float]:
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
