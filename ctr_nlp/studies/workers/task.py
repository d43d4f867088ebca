"""Execution of a batch of cases on a worker. Everything here runs in the worker's process."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import ClusterError
from ctr_nlp.plan.plan import versions
from ctr_nlp.studies.grid.case import Case
from ctr_nlp.support.extras import import_extra

CASE_TIMEOUT_TOPIC = "ctr_nlp-late"
"""Topic under which a worker reports the digest of a case that exceeds the time limit, before it exits."""
TIMEOUT_REPORT_S = 0.5
"""Time that a worker waits for this report to be sent, s."""
MIN_TIMEOUT_POLL_S = 0.01
"""Least time between two checks of the time limit, s."""
TIMEOUT_EXIT_STATUS = 70
"""Exit status of a worker after a case has exceeded the time limit."""

BatchResult = tuple[list[dict[str, Any]], float]
"""Result of a batch: rows, and the time that they took, s."""


def run_batch(cases: list[Case], plans: Path | None, patience: float) -> BatchResult:
    """Make the rows of cases; a case that exceeds the time limit ends the process.

    Programs are compiled first, for as long as that takes: interpreted functions differ from compiled ones in
    their last bits, and so would the plans of a study that compiles and one that need not. The environment
    variable CTR_NLP_COMPILE, where it is set, is respected.

    Parameters
    ----------
    cases : list of Case
        Of one kind.
    plans : Path or None
        The folder into which plans are written, too.
    patience : float
        Time limit of a case, s, without the time for which it waits for a compiler.

    Returns
    -------
    tuple of list of dict and float
        The rows, and the time that all took, s, without waiting for a compiler.

    Raises
    ------
    ClusterError
        Versions of software here differ from those of the process that made the cases.
    OutputError
        A plan cannot be written.
    """
    # The digest of a pickled case is cached with it. A copy computes its own, with the versions of this process.
    if replace(cases[0]).digest != cases[0].digest:
        own = ", ".join(f"{name} {version}" for name, version in versions().items())
        raise ClusterError(f"a worker has other versions than the program that asks for the study: it has {own}")
    os.environ.setdefault(cache.COMPILE_VARIABLE, "now")
    begin = _worked_s()
    rows = list[dict[str, Any]]()
    worker = import_extra("distributed").get_worker()

    # A case may hang in C code, which no exception interrupts: the process ends. The event is sent by another
    # thread, hence the wait. len(rows) is the number of the case at work.
    def ended() -> None:
        worker.log_event(CASE_TIMEOUT_TOPIC, cases[len(rows)].digest)
        time.sleep(TIMEOUT_REPORT_S)
        os._exit(TIMEOUT_EXIT_STATUS)

    for case in cases:
        with _limit_time(patience, ended):
            rows.append(case.row(plans))
    return rows, _worked_s() - begin


def _worked_s() -> float:
    """Return a monotonic time, s, that stands still while this process waits for a compiler."""
    return time.monotonic() - cache.library_wait_s()


@contextmanager
def _limit_time(seconds: float, on_timeout: Callable[[], None]) -> Iterator[None]:
    """Call on_timeout where the block takes longer than `seconds`, without waiting for a compiler."""
    end = _worked_s() + seconds
    left = threading.Event()

    def watch() -> None:
        while not left.wait(max(end - _worked_s(), MIN_TIMEOUT_POLL_S)):
            if _worked_s() >= end:
                on_timeout()
                return

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        left.set()
