"""Parallel work on many items, in several processes or on a Dask cluster, until Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager, suppress
from multiprocessing import active_children, get_context, parent_process
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
    """Yield the result of `work` for each of `items`, with the item's number, in the order in which they are done.

    jobs: number of processes, 1 for this one; or a distributed.Client, on whose cluster the work is done. `work`
    and `items` must be picklable where another process works. After Ctrl-C no further item is begun, and work that
    is running finds deferred_interrupt set. Raises OptionError, and whatever `work` raises.
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
    """Do the work in `jobs` processes of this machine; after Ctrl-C running work may end early."""
    # Not fork: a copy of a process in which threads of BLAS hold locks may wait for them for ever.
    context = get_context("spawn")
    pressed = context.Event()
    with (
        _one_thread_each(),
        ProcessPoolExecutor(jobs, context, _begin_worker, (pressed,)) as pool,
        _workers_end_at_termination(),
    ):
        tasks: dict[Future[Found], int] = {pool.submit(work, thing): number for number, thing in enumerate(items)}
        waiting = set(tasks)
        try:
            while waiting:
                finished, waiting = wait(waiting, timeout=POOL_POLL_S, return_when=FIRST_COMPLETED)
                for task in finished:
                    yield tasks[task], task.result()
                if interrupted():
                    # Running tasks cannot be cancelled: they see the event (share_interrupt), end early, and are
                    # still yielded.
                    pressed.set()
                    waiting = {task for task in waiting if not task.cancel()}
        finally:
            pool.shutdown(cancel_futures=True)


def _begin_worker(pressed: Any) -> None:
    """Prepare a worker process: Ctrl-C sets `pressed`, a shared event, and it ends with the process it works
    for.
    """
    share_interrupt(pressed)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait for the end of the process that this worker works for, which may be killed, and end this one."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    # Nobody is left who would take a result.
    os._exit(1)


@contextmanager
def _workers_end_at_termination() -> Iterator[None]:
    """Let SIGTERM within the block end the workers first, and then this process in good order.

    By default it would end this process alone and at once: workers would go on with their tasks, and Python would
    warn of their semaphores. A handler that somebody has installed stays.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return

    def end(number: int, frame: Any) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a second one ends the process at once
        for worker in active_children():
            worker.terminate()
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _run_on_cluster(
    work: Callable[[Thing], Found], items: Sequence[Thing], client: Any, interrupted: Callable[[], bool]
) -> Iterator[tuple[int, Found]]:
    """Do the work on the cluster of a client; after Ctrl-C running work is cancelled."""
    distributed = import_extra("distributed")
    # pure=False: Dask would otherwise return the earlier result of a call with equal arguments.
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
    """Limit the linear algebra of processes that are started within the block to one thread.

    With more threads than cores they wait for each other, and small problems take up to ten times as long. Limits
    that the user has set stay.
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
        """Do nothing, instead of Popen's warning that the process still runs."""
