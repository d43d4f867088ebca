"""Execution of a study on Dask's workers: batches of cases, submitted a few at a time, rows written as they come.

Only a few batches per worker wait at the scheduler at any time, so that its cost does not grow with the study. A
batch whose worker dies is submitted again case by case, each to a worker of its own. A case of which several
workers die, or that exceeds the time limit once, gets a row that says so.
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
from ctr_nlp.studies.grid.case import CASE_DONE, CASE_LATE, CASE_LOST, TIME_LIMIT_COLUMN, Case, row_without_plan
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers import task
from ctr_nlp.studies.workers.batches import MAX_WORKER_DEATHS, Batches, target_batch_seconds
from ctr_nlp.studies.workers.clients import local_client, report_scheduler_loss, scheduler_loss_errors
from ctr_nlp.support.extras import import_extra

BATCHES_PER_WORKER = 3
"""Number of batches submitted for each worker, those at work included."""
STUDY_STOP_POLL_S, BATCH_COLLECTION_S = 0.5, 0.1
"""Time between two calls of stop() while no batch ends, and time for which finished batches are collected, s."""
DEFAULT_CASE_TIMEOUT_S = 600.0
"""Default time limit of a case, s."""

StudyCallback = Callable[["StudyProgress"], None]
"""Called with the progress after every batch, and while there is no worker."""


@dataclass
class StudyProgress:
    """Progress of a study.

    total: number of cases; done, failed: of these; done_before: of the done ones those of earlier runs. process_s:
    process time of the cases, s; seconds: since the run began; workers: threads of the cluster, None before they
    are counted.
    """

    total: int
    done_before: int
    done: int = 0
    failed: int = 0
    process_s: float = 0.0
    seconds: float = 0.0
    workers: int | None = None

    def add_rows(self, rows: Sequence[Mapping[str, Any]], seconds: float, workers: int) -> None:
        """Count rows that were written, `seconds` after the run began, with so many workers at that time."""
        self.workers = workers
        # Cases that were given up have no process time: theirs is NaN.
        times = [row["process_s"] for row in rows if math.isfinite(row["process_s"])]
        self.done = self.done + len(rows)
        self.process_s = self.process_s + sum(times)
        self.seconds = seconds
        self.failed += sum(row["status"] != CASE_DONE for row in rows)

    @property
    def workers_in_words(self) -> str:
        """How many plans are made at a time, or that no worker is there; empty before workers are counted."""
        if self.workers is None or self.done == self.total:
            return ""
        if not self.workers:
            return "no worker is there"
        return "1 plan at a time" if self.workers == 1 else f"{self.workers} plans at a time"

    @property
    def rate(self) -> float:
        """Cases per second in this run."""
        return (self.done - self.done_before) / self.seconds if self.seconds else 0.0


def run_study(
    study: Study,
    folder: str | Path,
    client: Any = None,
    *,
    keep_plans: bool = False,
    patience: float = DEFAULT_CASE_TIMEOUT_S,
    callback: StudyCallback = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
) -> StudyProgress:
    """Plan the cases of a study that have no rows in a folder yet, on the workers of a Dask cluster.

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
        Time limit of a case, s.
    callback : callable
        Called with the progress at the beginning, when the workers are counted, after every batch, and while no
        worker is there.
    stop : callable
        Called regularly; after it has returned True nothing more is started.

    Returns
    -------
    StudyProgress
        How many cases are done.

    Raises
    ------
    OutputError
        Rows or plans cannot be written, or another study is at work in the folder.
    ClusterError
        The scheduler is lost, or workers cannot do the cases. Only what was at work is lost.
    """
    results = Results(Path(folder))
    begin = time.monotonic()
    with results.sole_writer():
        results.delete_retryable_rows(patience)
        known = results.read_digests()
        left = [case for case in study.cases if case.digest not in known]
        progress = StudyProgress(len(study), len(study) - len(left), len(study) - len(left))
        plans = Path(folder) / "plans" if keep_plans else None
        callback(progress)
        here = local_client(os.cpu_count() or 1) if client is None else nullcontext(client)
        with here as workers, _overdue_digests(workers) as late:
            at_work = _BatchDispatcher(workers, Batches.of(left), late, plans, patience)
            try:
                while at_work:
                    with report_scheduler_loss():
                        threads = at_work.submit_batches()
                        if progress.workers is None:
                            progress.add_rows([], time.monotonic() - begin, threads)
                            callback(progress)
                        rows, lost = at_work.collect_rows()
                    results.add(rows)
                    results.add_retryable_rows(lost)
                    progress.add_rows([*rows, *lost], time.monotonic() - begin, threads)
                    if rows or lost or not threads:
                        callback(progress)
                    if stop():
                        break
            finally:
                at_work.cancel()
        return progress


@contextmanager
def _overdue_digests(client: Any) -> Iterator[set[str]]:
    """Yield the set of digests of cases that workers report, within the block, as exceeding the time limit."""
    digests = set[str]()
    client.subscribe_topic(task.CASE_TIMEOUT_TOPIC, lambda event: digests.add(event[1]))
    try:
        yield digests
    finally:
        with suppress(*scheduler_loss_errors(), ValueError):
            client.unsubscribe_topic(task.CASE_TIMEOUT_TOPIC)


class _BatchDispatcher:
    """Batches at work and batches that wait to be submitted."""

    def __init__(self, client: Any, batches: Batches, late: set[str], plans: Path | None, patience: float) -> None:
        self._client = client
        self._batches = batches
        self._late = late
        self._plans = plans
        self._patience = patience
        self._given = dict[Any, list[Case]]()
        self._done = SimpleQueue[Any]()

    def __bool__(self) -> bool:
        return bool(self._batches) or bool(self._given)

    def submit_batches(self) -> int:
        """Submit batches until each worker has enough; returns the number of workers' threads."""
        workers = sum(self._client.nthreads().values())
        while self._batches and len(self._given) < workers * self._batches_per_worker():
            cases = self._batches.next(target_batch_seconds(workers))
            asked = (task.run_batch, cases, self._plans, self._patience)
            # Not pure: Dask would identify equal calls, and return the old failure where a batch is submitted
            # again.
            future = self._client.submit(*asked, pure=False, retries=0)
            self._given[future] = cases
            future.add_done_callback(self._done.put)
        return workers

    def _batches_per_worker(self) -> int:
        return 1 if self._batches.has_suspects(self._given.values()) else BATCHES_PER_WORKER

    def collect_rows(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Wait for a batch, and return rows of finished cases and rows of cases that are given up.

        Batches that end within BATCH_COLLECTION_S of the first are collected with it. Both lists are empty where
        none ends within STUDY_STOP_POLL_S. Raises as run_study does.
        """
        futures = self._finished_futures()
        if not futures:
            return [], []
        found = self._client.gather(dict(enumerate(futures)), errors="skip")  # None of those that failed
        rows = list[dict[str, Any]]()
        lost = list[dict[str, Any]]()
        for number, future in enumerate(futures):
            cases = self._given.pop(future)
            if found[number] is None:
                lost += self._rows_of_dropped(cases, future.exception())
            else:
                made, seconds = found[number]
                self._batches.record_duration(cases, seconds)
                rows += made
        return rows, lost

    def _finished_futures(self) -> list[Any]:
        try:
            futures = [self._done.get(timeout=STUDY_STOP_POLL_S)]
        except Empty:
            return []
        # Files are written for each collection: a short wait makes few large ones of many small ones.
        time.sleep(BATCH_COLLECTION_S)
        while not self._done.empty():
            futures.append(self._done.get())
        return futures

    def _rows_of_dropped(self, cases: list[Case], error: BaseException) -> list[dict[str, Any]]:
        """Return rows of the cases that are given up since their batch's worker died; raises other errors."""
        if isinstance(error, CtrError | import_extra("distributed").CancelledError):
            raise error
        if not isinstance(error, import_extra("distributed").KilledWorker):
            told = f"its scheduler and workers need ctr_nlp as it is here ({type(error).__name__}: {error})"[:500]
            raise ClusterError(f"the cluster cannot do what this study asks for: {told}") from error
        rows = []
        for case in self._batches.record_death(cases, self._late):
            if case.digest in self._late:
                told = f"it took longer than {self._patience:g} s"
                rows.append(
                    row_without_plan(case, CASE_LATE, told, math.nan) | {TIME_LIMIT_COLUMN: self._patience}
                )
            else:
                told = f"{MAX_WORKER_DEATHS} workers died of it, one after the other: {error}"[:500]
                rows.append(row_without_plan(case, CASE_LOST, told, math.nan))
        return rows

    def cancel(self) -> None:
        """Cancel all batches that are not done."""
        with suppress(*scheduler_loss_errors()):
            self._client.cancel(list(self._given), force=True)
