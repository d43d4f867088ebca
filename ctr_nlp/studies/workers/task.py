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

from ctr_nlp.exceptions import ClusterError
from ctr_nlp.plan.plan import versions
from ctr_nlp.studies.grid.case import Case
from ctr_nlp.support.extras import needed

TOO_LONG = "ctr_nlp-late"
"""The topic under which a worker tells the digest of the case that takes too long, before it ends itself."""
TELLING = 0.5
"""s that a worker takes to tell it."""
EXIT = 70
"""With which it ends itself."""

Worked = tuple[list[dict[str, Any]], float]
"""What a batch returns: rows, and the seconds that they took."""


def work(cases: list[Case], plans: Path | None, patience: float) -> Worked:
    """The rows of cases, and the seconds that all took; a case that takes longer than patience ends the process.

    Raises ClusterError where this process has other versions than the one that made the cases, and OutputError
    where a plan cannot be written.
    """
    if replace(cases[0]).digest != cases[0].digest:
        own = ", ".join(f"{name} {version}" for name, version in versions().items())
        raise ClusterError(f"a worker has other versions than the program that asks for the study: it has {own}")
    begin, rows, worker = time.monotonic(), list[dict[str, Any]](), needed("distributed").get_worker()

    def ended() -> None:
        worker.log_event(TOO_LONG, cases[len(rows)].digest)
        time.sleep(TELLING)
        os._exit(EXIT)

    for case in cases:
        with _limited(patience, ended):
            rows.append(case.row(plans))
    return rows, time.monotonic() - begin


@contextmanager
def _limited(seconds: float, ended: Callable[[], None]) -> Iterator[None]:
    """A call is made where the block takes longer."""
    timer = threading.Timer(seconds, ended)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
