"""Programs are interpreted until a process of its own has compiled them, and solved alike."""

import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from ctr_nlp import Limits, Problem, Robot, Tube, curve_from_formula, growing, solve_horizon, solve_per_frame
from ctr_nlp.codegen import background, cache
from ctr_nlp.ocp.nlp import Nlp, Residual
from ctr_nlp.solvers import compiled_functions
from ctr_nlp.solvers.frame.program import Program

pytestmark = pytest.mark.skipif(bool(cache.unavailable_reason()), reason="no C compiler")
TESTS = Path(__file__).parents[1]
LONG = 120.0
"""s that a compiler may take on a busy machine."""


@pytest.fixture
def cold(tmp_path, monkeypatch):
    """A cache in which nothing is, and compiling as users have it."""
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CTR_NLP_COMPILE", raising=False)
    cache.warn_once.cache_clear()
    yield tmp_path / "cache"
    cache.warn_once.cache_clear()


def toy(factor):
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    residual = Residual("toy", ca.vertcat(factor * (x[0] - p), ca.sin(x[1]) + x[0] * x[1]))
    return Nlp("toy", x, np.full(2, -3.0), np.full(2, 3.0), {"p": p}, (residual,))


def ready(nlp, lanes=1):
    end = time.monotonic() + LONG
    while compiled_functions.library(nlp, lanes).path_if_ready() is None:
        assert time.monotonic() < end, "not compiled in time"
        time.sleep(0.1)


def solution(program):
    program.p[:], program.x[:], program.multipliers[:] = 0.7, [0.3, 0.2], 0.0
    found = program.run()
    return program.x.copy(), found.objective, found.iterations


def test_a_program_is_interpreted_until_it_is_compiled_and_finds_the_same(cold):
    nlp = toy(1.25)
    program = Program(nlp)
    assert not program.compiled
    first = solution(program)
    ready(nlp)
    time.sleep(background.LIBRARY_POLL_INTERVAL_S + 0.1)
    second = solution(program)
    assert program.compiled
    np.testing.assert_allclose(second[0], first[0], atol=1e-9)
    assert second[1:] == (pytest.approx(first[1], abs=1e-12), first[2])


def test_whoever_waits_has_compiled_functions_at_once(cold):
    assert Program(toy(1.5), wait=True).compiled


def test_processes_that_wait_for_one_library_have_it_made_once(cold, tmp_path, monkeypatch):
    """A compiler that leaves a mark where it makes a program, and takes its time."""
    marks = tmp_path / "marks"
    marks.mkdir()
    real, script = shutil.which("cc") or shutil.which("gcc"), tmp_path / "compiler"
    mark = f"case $(cat code.c) in *expansion_directed_0*) : > {marks}/$$; sleep 2;; esac"
    script.write_text(f'#!/bin/sh\ncase " $* " in *" -E "*) ;; *) {mark};; esac\nexec {real} "$@"\n')
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    call = "from codegen.test_background import toy; from ctr_nlp.solvers import compiled_functions; "
    call += "print(compiled_functions.library(toy(1.125), 1).wait_for_path().is_file())"
    run = partial(subprocess.Popen, [sys.executable, "-c", call], cwd=TESTS, stdout=subprocess.PIPE, text=True)
    assert [process.communicate()[0] for process in [run(), run()]] == ["True\n"] * 2
    assert len(list(marks.iterdir())) == 1


def test_what_is_compiled_steps_back_for_what_is_waited_for(cold):
    compiled_functions.library(toy(31.0), 1).path_if_ready()
    process = background._begun[-1]
    group = Path(f"/proc/{process.pid}/autogroup")
    assert os.getpriority(os.PRIO_PROCESS, process.pid) == background.COMPILER_NICENESS
    assert not group.exists() or group.read_text().split()[-1] == str(background.COMPILER_NICENESS)
    assert process.wait(LONG) == 0


