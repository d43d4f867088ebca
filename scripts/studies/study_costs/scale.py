"""Overhead of a study beside its plans, and projection to studies of any size on any number of workers.

The overhead is c_b per batch and c_r per row, at the client and at the scheduler, measured with cases that do
nothing. The projection is confirmed by a study whose cases sleep for as long as plans take.
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

from ctr_nlp.studies.grid.case import CASE_DONE, Case
from ctr_nlp.studies.grid.results import ROWS_FOLDER
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers.batches import FIRST_BATCH_CASES, MAX_BATCH_CASES, target_batch_seconds
from ctr_nlp.studies.workers.clients import local_client
from ctr_nlp.studies.workers.running import BATCHES_PER_WORKER, StudyProgress, run_study

SIMULATED_WORKER_THREADS = 16
"""Threads of each worker of a simulated cluster."""
SLEEPER_NUMBER_COLUMNS, SLEEPER_TEXT_COLUMNS = 48, 16
"""Numbers of columns of a sleeper's row, about those of a plan's row."""
MEMORY_MEASURED_CASES = 400
"""Number of cases whose memory is measured."""


@dataclass(frozen=True)
class Sleeper(Case):
    """A case that sleeps for sleep_s seconds instead of planning; group: of cases that share batches."""

    sleep_s: float = 0.0
    group: str = ""

    @property
    def kind(self) -> tuple[str, ...]:
        """Group of the case; only cases of one kind share a batch."""
        return (self.group,)

    def row(self, keep: Path | None = None) -> dict[str, Any]:
        """Sleep, and return a row about as long as that of a plan; `keep` is ignored."""
        time.sleep(self.sleep_s)
        numbers = {f"number_{k}": self.seed + 0.1 * k for k in range(SLEEPER_NUMBER_COLUMNS)}
        words = {
            f"sentence_{k}": f"All 25 frames of {self.seed} are within {k} mm."
            for k in range(SLEEPER_TEXT_COLUMNS)
        }
        return self.columns | numbers | words | {"status": CASE_DONE, "reason": "", "process_s": self.sleep_s}


def sleeper_study(seconds: Sequence[float], group: int = 0) -> Study:
    """Make a study of cases that sleep for `seconds` (n,) s; group: how many of them share a kind, 0 for all."""
    own = ("arc", "", "its own", None, "dominant", "horizon", 25)
    cases = [
        Sleeper(*own, seed=k, sleep_s=each, group=str(k // group) if group else "")
        for k, each in enumerate(seconds)
    ]
    return Study("sleepers", tuple(cases))


@dataclass(frozen=True)
class StudyCost:
    """Overhead of a study beside its plans.

    client_*, scheduler_*: processor time of that thread for a batch and for each of its rows, s. prepare_s: time
    per case before the first batch, s. message_bytes, row_bytes, case_bytes: per case, of messages both ways, of
    its row on disk, and of memory at the client.
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
class StudyScale:
    """Figures of a whole study: times, s, bytes, and shares of its wall time.

    efficiency: ideal over real wall time. tasks: largest number at the scheduler at a time.
    """

    wall_s: float
    efficiency: float
    batches: float
    tasks: float
    client_share: float
    scheduler_share: float
    rows_bytes: float
    messages_bytes: float
    client_bytes: float


def project_study(plans: int, workers: int, seconds: float, cost: StudyCost) -> StudyScale:
    """Project the wall time and other figures of a study of so many plans on so many workers.

    seconds: mean duration of a plan, s. cost: measured overhead. Workers wait half a batch for the last one on
    average. Client and scheduler are taken to work in turns, as on one core; the slower of them and the workers
    decides. Preparation comes before.
    """
    # The first batches of each worker are small, since durations are not known yet.
    first = min(plans, FIRST_BATCH_CASES * BATCHES_PER_WORKER * workers)
    size = min(MAX_BATCH_CASES, max(1, round(target_batch_seconds(workers) / seconds)))
    batches = first / FIRST_BATCH_CASES + (plans - first) / size
    client = batches * cost.client_batch_s + plans * cost.client_row_s
    scheduler = batches * cost.scheduler_batch_s + plans * cost.scheduler_row_s
    ideal = plans * seconds / workers
    wall = plans * cost.prepare_s + max(ideal + size * seconds / 2, client + scheduler)
    return StudyScale(
        wall_s=wall,
        efficiency=ideal / wall,
        batches=batches,
        tasks=min(batches, BATCHES_PER_WORKER * workers),
        client_share=client / wall,
        scheduler_share=scheduler / wall,
        rows_bytes=plans * cost.row_bytes,
        messages_bytes=plans * cost.message_bytes,
        client_bytes=plans * cost.case_bytes,
    )


