"""Processes that work side by side end with the one that they work for, however that is ended."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROGRAM = """
import os, sys, time
from pathlib import Path
from ctr_nlp.support.pool import run_in_parallel

def work(folder):
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(600)

if __name__ == "__main__":
    list(run_in_parallel(work, [sys.argv[1]] * 2, 2))
"""
DEADLINE_S = 60


def wait_until(happened):
    """Wait until a function returns something true; fail after a minute."""
    end = time.monotonic() + DEADLINE_S
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.05)


def has_ended(pid):
    """Whether a process is gone, or nobody has yet asked how it ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc to look for processes")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_a_terminated_program(tmp_path, number):
    (program := tmp_path / "program.py").write_text(PROGRAM)
    (seen := tmp_path / "seen").mkdir()
    with open(tmp_path / "errors", "w+") as errors:
        running = subprocess.Popen([sys.executable, str(program), str(seen)], stderr=errors)
        wait_until(lambda: len(os.listdir(seen)) == 2 or running.poll() is not None)
        running.send_signal(number)
        assert running.wait(DEADLINE_S) == (128 + number if number == signal.SIGTERM else -number)
        wait_until(lambda: all(has_ended(int(pid)) for pid in os.listdir(seen)))
        errors.seek(0)
        told = errors.read()
    assert len(os.listdir(seen)) == 2
    assert number == signal.SIGKILL or told == ""