def test_now_means_at_once(cold, monkeypatch):
    monkeypatch.setenv("CTR_NLP_COMPILE", "now")
    assert Program(toy(1.75)).compiled


def test_what_a_process_begins_nobody_else_begins_and_it_is_said_once(cold, monkeypatch, caplog):
    begun = list[str]()
    monkeypatch.setattr(background, "_begin", lambda work, key, functions, lanes: begun.append(key))
    with caplog.at_level(logging.WARNING, "ctr_nlp"):
        for factor in (2.0, 2.0, 2.25):
            assert compiled_functions.library(toy(factor), 1).path_if_ready() is None
    assert len(begun) == 2
    assert [record.getMessage() for record in caplog.records] == [background.BACKGROUND_BUILD_MESSAGE]


def test_a_process_begins_a_build_that_died_again_only_later(cold, monkeypatch):
    """What killed it, as a lack of memory, may kill the next one."""
    begun = list[str]()
    monkeypatch.setattr(
        background, "_begin", lambda work, key, functions, lanes: (begun.append(key), work.release())
    )
    monkeypatch.setattr(background, "LIBRARY_POLL_INTERVAL_S", 0.0)
    nlp = toy(2.5)
    for _ in range(3):
        compiled_functions.library(nlp, 1).path_if_ready()
    assert len(begun) == 1
    monkeypatch.setattr(background, "FAILED_BUILD_RETRY_S", -1.0)
    compiled_functions.library(nlp, 1).path_if_ready()
    assert len(begun) == 2


BEGIN = """\
import logging, sys, time
from codegen.test_background import toy
from ctr_nlp.codegen import background
from ctr_nlp.solvers import compiled_functions
logging.basicConfig(format="%(message)s")
library = compiled_functions.library(toy(float(sys.argv[1])), 1)
found = library.path_if_ready()
print(*[process.pid for process in background._begun], flush=True)
while len(sys.argv) > 2 and found is None:
    time.sleep(0.1)
    found = library.path_if_ready()
"""
"""A process that begins a build, tells its number, and waits for it where it has a second argument."""


