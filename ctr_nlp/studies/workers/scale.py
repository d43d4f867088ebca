"""What a study costs beside its plans, and what one of any size will take on any number of workers.

The cost of a batch is measured with cases that do nothing; what is projected from it is confirmed by a study whose
cases sleep for as long as plans take.
"""

from __future__ import annotations

import math
import pickle
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

from ctr_nlp.studies.grid.case import DONE, Case
from ctr_nlp.studies.grid.results import ROWS
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers.batches import FIRST, MOST, worth
from ctr_nlp.studies.workers.clients import local_client
from ctr_nlp.studies.workers.running import WAITING, Progress, run_study

THREADS = 16
"""Threads of each worker of a simulated cluster."""
NUMBERS, SENTENCES = 48, 16
"""Columns of a row that stand for those of a plan."""
COUNTED = 400
"""Cases whose memory is counted."""


@dataclass(frozen=True)
class Sleeper(Case):
    """A case that sleeps where others plan. group: of cases that are put into batches together."""

    sleep_s: float = 0.0
    group: str = ""

    @property
    def kind(self) -> tuple[str, ...]:
        """Group of the case, which decides with which others it is put into batches."""
        return (self.group,)

    def row(self, keep: Path | None = None) -> dict[str, Any]:
        """Sleep, and return a row that is about as long as that of a plan."""
        time.sleep(self.sleep_s)
        numbers = {f"number_{k}": self.seed + 0.1 * k for k in range(NUMBERS)}
        words = {f"sentence_{k}": f"All 25 frames of {self.seed} are within {k} mm." for k in range(SENTENCES)}
        return self.columns | numbers | words | {"status": DONE, "reason": "", "process_s": self.sleep_s}


