"""Work on parts of a batch in several threads, for compiled code, which other threads need not wait for."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.value_checks import whole_number

Found = TypeVar("Found")

THREAD_COUNT_VARIABLE = "OMP_NUM_THREADS"
"""Environment variable that limits threads where no number is given, as for linear algebra; processes that share a
machine's cores set it to 1 (pool.py).
"""


def count_threads(threads: int | None) -> int:
    """Return `threads`, or by default the number in the environment, or that of the cores of this process.

    Raises OptionError where it is less than 1.
    """
    if threads is not None:
        return whole_number(OptionError, "threads", threads)
    limit = os.environ.get(THREAD_COUNT_VARIABLE, "")
    if limit.isdigit() and int(limit) > 0:
        return int(limit)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def split_rows(rows: int, size: int) -> list[slice]:
    """Return slices of at most `size` rows that together are all rows."""
    return [slice(first, min(first + size, rows)) for first in range(0, rows, size)]


def map_in_threads(work: Callable[[slice], Found], parts: list[slice], threads: int) -> list[Found]:
    """Return the result of `work` for each of the parts, in their order; one after the other with one thread."""
    if threads == 1 or len(parts) < 2:
        return [work(part) for part in parts]
    with ThreadPoolExecutor(min(threads, len(parts))) as pool:
        return list(pool.map(work, parts))