def begin(*arguments):
    return subprocess.Popen(
        [sys.executable, "-c", BEGIN, *arguments],
        cwd=TESTS,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def slow(tmp_path, monkeypatch):
    """A compiler that waits for ever over a program, as long as the file that is yielded exists."""
    real, script, gate = shutil.which("cc") or shutil.which("gcc"), tmp_path / "compiler", tmp_path / "gate"
    gate.touch()
    wait = f"case $(cat code.c) in *expansion_directed_0*) while [ -e {gate} ]; do sleep 0.1; done;; esac"
    script.write_text(f'#!/bin/sh\ncase " $* " in *" -E "*) ;; *) {wait};; esac\nexec {real} "$@"\n')
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    cache.compiler.cache_clear()
    yield gate
    gate.unlink(missing_ok=True)
    cache.compiler.cache_clear()


def builds(cold):
    """Folders in which processes are at work."""
    return {path.name for path in cold.glob("building-*")}


def test_a_build_that_is_killed_is_begun_again_by_the_next_process_at_once(cold, slow, tmp_path, monkeypatch):
    """And nothing of it stays, neither in the cache nor in the temporary folder."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    pid = int(begin("3.5").communicate()[0])
    end = time.monotonic() + LONG
    while not list(cold.glob("building-*/**/code.c")):
        assert time.monotonic() < end, "not begun in time"
        time.sleep(0.05)
    (left,) = builds(cold)
    second = begin("3.5")
    assert second.communicate()[0] == "\n"  # the first one is still at work
    os.kill(pid, signal.SIGKILL)
    slow.unlink()
    out, _ = begin("3.5", "wait").communicate(timeout=LONG)
    assert int(out) != pid
    while builds(cold):
        assert time.monotonic() < end + LONG, left
        time.sleep(0.05)
    assert not [path for path in temporary.rglob("*") if path.suffix != ".lock"]


def test_whoever_finds_a_build_at_work_is_told_so(cold, slow):
    first = begin("3.75")
    assert first.communicate()[0] != "\n"
    out, said = begin("3.75").communicate()
    assert (out, said) == ("\n", f"{background.BACKGROUND_BUILD_MESSAGE}\n")


def test_a_build_outlives_the_process_that_began_it(cold, slow):
    """Also where that is killed, and the claim on it stays."""
    process = begin("4.5", "wait")
    pid = int(process.stdout.readline())
    process.kill()
    process.communicate()
    assert begin("4.5").communicate()[0] == "\n"
    slow.unlink()
    begin("4.5", "wait").communicate(timeout=LONG)
    end = time.monotonic() + LONG
    while builds(cold):
        assert time.monotonic() < end, f"process {pid} has not ended in time"
        time.sleep(0.1)


def test_what_a_compiler_refuses_is_told_and_not_begun_by_others(cold, tmp_path, monkeypatch):
    real, script = shutil.which("cc") or shutil.which("gcc"), tmp_path / "compiler"
    fail = "case $(cat code.c) in *expansion_directed_0*) echo no room >&2; exit 1;; esac"
    script.write_text(f'#!/bin/sh\ncase " $* " in *" -E "*) ;; *) {fail};; esac\nexec {real} "$@"\n')
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    begin("5.5").communicate()
    end = time.monotonic() + LONG
    while not list(cold.glob("failed-*")) or builds(cold):
        assert time.monotonic() < end, "not refused in time"
        time.sleep(0.05)
    out, said = begin("5.5").communicate()
    assert out == "\n"
    assert "no room" in said
    assert said.count("\n") == 1


def test_whoever_waits_for_another_process_is_told_in_one_line(cold, monkeypatch, caplog):
    monkeypatch.setattr(background, "SILENT_BUILD_WAIT_S", 0.2)
    nlp = toy(6.5)
    hold = "import sys, time; from ctr_nlp.codegen import background\n"
    hold += "with background._exclusive_build(sys.stdin.read()): print(flush=True); time.sleep(1.5)"
    holder = subprocess.Popen(
        [sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    holder.stdin.write(compiled_functions.library(nlp, 1).key)
    holder.stdin.close()
    holder.stdout.readline()
    with caplog.at_level(logging.WARNING, "ctr_nlp"):
        assert compiled_functions.library(nlp, 1).wait_for_path().is_file()
    holder.wait()
    holder.stdout.close()
    assert [record.getMessage() for record in caplog.records] == [background.WAITING_FOR_BUILD_MESSAGE]


def test_a_cache_that_cannot_be_written_leaves_programs_interpreted(cold, caplog):
    cold.write_text("in the way")
    with caplog.at_level(logging.WARNING, "ctr_nlp"):
        program = Program(toy(2.75))
    assert not program.compiled
    assert np.isfinite(solution(program)[1])
    (record,) = caplog.records
    assert f"compiled code cannot be kept in {cold}" in record.getMessage()


@pytest.mark.parametrize("solve", [solve_per_frame, solve_horizon])
def test_a_plan_of_a_kind_never_seen_is_the_one_of_compiled_code(cold, monkeypatch, solve):
    robot = Robot((Tube(150, 90, 0.01, 3, 2), Tube(300, 140, 0.012, 1.8, 1.2)), Limits(beta=[(0, 95), (0, 150)]))
    path = curve_from_formula(lambda u: (90 * ca.cos(u) - 90, 0, 90 * ca.sin(u)), 0.0, 1.3)
    problem = Problem("new", robot, growing(path, 5))
    begin = time.monotonic()
    first = solve(problem, model="dominant")
    seconds = time.monotonic() - begin
    monkeypatch.setenv("CTR_NLP_COMPILE", "now")
    second = solve(problem, model="dominant")
    assert first.complete
    assert seconds < LONG
    np.testing.assert_allclose(first.shape, second.shape, atol=1e-6)