def sleepers(seconds: Sequence[float], group: int = 0) -> Study:
    """Make a study of cases that sleep for `seconds` each; group: how many of them share a kind, 0 for all."""
    own = ("arc", "", "its own", None, "dominant", "horizon", 25)
    cases = [
        Sleeper(*own, seed=k, sleep_s=each, group=str(k // group) if group else "")
        for k, each in enumerate(seconds)
    ]
    return Study("sleepers", tuple(cases))


@dataclass(frozen=True)
class Cost:
    """Cost of a study beside its plans.

    Process time of the client's thread and of the scheduler's, of a batch and of each of its rows; s a case before
    the first batch is given; bytes a case of messages both ways, of its row on disk, and of memory at the client.
    """

    client_batch_s: float
    client_row_s: float
    scheduler_batch_s: float
    scheduler_row_s: float
    prepare_s: float
    message_bytes: float
    row_bytes: float
    case_bytes: float


@dataclass(frozen=True)
class Scale:
    """A study as a whole: s, bytes, and shares of its wall time; tasks: at the scheduler at once, at most."""

    wall_s: float
    efficiency: float
    batches: float
    tasks: float
    client_share: float
    scheduler_share: float
    rows_bytes: float
    messages_bytes: float
    client_bytes: float


def projected(plans: int, workers: int, seconds: float, cost: Cost) -> Scale:
    """Project a study of so many plans of so many seconds on average onto so many workers.

    Workers wait for the last batch, half of one on average; client and scheduler are taken to work in turns, as on
    one core, and whichever is slower, they or the workers, decides. What prepares the study comes before.
    """
    first = min(plans, FIRST * WAITING * workers)
    size = min(MOST, max(1, round(worth(workers) / seconds)))
    batches = first / FIRST + (plans - first) / size
    client = batches * cost.client_batch_s + plans * cost.client_row_s
    scheduler = batches * cost.scheduler_batch_s + plans * cost.scheduler_row_s
    ideal = plans * seconds / workers
    wall = plans * cost.prepare_s + max(ideal + size * seconds / 2, client + scheduler)
    return Scale(
        wall_s=wall,
        efficiency=ideal / wall,
        batches=batches,
        tasks=min(batches, WAITING * workers),
        client_share=client / wall,
        scheduler_share=scheduler / wall,
        rows_bytes=plans * cost.row_bytes,
        messages_bytes=plans * cost.message_bytes,
        client_bytes=plans * cost.case_bytes,
    )


def measured(batches: int = 200) -> Cost:
    """Measure the cost on this machine, of so many small batches and a fifth of that in large ones, which do
    nothing.
    """
    small = sleepers([0.0] * (FIRST * batches), group=FIRST)
    large = sleepers([0.0] * (MOST * batches // 5))
    with local_client(2) as client:
        spent = [_spent(study, client) for study in (small, large)]
    counts = np.array([[batches, FIRST * batches], [batches / 5, MOST * batches / 5]])
    per_batch, per_row = np.maximum(np.linalg.solve(counts, np.array([each[:2] for each in spent])), 0.0)
    prepare_s, case_bytes = _prepared()
    cases = list(large.cases[:MOST])
    message = len(pickle.dumps(cases)) + len(pickle.dumps([case.row() for case in cases]))
    return Cost(
        *(per_batch[0], per_row[0], per_batch[1], per_row[1]),
        prepare_s=prepare_s,
        message_bytes=message / MOST,
        row_bytes=spent[1][2] / len(large),
        case_bytes=case_bytes,
    )


def _spent(study: Study, client: Any) -> tuple[float, float, int]:
    """Run a study; return process times of the client's thread and of the scheduler's, s, and bytes of rows."""
    loop = client.cluster.loop
    with tempfile.TemporaryDirectory() as folder:
        before = time.thread_time(), _in(loop, time.thread_time)
        run_study(study, Path(folder), client)
        after = time.thread_time(), _in(loop, time.thread_time)
        return after[0] - before[0], after[1] - before[1], _bytes(Path(folder))


def _in(loop: Any, call: Callable[[], float]) -> float:
    """Call a function in the thread of an event loop, and return its result."""
    answer = SimpleQueue[float]()
    loop.add_callback(lambda: answer.put(call()))
    return answer.get(timeout=60.0)


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in (folder / ROWS).glob("*.parquet"))


def _prepared() -> tuple[float, float]:
    """Return the process time of making a case and its digest, s, and the bytes that it takes."""
    begin = time.process_time()
    sleepers([0.0] * COUNTED)
    seconds = time.process_time() - begin
    tracemalloc.start()
    kept = sleepers([0.0] * COUNTED)
    taken = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return seconds / len(kept), taken / len(kept)


def simulated(seconds: Sequence[float], workers: int) -> Scale:
    """Run a study of cases that sleep for `seconds` each, on a cluster of `workers` threads of this process, whose
    messages go over loopback. Figures that cannot be measured so are nan: client, scheduler and workers share one
    process.
    """
    begin, tasks = time.monotonic(), [0]
    study = sleepers(seconds)
    prepared = time.monotonic() - begin
    with _threads(workers) as client, tempfile.TemporaryDirectory() as folder:
        counting = _Counting(client)

        def seen(progress: Progress) -> None:
            tasks.append(len(client.cluster.scheduler.tasks))

        progress = run_study(study, Path(folder), counting, seen=seen)
        rows_bytes = _bytes(Path(folder))
    wall = prepared + progress.seconds
    return Scale(
        wall_s=wall,
        efficiency=sum(seconds) / workers / wall,
        batches=counting.batches,
        tasks=max(tasks),
        client_share=math.nan,
        scheduler_share=math.nan,
        rows_bytes=rows_bytes,
        messages_bytes=math.nan,
        client_bytes=math.nan,
    )


class _Counting:
    """A client that counts what is given to it."""

    def __init__(self, client: Any) -> None:
        self._client, self.batches = client, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)

    def submit(self, *given: Any, **options: Any) -> Any:
        """Submit work as the client does, and count it."""
        self.batches += 1
        return self._client.submit(*given, **options)


def _threads(workers: int) -> AbstractContextManager[Any]:
    """Return a client of `workers` threads of this process."""
    each = math.gcd(workers, THREADS)
    threads = {"threads_per_worker": each, "processes": False, "protocol": "tcp://", "dashboard_address": None}
    return local_client(workers // each, "0", **threads)
