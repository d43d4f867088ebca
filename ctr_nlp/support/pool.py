"""Work on many things in several processes, or on a Dask cluster, until Ctrl-C."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from typing import Any, TypeVar

from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.support.interrupt import deferred_interrupt, share_interrupt

Thing = TypeVar("Thing")
Found = TypeVar("Found")
Jobs = int | Any
"""Number of processes of this machine, or a distributed.Client of the cluster, that do the work."""

POOL_POLL_S = 0.2
"""Seconds between two looks at whether Ctrl-C was pressed."""
BLAS_THREAD_VARIABLES = "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"
"""Environment variables that limit the threads of linear algebra."""


def run_in_parallel(
    work: Callable[[Thing], Found], items: Sequence[Thing], jobs: Jobs
) -> Iterator[tuple[int, Found]]:
    """Yield the result of `work` for each of `items`, with its number in their order, as they are done.

    jobs: in how many processes, with 1 in this one; or a distributed.Client, on whose cluster it is done. work and
    things must be fit for pickling where it is done elsewhere. After Ctrl-C nothing new is begun, and what is at
    work is told (deferred_interrupt). Raises OptionError, and what work raises.
    """
    with deferred_interrupt() as interrupted:
        if not isinstance(jobs, int):
            yield from _run_on_cluster(work, items, jobs, interrupted)
            return
        if jobs < 1:
            raise OptionError(f"jobs is {jobs}; it must be at least 1")
        if jobs > 1:
            yield from _run_in_processes(work, items, jobs, interrupted)
            return
        for number, thing in enumerate(items):
            if interrupted():
                return
            yield number, work(thing)


def _run_in_processes(
    work: Callable[[Thing], Found], items: Sequence[Thing], jobs: int, interrupted: Callable[[], bool]
) -> Iterator[tuple[int, Found]]:
    """Do the work in `jobs` processes of this machine; after Ctrl-C what is at work may end early."""
    context = get_context("spawn")
    pressed = context.Event()
    with _one_thread_each(), ProcessPoolExecutor(jobs, context, share_interrupt, (pressed,)) as pool:
        tasks: dict[Future[Found], int] = {pool.submit(work, thing): number for number, thing in enumerate(items)}
        waiting = set(tasks)
        try:
            while waiting:
                finished, waiting = wait(waiting, timeout=POOL_POLL_S, return_when=FIRST_COMPLETED)
                for task in finished:
                    yield tasks[task], task.result()
                if interrupted():
                    pressed.set()
                    waiting = {task for task in waiting if not task.cancel()}
        finally:
            pool.shutdown(cancel_futures=True)


def _run_on_cluster(
    work: Callable[[Thing], Found], items: Sequence[Thing], client: Any, interrupted: Callable[[], bool]
) -> Iterator[tuple[int, Found]]:
    """Do the work on the cluster of a client; after Ctrl-C what is at work is cancelled."""
    distributed = import_extra("distributed")
    tasks = {client.submit(work, thing, pure=False): number for number, thing in enumerate(items)}
    waiting = set(tasks)
    try:
        while waiting and not interrupted():
            with suppress(TimeoutError, distributed.TimeoutError):
                finished, waiting = distributed.wait(waiting, timeout=POOL_POLL_S, return_when="FIRST_COMPLETED")
                for task in finished:
                    yield tasks[task], task.result()
    finally:
        client.cancel(list(waiting))


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that are started within the block keep to one thread: more of them wait for each other.

    Small problems then take up to ten times as long. What the user has set counts.
    """
    added = [name for name in BLAS_THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


class DetachedProcess(subprocess.Popen[Any]):
    """A process that nobody needs to wait for; Python warns of others that are left alone."""

    def __del__(self) -> None:
        """Nothing is to be done."""
