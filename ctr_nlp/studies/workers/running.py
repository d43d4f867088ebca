"""A study on Dask's workers: batches of cases, given a few at a time, their rows kept as they come.

Only a few batches a worker wait at the scheduler at any time, so that it costs the same however large the study
is. A batch whose worker dies is given again case by case, each to a worker of its own; a case that costs several
workers, or takes longer than it may once, is a row that says so.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from ctr_nlp.exceptions import ClusterError, CtrError
from ctr_nlp.studies.grid.case import DONE, LATE, LOST, PATIENCE_S, Case, row_without_plan
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers import task
from ctr_nlp.studies.workers.batches import TRIES, Batches, worth
from ctr_nlp.studies.workers.clients import local_client, loss_told, losses
from ctr_nlp.support.extras import needed

WAITING = 3
"""Batches that are given to each worker, those at work included."""
POLL, ROUND = 0.5, 0.1
"""s between looks at whether to stop while nothing is done, and for which batches that are done are collected."""
PATIENCE = 600.0
"""s that a case may take, where nobody says."""

Seen = Callable[["Progress"], None]
"""Told of every batch that is done, and while no worker is there."""


@dataclass
class Progress:
    """done, failed: cases of total; known: of them what an earlier run had done. busy: process time of cases, s;
    seconds: since the run began; workers: threads of the cluster.
    """

    total: int
    known: int
    done: int = 0
    failed: int = 0
    busy: float = 0.0
    seconds: float = 0.0
    workers: int = 0

    def grow(self, rows: Sequence[Mapping[str, Any]], seconds: float, workers: int) -> None:
        """Rows have been kept, so many seconds after the run began, while there are so many workers."""
        self.workers = workers
        times = [row["process_s"] for row in rows if math.isfinite(row["process_s"])]
        self.done, self.busy, self.seconds = self.done + len(rows), self.busy + sum(times), seconds
        self.failed += sum(row["status"] != DONE for row in rows)

    @property
    def rate(self) -> float:
        """Cases a second in this run."""
        return (self.done - self.known) / self.seconds if self.seconds else 0.0


def run_study(
    study: Study,
    folder: str | Path,
    client: Any = None,
    *,
    keep_plans: bool = False,
    patience: float = PATIENCE,
    seen: Seen = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
) -> Progress:
    """Do the cases of a study that a folder has no rows of, on the workers of a Dask cluster.

    Parameters
    ----------
    study : Study
        The cases.
    folder : str or Path
        Where rows are kept; one study at a time works in it.
    client : distributed.Client, optional
        Of the cluster; None for processes of this machine, one a core, which import the program that asks for
        them: it must do so below ``if __name__ == "__main__":``.
    keep_plans : bool
        Whether plans are written into folder/plans, too.
    patience : float
        Seconds that a case may take.
    seen : callable
        Called with the progress at the beginning, after every batch, and while no worker is there.
    stop : callable
        Asked now and then; after a yes no more is begun.

    Returns
    -------
    Progress
        How many cases are done.

    Raises
    ------
    OutputError
        Rows or plans cannot be written, or another study is at work in the folder.
    ClusterError
        The scheduler is lost, or workers cannot do the cases. Only what was at work is lost.
    """
    results, begin = Results(Path(folder)), time.monotonic()
    with results.sole_writer():
        results.forget_lost(patience)
        known = results.known()
        left = [case for case in study.cases if case.digest not in known]
        progress = Progress(len(study), len(study) - len(left), len(study) - len(left))
        plans = Path(folder) / "plans" if keep_plans else None
        seen(progress)
        here = local_client(os.cpu_count() or 1) if client is None else nullcontext(client)
        with here as workers, _late(workers) as late:
            at_work = _AtWork(workers, Batches.of(left), late, plans, patience)
            try:
                while at_work:
                    with loss_told():
                        threads = at_work.give()
                        rows, lost = at_work.take()
                    results.add(rows)
                    results.add_lost(lost)
                    progress.grow([*rows, *lost], time.monotonic() - begin, threads)
                    if rows or lost or not threads:
                        seen(progress)
                    if stop():
                        break
            finally:
                at_work.cancel()
        return progress


@contextmanager
def _late(client: Any) -> Iterator[set[str]]:
    """Digests of cases of which workers tell within the block that they take too long."""
    digests = set[str]()
    client.subscribe_topic(task.TOO_LONG, lambda event: digests.add(event[1]))
    try:
        yield digests
    finally:
        with suppress(*losses(), ValueError):
            client.unsubscribe_topic(task.TOO_LONG)


class _AtWork:
    """Batches that workers have, and those that wait to be given."""

    def __init__(self, client: Any, batches: Batches, late: set[str], plans: Path | None, patience: float) -> None:
        self._client, self._batches, self._late = client, batches, late
        self._plans, self._patience = plans, patience
        self._given, self._done = dict[Any, list[Case]](), SimpleQueue[Any]()

    def __bool__(self) -> bool:
        return bool(self._batches) or bool(self._given)

    def give(self) -> int:
        """Give batches to workers until each has enough; returns how many workers there are."""
        workers = sum(self._client.nthreads().values())
        while self._batches and len(self._given) < workers * self._each():
            cases = self._batches.next(worth(workers))
            asked = (task.work, cases, self._plans, self._patience)
            future = self._client.submit(*asked, pure=False, retries=0)
            self._given[future] = cases
            future.add_done_callback(self._done.put)
        return workers

    def _each(self) -> int:
        return 1 if self._batches.suspects(self._given.values()) else WAITING

    def take(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Rows of what is done within ROUND seconds of the first batch, and rows of cases that are given up.

        Neither, where nothing is done within POLL seconds. Raises as run_study does.
        """
        futures = self._finished()
        if not futures:
            return [], []
        found = self._client.gather(dict(enumerate(futures)), errors="skip")  # None of those that failed
        rows, lost = list[dict[str, Any]](), list[dict[str, Any]]()
        for number, future in enumerate(futures):
            cases = self._given.pop(future)
            if found[number] is None:
                lost += self._rows_of_lost(cases, future.exception())
            else:
                made, seconds = found[number]
                self._batches.took(cases, seconds)
                rows += made
        return rows, lost

    def _finished(self) -> list[Any]:
        try:
            futures = [self._done.get(timeout=POLL)]
        except Empty:
            return []
        time.sleep(ROUND)
        while not self._done.empty():
            futures.append(self._done.get())
        return futures

    def _rows_of_lost(self, cases: list[Case], error: BaseException) -> list[dict[str, Any]]:
        """Rows of the cases of a batch that are given up since its worker died; other errors are raised."""
        if isinstance(error, CtrError | needed("distributed").CancelledError):
            raise error
        if not isinstance(error, needed("distributed").KilledWorker):
            told = f"its scheduler and workers need ctr_nlp as it is here ({type(error).__name__}: {error})"[:500]
            raise ClusterError(f"the cluster cannot do what this study asks for: {told}") from error
        rows = []
        for case in self._batches.died(cases, self._late):
            if case.digest in self._late:
                told = f"it took longer than {self._patience:g} s"
                rows.append(row_without_plan(case, LATE, told, math.nan) | {PATIENCE_S: self._patience})
            else:
                told = f"{TRIES} workers died of it, one after the other: {error}"[:500]
                rows.append(row_without_plan(case, LOST, told, math.nan))
        return rows

    def cancel(self) -> None:
        """Take back what is not done."""
        with suppress(*losses()):
            self._client.cancel(list(self._given), force=True)
