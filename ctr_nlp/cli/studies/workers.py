"""Options of commands that make many plans, and the Dask client that they ask for."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ctr_nlp.cli.arguments import whole
from ctr_nlp.studies.workers.clients import cluster_client, local_client
from ctr_nlp.studies.workers.running import DEFAULT_CASE_TIMEOUT_S


def add_worker_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for where plans are made, and for how long each may take, to `parser`."""
    told = "scheduler of a Dask cluster to work on, as tcp://HOST:PORT or tls://HOST:PORT (default: processes of "
    told += "this machine)"
    parser.add_argument("--address", metavar="URL", help=told)
    cores = os.cpu_count() or 1
    parser.add_argument("--workers", metavar="N", type=whole, help=f"processes of this machine (default {cores})")
    told = "seconds that a plan may take before it is given up; begun again with more, it is tried again "
    told += f"(default {DEFAULT_CASE_TIMEOUT_S:g})"
    parser.add_argument("--patience", metavar="S", type=float, default=DEFAULT_CASE_TIMEOUT_S, help=told)


@contextmanager
def open_client(arguments: argparse.Namespace) -> Iterator[Any]:
    """Yield a Dask client of the cluster that was asked for, or of processes on this machine."""
    if arguments.address is None:
        with local_client(arguments.workers or os.cpu_count() or 1) as client:
            yield client
        return
    with cluster_client(arguments.address) as client:
        yield client
