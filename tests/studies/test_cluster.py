"""Studies on clusters that somebody else has begun: encrypted, or of the wrong kind, or not there."""

from __future__ import annotations

import os
import platform
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from clusters import LOOPBACK, cluster, environment

from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import ClusterError
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers import clients
from ctr_nlp.studies.workers.clients import cluster_client, local_client
from ctr_nlp.studies.workers.running import run_study
from ctr_nlp.studies.workers.task import run_batch

pytest.importorskip("distributed", reason="the extra `study` is not installed")
psutil = pytest.importorskip("psutil", reason="the extra `study` is not installed")

SMALL = {"problems": {"names": ["arc"]}, "frames": 4, "models": "dominant", "settings": {"seed": [0, 1, 2]}}
PATIENCE = 30
"""s after which a command that should have been refused has hung."""


@pytest.fixture
def path(tmp_path):
    place = tmp_path / "s.toml"
    place.write_text(
        'frames = 4\nmodels = "dominant"\n[problems]\nnames = ["arc"]\n[settings]\nseed = [0, 1, 2]\n'
    )
    return place


def certified(folder):
    """dask's own variables for a new certificate, which is its own authority, and its key."""
    folder.mkdir()
    key, certificate = folder / "key.pem", folder / "certificate.pem"
    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
    command = ["openssl", "req", "-x509", *curve, "-days", "1", "-subj", "/CN=ctr_nlp"]
    subprocess.run([*command, "-keyout", str(key), "-out", str(certificate)], check=True, capture_output=True)
    tls = "DASK_DISTRIBUTED__COMM__TLS__"
    each = {
        f"{tls}{role}__{what}": str(file)
        for role in ("SCHEDULER", "WORKER", "CLIENT")
        for what, file in (("KEY", key), ("CERT", certificate))
    }
    return each | {f"{tls}CA_FILE": str(certificate), "DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION": "true"}


def asked(path, out, address, env=None):
    """The exit status of the command in a process of its own, and all that it says."""
    command = [sys.executable, "-m", "ctr_nlp", "study", str(path), "--address", address, "--out", str(out)]
    done = subprocess.run(command, env=environment(env), capture_output=True, text=True, timeout=PATIENCE)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.slow
def test_a_cluster_with_tls_does_a_study_and_answers_nobody_without(path, tmp_path):
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes certificates, is not installed")
    ours, theirs = certified(tmp_path / "ours"), certified(tmp_path / "theirs")
    with cluster(tmp_path / "cluster", 1, ours, "--protocol", "tls") as (address, _):
        assert address.startswith(f"tls://{LOOPBACK}:")
        status, said = asked(path, tmp_path / "out", address, ours)
        assert status == 1, said  # the arc is missed by 3 mm: verdicts say no
        plain = address.replace("tls:", "tcp:")
        for url, env in ((address, None), (address, theirs), (plain, None), (plain, ours)):
            status, said = asked(path, tmp_path / "no", url, env)
            assert status == 2, said
            assert said.startswith(f"error: no cluster can be reached at {url}: ")
            assert said.count("\n") == 1
    assert len(Results(tmp_path / "out").read_digests()) == 3
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    "address",
    [f"tcp://{LOOPBACK}:1", f"tls://{LOOPBACK}:1", "here", "", f"carrier://{LOOPBACK}:1", f"tcp://{LOOPBACK}"],
)
def test_an_address_where_no_cluster_is_is_refused(address, path, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(clients, "SCHEDULER_CONNECT_TIMEOUT_S", 1.0)
    assert main(["study", str(path), "--address", address, "--out", str(tmp_path / "no")]) == 2
    said = capsys.readouterr().err
    begin = f"error: no cluster can be reached at {address}: "
    assert said.startswith(begin)
    assert said.count("\n") == 1
    assert len(said.removeprefix(begin)) > 10
    assert not (tmp_path / "no").exists()


def test_workers_without_this_package_are_told(tmp_path):
    (tmp_path / "ctr_nlp").mkdir()
    (tmp_path / "ctr_nlp" / "__init__.py").write_text("raise ModuleNotFoundError('No module named ctr_nlp')\n")
    with (
        cluster(tmp_path / "cluster", 1, {"PYTHONPATH": str(tmp_path)}) as (address, _),
        cluster_client(address) as client,
        pytest.raises(ClusterError, match="scheduler and workers need ctr_nlp"),
    ):
        run_study(Study.from_dict(SMALL, Path()), tmp_path / "out", client)
    assert Results(tmp_path / "out").read_digests() == set()


def test_a_worker_of_another_version_makes_no_rows():
    case, *_ = Study.from_dict(SMALL, Path()).cases
    vars(case)["digest"] = "of a client with another version"
    with pytest.raises(ClusterError, match=r"other versions.*it has ctr_nlp .*, casadi"):
        run_batch([case], None, 60.0)


def page_faults():
    """Of taking and freeing 4 MB fifty times, in the thread that plans."""
    before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
    for _ in range(50):
        np.ones(500_000)
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other systems free memory by other rules")
def test_workers_keep_the_memory_that_the_next_plan_takes():
    with local_client(1) as client:
        found = client.submit(page_faults).result(60)
    assert found < 5 * 4e6 / os.sysconf("SC_PAGESIZE")


def listening(process):
    """Addresses at which a process and its children listen."""
    found = set()
    for one in (process, *process.children(recursive=True)):
        found |= {each.laddr for each in one.net_connections("inet") if each.status == psutil.CONN_LISTEN}
    return found


def test_a_cluster_of_this_machine_listens_on_loopback_only():
    process = psutil.Process(os.getpid())
    before = listening(process)
    with local_client(2) as client:
        found = listening(process) - before
        dashboard = client.dashboard_link
        ports = {int(url.rpartition(":")[2]) for url in (client.scheduler.address, *client.nthreads())}
    assert ports <= {each.port for each in found}
    assert {each.ip for each in found} == {LOOPBACK}
    assert dashboard.startswith(f"http://{LOOPBACK}:")
    assert int(dashboard.rpartition(":")[2].partition("/")[0]) in {each.port for each in found}
