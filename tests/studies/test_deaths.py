"""Studies of which everything dies that can: workers, scheduler, client, disk. No plan is lost or made twice."""

from __future__ import annotations

import errno
import hashlib
import math
import os
import random
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest
from clusters import cluster, environment, until

from ctr_nlp.exceptions import OutputError
from ctr_nlp.studies.grid.case import CASE_DONE, CASE_FAILED, CASE_LATE, CASE_LOST, row_without_plan
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers.batches import MAX_WORKER_DEATHS, Batches
from ctr_nlp.studies.workers.clients import local_client
from ctr_nlp.studies.workers.running import run_study

pytest.importorskip("distributed", reason="the extra `study` is not installed")
parquet = pytest.importorskip("pyarrow.parquet", reason="the extra `study` is not installed")

SECONDS = 1.0
"""Of a random moment at which a worker is killed, at most, after enough plans are done."""


def written(path, plans):
    path.write_text(
        f'frames = 4\nmodels = "dominant"\n[problems]\nnames = ["arc"]\n[settings]\nseed = {list(range(plans))}\n'
    )
    return path


def digest(folder):
    """Of the sorted table, without what is measured in seconds."""
    frame = Results(folder).frame()
    times = [name for name in frame if name.endswith("_s") or name.startswith("solve_ms")]
    assert {"process_s", "search_s", "solve_ms_total"} <= set(times)
    table = frame.drop(columns=times)
    return hashlib.sha256(table[sorted(table)].to_csv(index=False).encode()).hexdigest()


@contextmanager
def begun(path, out, *more):
    """The command at work on a study, with what it says."""
    command = [sys.executable, "-m", "ctr_nlp", "study", str(path), "--out", str(out), *more]
    process = subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


class Killer:
    """Kills workers of a local cluster at random moments, each after some plans are done."""

    def __init__(self, client, kills, plans, seed):
        self.cluster, self.random, self.killed = client.cluster, random.Random(seed), 0
        self.after = sorted(self.random.randrange(plans) for _ in range(kills))
        self.timers, self.found = [], None

    def __call__(self, progress):
        while self.after and self.after[0] <= progress.done - progress.done_before:
            self.after.pop(0)
            self.timers.append(threading.Timer(self.random.uniform(0.0, SECONDS), self._kill))
            self.timers[-1].start()

    def _kill(self):
        until(self.at_work)
        os.kill(self.found, signal.SIGKILL)
        self.killed += 1

    def at_work(self):
        """Whether a worker is known to the scheduler; the process of one of them is found."""
        known = self.cluster.scheduler.workers
        pids = [one.pid for one in self.cluster.workers.values() if one.worker_address in known]
        self.found = self.random.choice([pid for pid in pids if pid] or [None])
        return self.found is not None


def full_once(monkeypatch):
    """The disk is full when a file is half written, once; list of the files at which it was."""
    write, full = parquet.write_table, []

    def write_table(table, path):
        if full:
            return write(table, path)
        full.append(path)
        Path(path).write_bytes(b"PAR1")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(parquet, "write_table", write_table)
    return full


def test_a_case_is_given_up_when_it_has_cost_its_last_worker_alone(tmp_path):
    first, second, *_ = Study.from_toml(written(tmp_path / "s.toml", 4)).cases
    batches = Batches.of([])
    assert batches.record_death([first, second], ()) == []
    for _ in range(MAX_WORKER_DEATHS - 1):
        assert batches.next() == [first]
        assert batches.has_suspects([[first]])
        assert batches.record_death([first], ()) == []
        assert batches.next() == [second]
        batches.isolated_cases.append(second)
    assert batches.record_death(batches.next(), ()) == [first]
    assert batches.next() == [second]
    assert not batches
    assert not batches.has_suspects([[first, second]])


def test_a_case_that_is_late_is_given_up_at_once(tmp_path):
    first, second, third, _ = Study.from_toml(written(tmp_path / "s.toml", 4)).cases
    batches = Batches.of([])
    assert batches.record_death([first, second, third], {second.digest}) == [second]
    assert [batches.next(), batches.next()] == [[first], [third]]
    assert not batches


def test_cases_of_lost_workers_and_of_less_patience_are_tried_again(tmp_path):
    first, second, third, fourth = Study.from_toml(written(tmp_path / "s.toml", 4)).cases
    results = Results(tmp_path)
    late = row_without_plan(second, CASE_LATE, "it took longer than 5 s", math.nan) | {"patience_s": 5.0}
    results.add_retryable_rows([row_without_plan(first, CASE_LOST, "its worker died", math.nan), late])
    results.add(
        [
            row_without_plan(third, CASE_FAILED, "why", 0.5),
            fourth.columns | {"status": CASE_DONE, "process_s": 1.0},
        ]
    )
    assert len(results.read_digests()) == 4
    results.delete_retryable_rows(5.0)
    assert results.read_digests() == {second.digest, third.digest, fourth.digest}
    results.delete_retryable_rows(6.0)
    assert results.read_digests() == {third.digest, fourth.digest}


@pytest.mark.parametrize(("plans", "kills"), [(24, 2), pytest.param(1500, 20, marks=pytest.mark.slow)])
def test_whatever_dies_no_plan_is_lost_or_made_twice(tmp_path, monkeypatch, plans, kills):
    path = written(tmp_path / "s.toml", plans)
    study, out, calm = Study.from_toml(path), tmp_path / "out", tmp_path / "calm"
    results, told = Results(out), []

    with begun(path, out, "--workers", "2") as command:
        until(lambda: len(results.read_digests()) >= plans / 20)
        os.kill(command.pid, signal.SIGKILL)
    told.append(len(results.read_digests()))

    with (
        cluster(tmp_path / "cluster", 2) as (address, scheduler),
        begun(path, out, "--address", address) as command,
    ):
        until(lambda: len(results.read_digests()) > told[0] + plans / 20)
        scheduler.send_signal(signal.SIGKILL)
        assert command.wait(60) == 2
        said = command.stderr.read()
    last = said.strip().splitlines()[-1]
    assert last.startswith("error: the cluster's scheduler was lost; rows that were made are kept"), said
    assert "Traceback" not in said
    told.append(len(results.read_digests()))

    with local_client(2) as client:
        full = full_once(monkeypatch)
        with pytest.raises(OutputError, match="No space left"):
            run_study(study, out, client)
        assert len(full) == 1
        assert not Path(full[0]).exists()
        killer = Killer(client, kills, (plans - told[-1]) // 2, seed=plans)
        progress = run_study(study, out, client, callback=killer)
        for timer in killer.timers:
            timer.join()
        assert killer.killed == kills
        assert (progress.done, progress.failed) == (plans, 0)
        until(killer.at_work)
        run_study(study, calm, client)

    frame = results.frame()
    assert frame["digest"].tolist() == sorted(case.digest for case in study.cases)
    assert (frame["status"] == CASE_DONE).all()
    assert digest(out) == digest(calm)
