"""solve_horizon.py as a user meets it: files, exit codes, messages, Ctrl-C at any moment."""

import csv
import json
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from ctr_nlp import Plan
from ctr_nlp.cli.compare_solvers import main as compare_solvers
from ctr_nlp.cli.output import MARK
from ctr_nlp.cli.solve_horizon import main as solve_horizon
from ctr_nlp.solvers import CHAIN_SOLVERS
from ctr_nlp.solvers.chains import judged
from ctr_nlp.steer.nlp_frames import NlpFrames
from problems import FOLDER

ROOT = FOLDER.parent
PICTURES = {"shapes.png", "errors.png", "by_frame.png", "configuration.png"}
FILES = {"plan.npz", "errors.csv", "summary.json", MARK} | PICTURES


def solve(*arguments):
    return solve_horizon(FOLDER, [str(argument) for argument in arguments])


@pytest.fixture
def configuration(tmp_path):
    """Writes a configuration to a file and tells where."""

    def write(name, alpha, beta, theta=(0, 0)):
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({"alpha": list(alpha), "beta": list(beta), "theta": list(theta)}))
        return path

    return write


def test_a_named_problem_becomes_a_folder_of_results(tmp_path, capsys):
    out = tmp_path / "out"
    assert solve("arc", "--frames", 6, "--out", out) == 0
    assert {path.name for path in out.iterdir()} == FILES
    summary = json.loads((out / "summary.json").read_text())
    assert summary["formulation"] == "horizon"
    assert summary["failed"] == 0
    assert summary["weights"]["motion_s2"] > 0
    assert summary["solve_ms"]["median"] is None
    assert summary["solve_ms"]["total"] > 0
    plan = Plan.load(out / "plan.npz")
    assert np.isnan(plan.solve_time).all()
    assert plan.success.all()
    printed = capsys.readouterr().out
    assert "arc, horizon by banded" in printed
    assert "roughness" in printed


@pytest.mark.parametrize("solver", ["banded", "ipopt"])
def test_options_reach_the_motion(tmp_path, solver, configuration):
    start = configuration("start", (0, 0, 0), (0, 1, 10))
    end = configuration("end", (0.5, 0.5, 0.5), (20, 60, 145))
    out = tmp_path / "out"
    limits = ("--speed", 3, 60, 0.5, "--acceleration", 20, 200, 4)
    assert (
        solve("arc", "--frames", 8, "--solver", solver, "--start", start, "--end", end, *limits, "--out", out) == 0
    )
    plan = Plan.load(out / "plan.npz")
    np.testing.assert_allclose(plan.q[-1], [0.5, 0.5, 0.5, 20, 60, 145, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(plan.robot.speed, [3, 3, 3, 60, 60, 60, 0.5, 0.5])
    q = np.vstack([[[0, 0, 0, 0, 1, 10, 0, 0]] * 2, plan.q, plan.q[-1:]])
    assert (np.abs(np.diff(q, axis=0)) <= plan.robot.speed * plan.dt + 1e-6).all()
    assert (np.abs(np.diff(q, n=2, axis=0)) <= plan.robot.acceleration * plan.dt**2 + 1e-6).all()


def test_a_retraction_and_a_second_solve_from_a_plan(tmp_path):
    there, back, again = (tmp_path / name for name in ("there", "back", "again"))
    assert solve("arc", "--frames", 6, "--lock-tilt", "--out", there) == 0
    assert solve("arc", "--frames", 6, "--lock-tilt", "--retract", "--starts", 2, "--out", back) == 0
    plans = [Plan.load(folder / "plan.npz") for folder in (there, back)]
    np.testing.assert_allclose(plans[1].target, plans[0].target[::-1])
    assert plans[1].meta["problem"]["name"] == "arc-retraction"
    assert (plans[1].theta == 0).all()
    arguments = ("--initial", there / "plan.npz", "--motion-weight", 1e-4, "--lock-tilt")
    assert solve("arc", "--frames", 6, *arguments, "--out", again) == 0
    assert Plan.load(again / "plan.npz").meta["options"]["motion_weight"] == 1e-4


def test_a_sweep_draws_and_lists_the_trade_off(tmp_path, capsys):
    out = tmp_path / "out"
    assert solve("arc", "--frames", 5, "--sweep-motion-weight", 1e-2, 1e-5, "--out", out) == 0
    assert {path.name for path in out.iterdir()} == FILES | {"pareto.csv", "pareto.png"}
    with open(out / "pareto.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    methods = ["horizon", "horizon", "joint:ipopt", "two-stage:ipopt", "seed-two-stage", "euclidean"]
    assert [row["method"] for row in rows] == methods
    exact, smooth = rows[:2]
    assert (float(exact["motion_weight"]), float(smooth["motion_weight"])) == (1e-5, 1e-2)
    assert float(exact["e3"]) <= float(smooth["e3"])
    assert float(exact["roughness"]) >= float(smooth["roughness"])
    assert "error against roughness" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["arc", "--frames", "1"], "frames is 1; a motion over a horizon needs at least 2"),
        (["arc", "--motion-weight", "-1"], "motion_weight is -1.0 s^2"),
        (["arc", "--motion-weight", "nan"], "motion_weight is nan s^2"),
        (["arc", "--sweep-motion-weight", "1e-5", "-2"], "motion_weight is -2.0 s^2"),
        (["arc", "--speed", "2", "5", "1"], "beta_3 may slide at 5 mm/s"),
        (["arc", "--speed", "2", "-5", "1"], "speed of beta_1 is -5; it must be positive"),
        (["arc", "--acceleration", "2", "nan", "1"], "acceleration"),
        (["arc", "--starts", "0"], "starts is 0"),
        (["arc", "--jobs", "-1"], "jobs is -1"),
        (["arc", "--seed", "-1"], "seed is -1"),
        (["arc", "--start", "missing.json"], "start missing.json cannot be read"),
        (["arc", "--initial", "missing.npz"], "missing.npz is not a plan"),
        (["nowhere"], "problem is 'nowhere'"),
    ],
)
def test_bad_input_is_one_line_before_solving(tmp_path, arguments, message, capsys, monkeypatch):
    monkeypatch.setattr(NlpFrames, "search", lambda *_: pytest.fail("solving has started"))
    assert solve(*arguments, "--out", tmp_path / "out") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not list(tmp_path.iterdir())


