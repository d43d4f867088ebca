"""Dask clusters of other processes, as somebody else would have started them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
LOOPBACK = "127.0.0.1"
WAIT = 60.0
"""s that a process may take to begin, on a busy machine."""


class Cluster(NamedTuple):
    """The URL of a scheduler, and its process."""

    address: str
    scheduler: subprocess.Popen[bytes]


def environment(more: Mapping[str, str] | None = None) -> dict[str, str]:
    """Of a process that imports this checkout's ctr_nlp."""
    return os.environ | {"PYTHONPATH": str(ROOT)} | dict(more or {})


@contextmanager
def cluster(folder: Path, workers: int, env: Mapping[str, str] | None = None, *options: str) -> Iterator[Cluster]:
    """A scheduler and workers on loopback, which log into a folder; options: of both programs."""
    folder.mkdir(parents=True)
    told = folder / "scheduler.json"
    where = ["--scheduler-file", str(told), "--host", LOOPBACK, *options]
    with ExitStack() as stack, open(folder / "log", "wb") as log:

        def begun(program: str, *more: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", f"distributed.cli.{program}", *where, *more]
            process = subprocess.Popen(command, env=environment(env), stdout=log, stderr=log, cwd=folder)
            stack.callback(_ended, process)
            return process

        scheduler = begun("dask_scheduler", "--port", "0", "--dashboard-address", f"{LOOPBACK}:0")
        until(told.exists)
        for _ in range(workers):
            begun("dask_worker", "--nthreads", "1", "--no-dashboard")
        yield Cluster(json.loads(told.read_text())["address"], scheduler)


def until(true: Callable[[], bool], wait: float = WAIT) -> None:
    """Wait until something is true."""
    end = time.monotonic() + wait
    while not true():
        assert time.monotonic() < end, f"not so after {wait} s"
        time.sleep(0.05)


def _ended(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
