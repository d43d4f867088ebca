"""Cost of a study in all its processes, compared with a plain pool of processes that makes the same plans.

A study's rows have the process time of their plans, in which overhead within the plans looks like longer plans. So
each side runs in a process of its own, and its processor time, children included, is what the system counts when
it has ended.
"""

from __future__ import annotations

import resource
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.exceptions import BenchmarkError
from ctr_nlp.studies.grid.case import Case
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers.clients import local_client
from ctr_nlp.studies.workers.running import StudyProgress, run_study
from ctr_nlp.support.pool import run_in_parallel

SPAWN = get_context("spawn")


@dataclass(frozen=True)
class Turn:
    """Processor time and memory that one side of the comparison took in one turn.

    Attributes
    ----------
    user_s, system_s : float
        Processor time of all its processes, s.
    page_faults : int
        Minor page faults of all its processes.
    memory_bytes : tuple of int
        Memory of the largest worker after each batch, as reported to the scheduler; empty for a pool.
    """

    user_s: float
    system_s: float
    page_faults: int
    memory_bytes: tuple[int, ...]

    @property
    def processor_s(self) -> float:
        """User and system time, s."""
        return self.user_s + self.system_s


@dataclass(frozen=True)
class PoolComparison:
    """Turns of a study and of a pool, pair by pair."""

    study: tuple[Turn, ...]
    pool: tuple[Turn, ...]

    @property
    def ratio(self) -> float:
        """Median over pairs of the study's processor time over the pool's."""
        pairs = zip(self.study, self.pool, strict=True)
        return float(np.median([study.processor_s / pool.processor_s for study, pool in pairs]))


def compare_with_pool(study: Study, workers: int, pairs: int = 1) -> PoolComparison:
    """Make the plans of a study on Dask and in a pool of processes, in turns.

    Parameters
    ----------
    study : Study
        The cases; their programs should be compiled already.
    workers : int
        Number of processes on either side.
    pairs : int
        Number of turns of each side; the order changes from pair to pair.

    Returns
    -------
    PoolComparison
        Processor times, page faults and memory.

    Raises
    ------
    BenchmarkError
        A side has ended early.
    """
    turns: dict[Side, list[Turn]] = {_in_study: [], _in_pool: []}
    for number in range(pairs):
        for side in (_in_study, _in_pool) if number % 2 else (_in_pool, _in_study):
            turns[side].append(_turn(side, study, workers))
    return PoolComparison(tuple(turns[_in_study]), tuple(turns[_in_pool]))


Side = Callable[[Connection, Study, int], None]
"""Function that makes the plans of a study with so many workers, and sends these workers' memory, bytes."""


def _turn(side: Side, study: Study, workers: int) -> Turn:
    """Run a side in a process of its own, and return its processor time and memory."""
    here, there = SPAWN.Pipe()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = SPAWN.Process(target=side, args=(there, study, workers))
    process.start()
    # Only the child holds this end now: recv raises EOFError where the child dies, instead of waiting forever.
    there.close()
    try:
        memory = here.recv()
    except EOFError as error:
        raise BenchmarkError("a side of the comparison has ended early") from error
    finally:
        # The system counts a child's times, and those of its children, when it has been waited for.
        process.join()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return Turn(
        user_s=after.ru_utime - before.ru_utime,
        system_s=after.ru_stime - before.ru_stime,
        page_faults=after.ru_minflt - before.ru_minflt,
        memory_bytes=tuple(memory),
    )


def _in_study(answer: Connection, study: Study, workers: int) -> None:
    memory = list[int]()
    with tempfile.TemporaryDirectory() as folder, local_client(workers) as client:

        def seen(progress: StudyProgress) -> None:
            known = client.cluster.scheduler.workers.values()
            memory.append(max((worker.metrics["memory"] for worker in known), default=0))

        run_study(study, Path(folder), client, callback=seen)
    answer.send(memory)


def _in_pool(answer: Connection, study: Study, workers: int) -> None:
    for _ in run_in_parallel(_row, study.cases, workers):
        pass
    answer.send([])


def _row(case: Case) -> dict[str, Any]:
    return case.row()


def rows_of(compared: PoolComparison) -> list[Sequence[str]]:
    """Write a comparison as rows of a table.

    Parameters
    ----------
    compared : PoolComparison
        The comparison.

    Returns
    -------
    list of sequence of str
        Side, user and system time in s, page faults, and memory of the largest worker in MB at the first batch
        and at the last; a row a turn.
    """
    found = list[Sequence[str]]()
    for name, turns in (("study", compared.study), ("pool", compared.pool)):
        for turn in turns:
            memory = [f"{size / 1e6:.0f}" for size in (turn.memory_bytes[1:2] + turn.memory_bytes[-1:])]
            found.append(
                [name, f"{turn.user_s:.2f}", f"{turn.system_s:.2f}", f"{turn.page_faults}", " to ".join(memory)]
            )
    return found
