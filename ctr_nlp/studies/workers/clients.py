"""Clients of Dask clusters: of processes of this machine, and of a scheduler that somebody else has begun."""

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
"""s that a scheduler may take to answer when a client asks it first."""
MEBIBYTE = 2**20
DASK_SETTINGS = {
    # a case whose worker died is tried again by us, and not by Dask
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
    # so long after a worker died Dask gives it up for good, if it is not there at that moment: it died again
    "distributed.deploy.lost-worker-timeout": "1000 days",
    "distributed.nanny.pre-spawn-environ.OMP_NUM_THREADS": "1",
    "distributed.nanny.pre-spawn-environ.OPENBLAS_NUM_THREADS": "1",
    # Dask has glibc give memory back whenever 64 KiB at the end of the heap are free: a plan frees and takes the
    # same pages again and again, which cost 30,000 page faults and a fifth of a plan's processor time
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": str(256 * MEBIBYTE),
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": str(32 * MEBIBYTE),
}
"""Dask's settings for clusters that are begun here."""


@contextmanager
def local_client(workers: int, memory: str = "auto", **more: Any) -> Iterator[Any]:
    """Yield a client of `workers` processes of this machine, which listen on loopback only, with one thread each.

    memory: that each may take before it is ended; more: options of distributed.LocalCluster.
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
    """Have a tornado application answer only requests of its own pages, which a browser sends to loopback."""
    routing = import_extra("tornado.routing")
    web = import_extra("tornado.web")

    class Foreign(routing.Matcher):  # type: ignore[name-defined]
        def match(self, request: Any) -> dict[str, Any] | None:
            """Match what is to be refused."""
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
    """Yield a client of the scheduler at a URL; TLS as Dask's own configuration says.

    What Dask logs meanwhile is silenced: errors tell it. Raises ClusterError where no scheduler answers so.
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
    """Connect to a scheduler and close again; raises what Dask raises where nobody answers at a URL."""
    secrets = import_extra("distributed").Security().get_connection_args("client")
    comm = await import_extra("distributed.comm").connect(address, timeout=SCHEDULER_CONNECT_TIMEOUT_S, **secrets)
    await comm.close()


def scheduler_loss_errors() -> tuple[type[Exception], ...]:
    """Return the exceptions that Dask raises where its scheduler is there no more."""
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
