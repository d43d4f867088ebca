"""Programs are interpreted until a process of its own has compiled them, and solved alike."""

import logging
import os
import shutil
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
from ctr_nlp.nlp.nlp import Nlp, Residual
from ctr_nlp.solvers import compiled
from ctr_nlp.solvers.frame.program import Program

pytestmark = pytest.mark.skipif(bool(cache.missing()), reason="no C compiler")
TESTS = Path(__file__).parents[1]
LONG = 120.0
"""s that a compiler may take on a busy machine."""


@pytest.fixture
def cold(tmp_path, monkeypatch):
    """A cache in which nothing is, and compiling as users have it."""
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CTR_NLP_COMPILE", raising=False)
    cache.say.cache_clear()
    yield tmp_path / "cache"
    cache.say.cache_clear()


def toy(factor):
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    residual = Residual("toy", ca.vertcat(factor * (x[0] - p), ca.sin(x[1]) + x[0] * x[1]))
    return Nlp("toy", x, np.full(2, -3.0), np.full(2, 3.0), {"p": p}, (residual,))


def ready(nlp, lanes=1):
    end = time.monotonic() + LONG
    while compiled.library(nlp, lanes).soon() is None:
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
    time.sleep(background.POLL + 0.1)
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
    call = "from codegen.test_background import toy; from ctr_nlp.solvers import compiled; "
    call += "print(compiled.library(toy(1.125), 1).now().is_file())"
    run = partial(subprocess.Popen, [sys.executable, "-c", call], cwd=TESTS, stdout=subprocess.PIPE, text=True)
    assert [process.communicate()[0] for process in [run(), run()]] == ["True\n"] * 2
    assert len(list(marks.iterdir())) == 1


def test_what_is_compiled_steps_back_for_what_is_waited_for(cold):
    compiled.library(toy(31.0), 1).soon()
    process = background._begun[-1]
    group = Path(f"/proc/{process.pid}/autogroup")
    assert os.getpriority(os.PRIO_PROCESS, process.pid) == background.NICE
    assert not group.exists() or group.read_text().split()[-1] == str(background.NICE)
    assert process.wait(LONG) == 0


def test_now_means_at_once(cold, monkeypatch):
    monkeypatch.setenv("CTR_NLP_COMPILE", "now")
    assert Program(toy(1.75)).compiled


def test_what_a_process_begins_nobody_else_begins_and_it_is_said_once(cold, monkeypatch, caplog):
    begun = list[str]()
    monkeypatch.setattr(background, "_begin", lambda key, functions, lanes: begun.append(key))
    with caplog.at_level(logging.WARNING, "ctr_nlp"):
        for factor in (2.0, 2.0, 2.25):
            assert compiled.library(toy(factor), 1).soon() is None
    assert len(begun) == 2
    assert [record.getMessage() for record in caplog.records] == [background.NOTE]


def test_a_build_that_never_ended_is_begun_again(cold, monkeypatch):
    begun = list[str]()
    monkeypatch.setattr(background, "_begin", lambda key, functions, lanes: begun.append(key))
    nlp = toy(2.5)
    compiled.library(nlp, 1).soon()
    monkeypatch.setattr(background, "CLAIMED", -1.0)
    monkeypatch.setattr(background, "POLL", 0.0)
    compiled.library(nlp, 1).soon()
    assert len(begun) == 2


def test_a_cache_that_cannot_be_written_leaves_programs_interpreted(cold, monkeypatch):
    cold.write_text("in the way")
    program = Program(toy(2.75))
    assert not program.compiled
    assert np.isfinite(solution(program)[1])


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
