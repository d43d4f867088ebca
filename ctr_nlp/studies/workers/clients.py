"""Clients of Dask clusters: of local processes, and of a scheduler that is already running."""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ctr_nlp.exceptions import ClusterError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.support.same_origin import is_same_origin_request

LOOPBACK = "127.0.0.1"
SCHEDULER_CONNECT_TIMEOUT_S = 10.0
"""Time limit for the connection to a scheduler, s."""
MEBIBYTE = 2**20
DASK_SETTINGS = {
    # a case whose worker died is repeated by us (Batches), and not by Dask
    "distributed.scheduler.allowed-failures": 0,
    # what Dask does all the time in every process took 2.6 % of two cores, with its own settings
    "distributed.admin.tick.limit": "60s",
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "2s",
    "distributed.worker.memory.monitor-interval": "500ms",
    "distributed.scheduler.work-stealing": False,
    # its statistical profile, a tree a second for three hours, grew by 40 KB a plan
    "distributed.worker.profile.enabled": False,
    "distributed.admin.low-level-log-length": 100,
    # after this time Dask gives up a worker that died, if it is not back at that moment, as where it died again
    "distributed.deploy.lost-worker-timeout": "1000 days",
    "distributed.nanny.pre-spawn-environ.OMP_NUM_THREADS": "1",
    "distributed.nanny.pre-spawn-environ.OPENBLAS_NUM_THREADS": "1",
    # Dask makes glibc return memory whenever 64 KiB at the end of the heap are free: a plan frees and takes the
    # same pages again and again, which cost 30,000 page faults and a fifth of a plan's processor time
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": str(256 * MEBIBYTE),
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": str(32 * MEBIBYTE),
    # tasks run in a thread, whose arena glibc gives back heap by heap, whatever the two thresholds say: robust
    # plans faulted 120,000 to 880,000 pages from run to run
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": "1",
}
"""Dask's settings for local clusters."""


@contextmanager
def local_client(workers: int, memory: str = "auto", **more: Any) -> Iterator[Any]:
    """Yield a client of a local cluster of `workers` single-threaded processes, which listen on loopback only.

    memory: limit of each process, as Dask writes it; more: options of distributed.LocalCluster.
    """
    distributed = import_extra("distributed")
    dask = import_extra("dask")
    asked = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": f"{LOOPBACK}:0"} | more
    with (
        dask.config.set(DASK_SETTINGS),
        distributed.LocalCluster(host=LOOPBACK, memory_limit=memory, silence_logs="CRITICAL", **asked) as begun,
        distributed.Client(begun) as client,
    ):
        _refuse_foreign_requests(begun.scheduler.http_application)
        yield client


def _refuse_foreign_requests(application: Any) -> None:
    """Make a tornado application refuse requests from other pages than its own."""
    # Any web page can make a browser send requests to loopback: listening there alone is no protection.
    routing = import_extra("tornado.routing")
    web = import_extra("tornado.web")

    class Foreign(routing.Matcher):  # type: ignore[name-defined]
        def match(self, request: Any) -> dict[str, Any] | None:
            """Match requests that are refused; None for others."""
            hosts, origins = (request.headers.get_list(name) for name in ("Host", "Origin"))
            reached = request.connection.stream.socket.getsockname()[:2]
            return None if is_same_origin_request(hosts, origins, LOOPBACK, reached) else {}

    class Refused(web.RequestHandler):  # type: ignore[name-defined]
        def prepare(self) -> None:
            """Refuse every request."""
            raise web.HTTPError(403)

    application.default_router.rules.insert(0, routing.Rule(Foreign(), Refused))


@contextmanager
def cluster_client(address: str) -> Iterator[Any]:
    """Yield a client of the scheduler at the URL `address`, with TLS as Dask's own configuration says.

    Dask's log messages are silenced, since errors report the same. Raises ClusterError where no scheduler answers.
    """
    distributed = import_extra("distributed")
    for handler in logging.getLogger("distributed").handlers:
        handler.setLevel(logging.CRITICAL)
    try:
        asyncio.run(_probe_scheduler(address))  # a client that fails itself is left half open
    except Exception as error:  # of many kinds: bad URLs, missing certificates, nobody there
        cause = re.sub("in <.*?>: ", "", str(error.__cause__ or "") or str(error))
        raise ClusterError(f"no cluster can be reached at {address}: {cause}"[:500]) from error
    with distributed.Client(address, timeout=SCHEDULER_CONNECT_TIMEOUT_S) as client:
        yield client


async def _probe_scheduler(address: str) -> None:
    """Connect to the scheduler at the URL `address` and close again; raises Dask's errors where none answers."""
    secrets = import_extra("distributed").Security().get_connection_args("client")
    comm = await import_extra("distributed.comm").connect(address, timeout=SCHEDULER_CONNECT_TIMEOUT_S, **secrets)
    await comm.close()


def scheduler_loss_errors() -> tuple[type[Exception], ...]:
    """Return the exceptions that Dask raises where its scheduler was lost."""
    distributed = import_extra("distributed")
    return OSError, distributed.TimeoutError, distributed.CancelledError


@contextmanager
def report_scheduler_loss() -> Iterator[None]:
    """Raise ClusterError where the scheduler is lost within the block."""
    try:
        yield
    except scheduler_loss_errors() as error:
        raise ClusterError(
            "the cluster's scheduler was lost; rows that were made are kept, and the same study begun again into "
            f"the same folder goes on where it was ({type(error).__name__})"
        ) from error
