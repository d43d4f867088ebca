"""What a worker does with a batch of cases. Everything here runs in the worker's process."""

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
"""The topic under which a worker tells the digest of the case that takes too long, before it ends itself."""
TIMEOUT_REPORT_S = 0.5
"""s that a worker takes to tell it."""
MIN_TIMEOUT_POLL_S = 0.01
"""s between two looks at whether a case takes too long, at least."""
TIMEOUT_EXIT_STATUS = 70
"""Exit status with which a worker ends itself."""

BatchResult = tuple[list[dict[str, Any]], float]
"""Result of a batch: rows, and the seconds that they took."""


def run_batch(cases: list[Case], plans: Path | None, patience: float) -> BatchResult:
    """Make the rows of cases. A case that takes longer than patience ends the process.

    What the cases are solved with is compiled first, for as long as that takes: interpreted functions differ from
    compiled ones in their last bits, and so would the plans of a study that compiles and one that need not. What
    the user has said in CTR_NLP_COMPILE counts.

    Parameters
    ----------
    cases : list of Case
        Of one kind.
    plans : Path or None
        The folder into which plans are written, too.
    patience : float
        Seconds that a case may take, without those for which it waits for a compiler.

    Returns
    -------
    tuple of list of dict and float
        The rows, and the seconds that all took, waiting not included.

    Raises
    ------
    ClusterError
        This process has other versions than the one that made the cases.
    OutputError
        A plan cannot be written.
    """
    if replace(cases[0]).digest != cases[0].digest:
        own = ", ".join(f"{name} {version}" for name, version in versions().items())
        raise ClusterError(f"a worker has other versions than the program that asks for the study: it has {own}")
    os.environ.setdefault(cache.COMPILE_VARIABLE, "now")
    begin = _worked_s()
    rows = list[dict[str, Any]]()
    worker = import_extra("distributed").get_worker()

    def ended() -> None:
        worker.log_event(CASE_TIMEOUT_TOPIC, cases[len(rows)].digest)
        time.sleep(TIMEOUT_REPORT_S)
        os._exit(TIMEOUT_EXIT_STATUS)

    for case in cases:
        with _limit_time(patience, ended):
            rows.append(case.row(plans))
    return rows, _worked_s() - begin


def _worked_s() -> float:
    """A clock, s, that stands still while this process waits for a compiler."""
    return time.monotonic() - cache.library_wait_s()


@contextmanager
def _limit_time(seconds: float, on_timeout: Callable[[], None]) -> Iterator[None]:
    """A call is made where the block takes longer, without the time for which it waits for a compiler."""
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