def test_a_start_outside_the_limits_is_refused(tmp_path, configuration, capsys):
    start = configuration("start", (0, 0, 0), (0, 1, 160))
    assert solve("arc", "--frames", 5, "--start", start, "--out", tmp_path / "out") == 2
    assert "beta_3 of start is 160; it must lie in [0, 150]" in capsys.readouterr().err


def test_ends_too_far_apart_are_refused_with_what_to_relax(tmp_path, configuration, capsys):
    ends = configuration("start", (0, 0, 0), (0, 1, 5)), configuration("end", (30, 0, 0), (0, 1, 100))
    arguments = ("--start", ends[0], "--end", ends[1])
    assert solve("arc", "--frames", 5, *arguments, "--out", tmp_path / "out") == 2
    assert "speed of alpha_1 would have to be 1.50 times what is allowed" in capsys.readouterr().err


def test_an_unsolved_horizon_is_exit_status_1_and_says_why(tmp_path, capsys, monkeypatch):
    def gives_up(chain):
        return lambda x0, watch, barrier=0: judged(chain, x0, np.zeros(chain.bounds[0].size), "Gave_Up", 0)

    monkeypatch.setitem(CHAIN_SOLVERS, "banded", gives_up)
    assert solve("cos", "--frames", 6, "--motion-weight", "1e-3", "--out", tmp_path / "out") == 1
    assert "all not solved: Gave_Up, KKT residual" in capsys.readouterr().out
    assert not Plan.load(tmp_path / "out" / "plan.npz").success.any()


def command(out):
    return [sys.executable, ROOT / "scripts" / "solve_horizon.py", "cos", "--frames", "600", "--out", out]


def interrupted_after(seconds, out):
    process = subprocess.Popen(command(out), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=300)
    plan = Plan.load(out / "plan.npz")
    for q in plan.q:
        plan.robot.check(q)
    assert (np.abs(np.diff(plan.q, axis=0)) <= plan.robot.speed * plan.dt + 1e-6).all()
    at_its_end = (0, -signal.SIGINT)  # everything is written by then
    assert process.returncode in ((130,) if plan.meta["interrupted"] else at_its_end), errors
    assert plan.meta["interrupted"] or plan.success.all()
    return plan, output


def test_ctrl_c_while_the_program_loads_still_leaves_a_plan(tmp_path):
    plan, output = interrupted_after(0.3, tmp_path / "out")
    assert plan.meta["interrupted"]
    assert "interrupted" in output


@pytest.mark.slow
def test_ctrl_c_at_20_random_moments_always_leaves_a_plan_within_limits(tmp_path):
    moments = random.Random(0)
    for _ in range(2):  # the first may have to compile
        begin = time.perf_counter()
        subprocess.run(command(tmp_path / "whole"), check=True, capture_output=True)
        whole = time.perf_counter() - begin
    plans = [interrupted_after(moments.uniform(0.1, whole), tmp_path / str(i))[0] for i in range(20)]
    assert any(plan.meta["interrupted"] for plan in plans)


def test_horizons_are_compared_from_one_start(tmp_path, capsys):
    out = tmp_path / "out"
    variants = ["horizon:banded", "horizon:ipopt", "joint:ipopt"]
    assert compare_solvers(FOLDER, ["arc", "--frames", "5", "--out", str(out), "--variants", *variants]) == 0
    (found,) = json.loads((out / "agreement.json").read_text())
    assert found["agree"]
    assert found["difference"] <= max(1e-4 * found["first_objective"], 1e-6)
    assert found["differing_limits"] == 0
    assert "do solvers of the horizon agree?" in capsys.readouterr().out
    rows = json.loads((out / "comparison.json").read_text())
    assert [row["variant"] for row in rows] == variants
    assert "Whether solvers of the horizon agree" in (out / "comparison.md").read_text()
