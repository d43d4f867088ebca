"""The benchmark: what it says of two trees, of rows, of growth and of what is not compiled."""

import json
import math
import statistics
import subprocess
import sys
from contextlib import contextmanager

import benchmark
import casadi as ca
import numpy as np
import pytest
from benchmark import main, unexplained_rows
from benchmarks import tree_comparison, uncompiled_time, work
from benchmarks.growth import draw_growths, fit_growth
from benchmarks.operations import LIBRARY_FUNCTION_OPERATIONS, count_operations, measure_roof
from benchmarks.peers import PEER_RACE_ROUNDS, REFERENCE_FRAME_STRIDE, REFERENCES, race_solvers
from benchmarks.tree_comparison import (
    LEAST_BLOCKS,
    RowComparison,
    Worker,
    compare_row,
    mean_of_least_times,
    measure_row,
    median_confidence_interval,
)
from benchmarks.trees import tree_of
from common import ROOT, named_problem

from ctr_nlp.codegen.cache import vector_lanes
from ctr_nlp.exceptions import BenchmarkError

BUSY = "while True: sum(range(10000))"
BLOCKS = 12
MANY = 40
"""Blocks of a trial, so that other processes of the machine widen its interval little."""

# The two trials: a slowdown that was put in on purpose, and nothing changed


@contextmanager
def load():
    """A process beside that computes without end."""
    with subprocess.Popen([sys.executable, "-c", BUSY]) as busy:
        try:
            yield
        finally:
            busy.kill()


def trial(factor):
    """The verdict on this tree's steps beside its own, the later ones so many times as slow, under load."""
    with load(), Worker(ROOT, "step") as before, Worker(ROOT, "step") as after:
        return compare_row("step", before, after, MANY, factor=factor)


@pytest.mark.parametrize(
    ("factor", "verdict"), [(1.5, "slower"), pytest.param(1.0, "same", marks=pytest.mark.slow)]
)
def test_a_slowdown_by_half_is_found_under_load_and_none_where_nothing_changed(factor, verdict):
    found = trial(factor)
    assert found.verdict == verdict, found
    assert found.low <= found.ratio <= found.high


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "verdict"), [(1.5, "slower"), (1.0, "same")])
def test_both_trials_end_well_twenty_times_of_twenty(factor, verdict):
    found = [trial(factor) for _ in range(20)]
    assert [one.verdict for one in found] == 20 * [verdict], found


# Decisions


class Scripted:
    """A worker whose pieces take a given time, and noise on top."""

    def __init__(self, seconds, seed=0):
        self.seconds, self._rng = seconds, np.random.default_rng(seed)

    def turns(self, count, factor=1.0):
        noise = 1 + self._rng.exponential(0.05, (count, 3))
        return (factor * self.seconds * noise).tolist()


@pytest.mark.parametrize(
    ("ratio", "verdict"), [(1.0, "same"), (1.1, "same"), (1.3, "slower"), (0.9, "same"), (0.7, "faster")]
)
def test_losses_and_gains_beyond_the_tolerance_are_told_apart_from_what_is_within(ratio, verdict, monkeypatch):
    monkeypatch.setattr(tree_comparison, "turns_for_min_duration", lambda worker: 5)
    for seed in range(20):
        found = compare_row("row", Scripted(1e-3, seed), Scripted(ratio * 1e-3, seed + 100), BLOCKS)
        assert found.verdict == verdict
        assert found.ratio == pytest.approx(ratio, rel=0.05)


def test_a_drift_of_the_machine_is_no_change(monkeypatch):
    """Everything takes longer and longer, both trees alike: turns in the order A B B A cancel it."""
    monkeypatch.setattr(tree_comparison, "turns_for_min_duration", lambda worker: 1)
    clock = iter(range(10**6))

    class Drifting(Scripted):
        def turns(self, count, factor=1.0):
            return [[self.seconds * (1 + 0.5 * next(clock))]]

    assert compare_row("row", Drifting(1e-3), Drifting(1e-3), BLOCKS).ratio == pytest.approx(1.0, rel=0.02)


def test_the_interval_covers_the_median_as_often_as_it_says():
    rng = np.random.default_rng(0)
    for count in (LEAST_BLOCKS, BLOCKS, 30):
        drawn = [median_confidence_interval(rng.standard_cauchy(count)) for _ in range(2000)]
        assert np.mean([low <= 0 <= high for low, high in drawn]) >= 0.975
    with pytest.raises(BenchmarkError, match="6 blocks are too few; 7 are needed"):
        median_confidence_interval([1.0] * (LEAST_BLOCKS - 1))


def test_of_turns_the_least_time_of_each_piece_counts():
    assert mean_of_least_times([[1.0, 9.0], [5.0, 3.0]]) == 2.0


def row(name, low, high):
    return RowComparison(name, 1.0, 1.0, math.sqrt(low * high), low, high)


def test_a_gain_needs_a_reason_and_a_loss_has_none():
    slower, faster, same = row("a", 1.3, 1.6), row("b", 0.5, 0.6), row("c", 0.8, 1.4)
    assert [one.verdict for one in (slower, faster, same)] == ["slower", "faster", "same"]
    assert unexplained_rows([slower, faster, same], []) == [slower, faster]
    assert unexplained_rows([slower, faster, same], ["a", "b"]) == [slower]


# Rows and trees


def test_a_row_is_repeated_and_a_slowdown_multiplies_its_time():
    with Worker(ROOT, "frame") as worker:
        ratios = [
            mean_of_least_times(worker.turns(5, 2.0)) / mean_of_least_times(worker.turns(5)) for _ in range(5)
        ]
        assert statistics.median(ratios) == pytest.approx(2.0, rel=0.4)
        seconds = measure_row(worker, 0.1)
    assert len(seconds) >= 5
    assert (seconds > 0).all()