def measure_study_cost(batches: int = 200) -> StudyCost:
    """Measure the overhead on this machine, with `batches` small ones of idle cases and a fifth as many large."""
    small = sleeper_study([0.0] * (FIRST_BATCH_CASES * batches), group=FIRST_BATCH_CASES)
    large = sleeper_study([0.0] * (MAX_BATCH_CASES * batches // 5))
    with local_client(2) as client:
        spent = [_measure_study(study, client) for study in (small, large)]
    counts = np.array([[batches, FIRST_BATCH_CASES * batches], [batches / 5, MAX_BATCH_CASES * batches / 5]])
    # Two studies, two unknowns: time = batches c_b + rows c_r, solved for client and scheduler at once. Noise
    # could make a small cost negative.
    per_batch, per_row = np.maximum(np.linalg.solve(counts, np.array([each[:2] for each in spent])), 0.0)
    prepare_s, case_bytes = _measure_preparation()
    cases = list(large.cases[:MAX_BATCH_CASES])
    message = len(pickle.dumps(cases)) + len(pickle.dumps([case.row() for case in cases]))
    return StudyCost(
        *(per_batch[0], per_row[0], per_batch[1], per_row[1]),
        prepare_s=prepare_s,
        message_bytes=message / MAX_BATCH_CASES,
        row_bytes=spent[1][2] / len(large),
        case_bytes=case_bytes,
    )


def _measure_study(study: Study, client: Any) -> tuple[float, float, int]:
    """Run a study; return processor times of the client's and the scheduler's thread, s, and bytes of its rows."""
    loop = client.cluster.loop
    with tempfile.TemporaryDirectory() as folder:
        # thread_time is that of the calling thread: the scheduler's has to be read in its own event loop.
        before = time.thread_time(), _call_in_loop(loop, time.thread_time)
        run_study(study, Path(folder), client)
        after = time.thread_time(), _call_in_loop(loop, time.thread_time)
        return after[0] - before[0], after[1] - before[1], _rows_bytes(Path(folder))


def _call_in_loop(loop: Any, call: Callable[[], float]) -> float:
    """Call a function in the thread of an event loop, and return its result."""
    answer = SimpleQueue[float]()
    loop.add_callback(lambda: answer.put(call()))
    return answer.get(timeout=60.0)


def _rows_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in (folder / ROWS_FOLDER).glob("*.parquet"))


def _measure_preparation() -> tuple[float, float]:
    """Return the processor time of making a case and its digest, s, and its memory, bytes."""
    begin = time.process_time()
    sleeper_study([0.0] * MEMORY_MEASURED_CASES)
    seconds = time.process_time() - begin
    # Made a second time for memory, since tracing slows the code down.
    tracemalloc.start()
    kept = sleeper_study([0.0] * MEMORY_MEASURED_CASES)
    taken = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return seconds / len(kept), taken / len(kept)


def simulate_study(seconds: Sequence[float], workers: int) -> StudyScale:
    """Run a study of cases that sleep for `seconds` (n,) s on a cluster of `workers` threads of this process.

    Messages go over loopback. Client, scheduler and workers share one process, so that their shares of time and
    their memory cannot be measured and are NaN.
    """
    begin = time.monotonic()
    tasks = [0]
    study = sleeper_study(seconds)
    prepared = time.monotonic() - begin
    with _threaded_client(workers) as client, tempfile.TemporaryDirectory() as folder:
        counting = _CountingClient(client)

        def seen(progress: StudyProgress) -> None:
            tasks.append(len(client.cluster.scheduler.tasks))

        progress = run_study(study, Path(folder), counting, callback=seen)
        rows_bytes = _rows_bytes(Path(folder))
    wall = prepared + progress.seconds
    return StudyScale(
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


class _CountingClient:
    """A client that counts the batches that are submitted to it."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self.batches = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)

    def submit(self, *given: Any, **options: Any) -> Any:
        """Submit a batch as the client does, and count it."""
        self.batches += 1
        return self._client.submit(*given, **options)


def _threaded_client(workers: int) -> AbstractContextManager[Any]:
    """Return a client of `workers` threads of this process."""
    each = math.gcd(workers, SIMULATED_WORKER_THREADS)
    threads = {"threads_per_worker": each, "processes": False, "protocol": "tcp://", "dashboard_address": None}
    return local_client(workers // each, "0", **threads)
