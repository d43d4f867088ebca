"""The example for SLURM, as far as it can be checked without one: its job script, and a run of stand-ins."""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys

import pytest
from clusters import LOOPBACK, ROOT, environment, until

from ctr_nlp.studies.grid.case import CASE_DONE
from ctr_nlp.studies.grid.results import Results

pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed")
psutil = pytest.importorskip("psutil", reason="the extra `study` is not installed")
pytest.importorskip("cryptography", reason="cryptography, which makes certificates, is not installed")


EXAMPLE = ROOT / "examples" / "slurm_study.py"
SBATCH = """#!/bin/sh
cp "$1" "$JOBS/script"
setsid sh "$JOBS/script" > "$JOBS/log" 2>&1 &
echo $! >> "$JOBS/ids"
echo "Submitted batch job $!"
"""
SCANCEL = """#!/bin/sh
for job; do kill -- -$job; done
"""


def test_jobs_of_the_slurm_example_ask_for_what_it_says(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    example = runpy.run_path(str(EXAMPLE))
    with example["slurm_cluster"]() as cluster:
        script, address, open_at = cluster.job_script(), cluster.scheduler.address, listening()
        kept = [path for path in tmp_path.iterdir() if "worker" in path.name]
        assert len(kept) == 3
        assert all(path.stat().st_mode & 0o077 == 0 and path.name in script for path in kept)
        assert not cluster.scheduler.workers
    lines = script.splitlines()
    for asked in ("-p normal", "-n 1", "--cpus-per-task=1", "--mem=2G", "-t 04:00:00"):
        assert f"#SBATCH {asked}" in lines
    assert {"export OMP_NUM_THREADS=1", "export OPENBLAS_NUM_THREADS=1"} <= set(lines)
    (worker,) = (line for line in lines if "dask_worker" in line or "dask worker" in line)
    words = worker.split()
    assert "--nworkers" not in words
    for option, value in (("--nthreads", "1"), ("--memory-limit", "2.00GiB")):
        assert words[words.index(option) + 1] == value
    assert lines.index("export OMP_NUM_THREADS=1") < lines.index(worker)
    assert address.startswith("tls://")
    assert address in words
    assert not {"--host", "--listen-address"} & set(words)
    encrypted = int(address.rpartition(":")[2])
    assert encrypted in {each.port for each in open_at}
    assert {each.ip for each in open_at if each.port != encrypted} == {LOOPBACK}
    if any(not at.startswith("127.") for at in addresses()):
        assert {each.ip for each in open_at if each.port == encrypted} != {LOOPBACK}


@pytest.mark.slow
def test_a_job_that_dies_is_submitted_again_and_the_study_ends(tmp_path):
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    study, out, ids = tmp_path / "s.toml", tmp_path / "out", tmp_path / "ids"
    study.write_text(
        f'frames = 4\nmodels = "dominant"\n[problems]\nnames = ["arc"]\n[settings]\nseed = {list(range(60))}\n'
    )
    own = {"HOME": str(tmp_path), "JOBS": str(tmp_path), "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    own |= {
        "DASK_DISTRIBUTED__DEPLOY__LOST_WORKER_TIMEOUT": "1s",
        "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]),
    }
    command = [sys.executable, str(EXAMPLE), str(study), str(out), "1"]
    with subprocess.Popen(command, env=environment(own), stdout=subprocess.PIPE, text=True) as process:
        try:
            until(Results(out).read_digests)
            os.killpg(int(ids.read_text()), signal.SIGKILL)
            said, _ = process.communicate(timeout=90)
        finally:
            process.kill()
    assert process.returncode == 0
    assert "60 of 60" in said
    frame = Results(out).frame()
    assert len(frame) == len(frame["digest"].unique()) == 60
    assert (frame["status"] == CASE_DONE).all()
    jobs = [int(job) for job in ids.read_text().split()]
    assert len(jobs) == 2
    until(lambda: not any(psutil.pid_exists(job) for job in jobs))


def listening():
    """Addresses at which this process listens."""
    every = psutil.Process().net_connections("inet")
    return {each.laddr for each in every if each.status == psutil.CONN_LISTEN}


def addresses():
    """Of this machine, IPv4."""
    every = (each for names in psutil.net_if_addrs().values() for each in names)
    return [each.address for each in every if each.family.name == "AF_INET"]