def test_a_row_that_does_not_exist_is_one_line():
    with (
        pytest.raises(BenchmarkError, match=r"row nothing of .* ended early: KeyError: 'nothing'"),
        Worker(ROOT, "nothing"),
    ):
        pass


def test_a_commit_is_checked_out_while_it_is_needed_and_another_is_refused(tmp_path, monkeypatch):
    def git(*arguments):
        who = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", "-C", str(tmp_path), *who, *arguments], check=True, capture_output=True)

    git("init")
    (tmp_path / "file").write_text("first")
    git("add", "file")
    git("commit", "-m", "first")
    (tmp_path / "file").write_text("second")
    monkeypatch.setattr("benchmarks.trees.ROOT", tmp_path)
    with tree_of("HEAD") as tree:
        assert (tree / "file").read_text() == "first"
    assert not tree.exists()
    assert not list((tmp_path / ".git" / "worktrees").glob("*"))
    for commit in ("nowhere", "--all"):
        with (
            pytest.raises(BenchmarkError, match=f"commit '{commit}' of .* cannot be checked out"),
            tree_of(commit),
        ):
            pass


# Growth, peers, shares


def test_an_exponent_is_found_and_drawn(tmp_path):
    sizes = np.array([10.0, 100.0, 1000.0])
    found = fit_growth("cubes", sizes, 3e-6 * sizes**3)
    assert (found.exponent, found.error) == (pytest.approx(3.0), pytest.approx(0.0, abs=1e-9))
    assert fit_growth("noisy", sizes, 3e-6 * sizes * [1.0, 2.0, 1.0]).error > 0.1
    assert draw_growths([found], tmp_path / "growth.png").stat().st_size > 1000


def test_every_method_has_its_frames_and_sqp_solves_them_all():
    """The first frame is where all begin; the slow methods are asked once, for every REFERENCE_FRAME_STRIDE-th."""
    problem = named_problem("arc", 2 * REFERENCE_FRAME_STRIDE + 2)
    times = race_solvers(problem)
    assert set(times) == {"sqp", "ipopt", *REFERENCES}
    for name, taken in times.items():
        assert len(taken.seconds) == (2 if name in REFERENCES else PEER_RACE_ROUNDS * (problem.frames - 1))
        assert 0 <= taken.failed <= len(taken.seconds)
    assert times["sqp"].failed == 0


def test_compiled_code_is_what_is_called_and_python_is_outside():
    assert uncompiled_time.uncompiled_share(lambda: sum(k * k for k in range(100_000)), 2) == 1.0
    for end, function in uncompiled_time.CALLERS:
        (file,) = (ROOT / "ctr_nlp").glob(f"**/{end}")
        assert f"def {function}(" in file.read_text()


# The program


@pytest.fixture
def thin(monkeypatch):
    monkeypatch.setattr(benchmark, "BENCHMARK_ROW_DURATION_S", 0.1)


def test_a_row_is_told_and_written(thin, tmp_path, capsys):
    file = tmp_path / "rows.json"
    assert main(["--parts", "rows", "--rows", "frame", "--json", str(file)]) == 0
    (entry,) = json.loads(file.read_text())["rows"]
    assert entry["row"] == "frame"
    assert 0 < entry["least"] <= entry["median"] <= entry["p99"]
    assert "frame" in capsys.readouterr().out


@pytest.mark.parametrize(("explained", "status"), [([], 1), (["--explained", "step"], 0)])
def test_an_unexplained_gain_ends_in_1(explained, status, monkeypatch, capsys):
    @contextmanager
    def nowhere(commit):
        yield ROOT

    monkeypatch.setattr(benchmark, "tree_of", nowhere)
    monkeypatch.setattr(benchmark, "compare_trees", lambda *_: [row("step", 0.5, 0.6)])
    assert main(["--against", "HEAD", *explained]) == status
    assert "faster" in capsys.readouterr().out


def assert_refused(capsys, *words):
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ")
    assert all(word in error for word in words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--blocks", "6"], ("--blocks is 6", "at least 7")),
        (["--tolerance", "-1"], ("--tolerance is -1",)),
        (["--tolerance", "nan"], ("--tolerance is nan",)),
        (["--picture", "missing/growth.png"], ("--picture is missing/growth.png",)),
        (["--against", "no-such-commit"], ("commit 'no-such-commit'",)),
    ],
)
def test_what_cannot_be_is_one_line(arguments, words, capsys):
    assert main(arguments) == 2
    assert_refused(capsys, *words)


def test_without_a_compiler_nothing_is_measured(monkeypatch, capsys):
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    assert main([]) == 2
    assert_refused(capsys, "CTR_NLP_COMPILE is 0")


def test_every_row_of_work_can_be_asked_for():
    assert {"step", "step-elastic", "horizon-5000", "program", "program-figures"} <= set(work.BENCHMARK_ROWS)


def test_operations_are_those_of_the_instructions_without_repetitions():
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [ca.vertcat(x[0] * x[1] + ca.sin(x[0]), x[0] * x[1])])
    assert count_operations(function) == 2 + LIBRARY_FUNCTION_OPERATIONS


def test_the_roof_of_a_shape_has_its_counted_calls():
    roof = measure_roof()
    # Vectors cover the hundred and one points of a shape, the last one in part.
    assert roof.calls["points"] == -(-101 // vector_lanes())
    assert 1 / vector_lanes() <= roof.calls["shape"] < 1.1 / vector_lanes()
    assert roof.calls["motors_beside"] > 1
    assert roof.operations > 1e5
    assert 0 < roof.share < 1
