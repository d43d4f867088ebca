"""Designs beside general optimisers: the same tubes and tasks, as long, and only what is a robot with motions."""

from __future__ import annotations

import signal

import baselines
import casadi as ca
import numpy as np
import pytest
from truth import TWO
from tube_optimisers.race import DESIGN_OPTIMISERS, OptimiserRun, race_optimisers, seconds_to

from ctr_nlp import Manufacture, Problem, Robot, growing
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.tube_design.request import draft, search_for

RULES = Manufacture(channel=0.3, wall=0.1, outer=4.0)
PAIR = Robot(TWO.tubes)
PROGRAM = """
import casadi as ca
from ctr_nlp import Problem, Robot, curve_from_formula, growing

def problem(frames, duration, robot):
    curve = curve_from_formula(lambda u: (9 - 9 * ca.cos(u / 30), 5 * ca.sin(u / 35), u), 0.0, 60.0)
    return Problem("turn", robot, growing(curve, frames), duration=duration)
"""


@pytest.fixture(scope="module")
def search():
    """Two paths that no two tubes follow exactly, so that tubes matter more than the motion term."""
    tasks = [_task("turn", 9.0, 30.0, 5.0, 35.0), _task("wave", 12.0, 18.0, 9.0, 14.0)]
    whole = search_for(tasks, rules=RULES)
    assert [task.frames for task in map(draft, whole.tasks)] == [6, 6]
    return whole


def _task(name, bend, turns, side, turns_aside):
    curve = curve_from_formula(
        lambda u: (bend * (1 - ca.cos(u / turns)), side * ca.sin(u / turns_aside), u), 0.0, 60.0
    )
    return Problem(name, PAIR, growing(curve, 6))


@pytest.fixture(scope="module")
def runs(search):
    pytest.importorskip("cma", reason='needs cma: pip install "ctr_nlp[studies]"')
    return race_optimisers(search, 1, 0)


@pytest.mark.slow
def test_every_method_finds_tubes_and_is_never_worse_than_before(runs):
    assert tuple(run.method for run in runs) == DESIGN_OPTIMISERS
    for run in runs:
        assert run.evaluations >= len(run.e3) > 0
        assert (np.diff(run.e3) < 0).all()
        assert (np.diff(run.seconds) >= 0).all()


@pytest.mark.slow
def test_the_design_is_ahead_of_others_that_work_as_long(search, runs):
    design, *others = runs
    assert design.best <= min(run.best for run in others)
    assert design.best < search.plan_on_tubes(search.tubes.nominal_unknowns).rms


def test_after_ctrl_c_the_runs_that_were_not_begun_are_missing(search):
    pytest.importorskip("cma", reason='needs cma: pip install "ctr_nlp[studies]"')
    with deferred_interrupt():
        signal.raise_signal(signal.SIGINT)
        assert [run.method for run in race_optimisers(search, 1, 0)] == ["design"]


def test_the_time_to_an_error():
    run = OptimiserRun("design", np.array([1.0, 2.5]), np.array([0.8, 0.3]), 7)
    assert (seconds_to(run, 0.8), seconds_to(run, 0.5)) == (1.0, 2.5)
    assert seconds_to(run, 0.2) == np.inf


def test_the_command_writes_a_table_and_a_picture(tmp_path, capsys):
    pytest.importorskip("cma", reason='needs cma: pip install "ctr_nlp[studies]"')
    (tmp_path / "turn.py").write_text(PROGRAM)
    (tmp_path / "two.toml").write_text(PAIR.to_toml())
    given = ["--robot", str(tmp_path / "two.toml"), "--frames", "6", "--starts", "1", "--channel", "0.3"]
    out = ["--wall", "0.1", "--outer", "4", "--out", str(tmp_path / "out")]
    assert baselines.main([str(tmp_path / "turn.py"), *given, *out]) == 0
    assert "CMA-ES" in capsys.readouterr().out
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"baselines.md", "baselines.csv", "baselines.png", "baselines.pdf"} <= names
