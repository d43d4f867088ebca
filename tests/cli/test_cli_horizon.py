"""`ctr-nlp plan` over a horizon as a user meets it: files, exit codes, messages, Ctrl-C at any moment."""

import csv
import json
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from common import UNJUDGED
from compare import main as compare_solvers

from ctr_nlp import Plan
from ctr_nlp.cli import problems
from ctr_nlp.cli.commands.plan import plan as solve_horizon
from ctr_nlp.cli.commands.plan import steer as solve_per_frame
from ctr_nlp.cli.output.folder import MARK
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.solvers import CHAIN_SOLVERS
from ctr_nlp.solvers.motion.chain_solution import evaluate_chain_solution
from ctr_nlp.studies import pareto_front

PICTURES = {"shapes.png", "errors.png", "by_frame.png", "configuration.png"}
FILES = {"plan.npz", "errors.csv", "summary.json", MARK} | PICTURES


def solve(*arguments):
    """Plan over a horizon on the dominant model, whose programs are compiled soon, whatever the plan is like."""
    return solve_horizon([*UNJUDGED, *map(str, arguments), "--model", "dominant"])


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
    assert "arc: horizon, dominant model, solver banded" in printed
    assert "roughness" in printed


@pytest.mark.parametrize("solver", ["banded", "ipopt"])
def test_options_reach_the_motion(tmp_path, solver, configuration):
    start = configuration("start", (0, 0, 0), (0, 1, 10))
    end = configuration("end", (0.5, 0.5, 0.5), (20, 60, 145))
    out = tmp_path / "out"
    limits = ("--speed", 3, 60, 0.5, "--acceleration", 20, 200, 4)
    options = ("--solver", solver, "--start", start, "--end", end, *limits, "--no-figures")
    assert solve("arc", "--frames", 8, *options, "--out", out) == 0
    plan = Plan.load(out / "plan.npz")
    np.testing.assert_allclose(plan.q[-1], [0.5, 0.5, 0.5, 20, 60, 145, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(plan.robot.speed, [3, 3, 3, 60, 60, 60, 0.5, 0.5])
    q = np.vstack([[[0, 0, 0, 0, 1, 10, 0, 0]] * 2, plan.q, plan.q[-1:]])
    assert (np.abs(np.diff(q, axis=0)) <= plan.robot.speed * plan.dt + 1e-6).all()
    assert (np.abs(np.diff(q, n=2, axis=0)) <= plan.robot.acceleration * plan.dt**2 + 1e-6).all()


def test_a_retraction_and_a_second_solve_from_a_plan(tmp_path):
    there, back, again = (tmp_path / name for name in ("there", "back", "again"))
    given = ("arc", "--frames", 6, "--lock-tilt", "--no-figures")
    assert solve(*given, "--out", there) == 0
    assert solve(*given, "--retract", "--starts", 2, "--out", back) == 0
    plans = [Plan.load(folder / "plan.npz") for folder in (there, back)]
    np.testing.assert_allclose(plans[1].target, plans[0].target[::-1])
    assert plans[1].meta["problem"]["name"] == "arc-retraction"
    assert (plans[1].theta == 0).all()
    assert solve(*given, "--initial", there / "plan.npz", "--motion-weight", 1e-4, "--out", again) == 0
    assert Plan.load(again / "plan.npz").meta["options"]["motion_weight"] == 1e-4


def test_a_sweep_draws_and_lists_the_trade_off(tmp_path, capsys):
    out = tmp_path / "out"
    assert solve("arc", "--frames", 5, "--sweep-motion-weight", 1e-2, 1e-5, "--out", out) == 0
    assert {path.name for path in out.iterdir()} == FILES | {"pareto.csv", "pareto.png"}
    with open(out / "pareto.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    methods = ["horizon", "horizon", "joint:ipopt", "two-stage:ipopt"]
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
        (["arc", "--start", "missing.json"], "configuration missing.json cannot be read"),
        (["arc", "--initial", "missing.npz"], "plan missing.npz cannot be read"),
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
    assert "beta_3 of start is 160 mm; it must lie in [0, 150] mm" in capsys.readouterr().err


def test_ends_too_far_apart_are_refused_with_what_to_relax(tmp_path, configuration, capsys):
    ends = configuration("start", (0, 0, 0), (0, 1, 5)), configuration("end", (30, 0, 0), (0, 1, 100))
    arguments = ("--start", ends[0], "--end", ends[1])
    assert solve("arc", "--frames", 5, *arguments, "--out", tmp_path / "out") == 2
    assert "speed of alpha_1 would have to be 1.50 times what is allowed" in capsys.readouterr().err


def test_an_unsolved_horizon_is_exit_status_1_and_says_why(tmp_path, capsys, monkeypatch):
    def gives_up(chain):
        return lambda x0, watch, *_: evaluate_chain_solution(
            chain, x0, np.zeros(chain.bounds[0].size), "Gave_Up", 0
        )

    monkeypatch.setitem(CHAIN_SOLVERS, "banded", gives_up)
    given = ("cos", "--frames", 6, "--motion-weight", "1e-3", "--no-figures")
    assert solve(*given, "--out", tmp_path / "out") == 1
    assert "all not solved: Gave_Up, KKT residual" in capsys.readouterr().out
    assert not Plan.load(tmp_path / "out" / "plan.npz").success.any()


def command(out, frames=600):
    program = [sys.executable, "-m", "ctr_nlp", "plan", "cos", "--model", "dominant"]
    return [*program, *UNJUDGED, "--frames", str(frames), "--out", out]


def interrupted_after(seconds, out, frames=600):
    """Ctrl-C then: "beside" where what there was until then has been written, "nothing", or "too late"."""
    process = subprocess.Popen(command(out, frames), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=300)
    if process.returncode in (0, -signal.SIGINT):  # everything is written by then
        return "too late"
    assert process.returncode == 130, errors
    if "nothing was written" in errors:
        return "nothing"
    plan = Plan.load(out / "interrupted" / "plan.npz")
    assert plan.meta["interrupted"]
    assert f"wrote {out / 'interrupted'}" in output.replace("\n", "")
    for q in plan.q:
        plan.robot.check(q)
    assert (np.abs(np.diff(plan.q, axis=0)) <= plan.robot.speed * plan.dt + 1e-6).all()
    return "beside"


def test_ctrl_c_while_the_program_loads_writes_nothing_and_says_so(tmp_path):
    assert interrupted_after(0.3, tmp_path / "out") == "nothing"
    assert not list(tmp_path.iterdir())


MINE = {"thesis.tex": "years of work", "interrupted/notes.txt": "mine", "deep/film.gif": "mine"}


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("count", "frames"), [(2, 20), pytest.param(20, 100, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_reruns_and_interruptions_touch_nothing_of_the_user_s_and_the_best_plan_stays(
    tmp_path, count, frames, capsys
):
    moments, out = random.Random(0), tmp_path / "out"
    for _ in range(2):  # the first may have to compile
        begin = time.perf_counter()
        subprocess.run(command(out, frames), check=True, capture_output=True)
        whole = time.perf_counter() - begin
    for name, text in MINE.items():
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text(text)
    (out / "interrupted" / MARK).write_text('{"format": 1, "files": {}}')  # made by an interrupted run
    told = []
    for _ in range(count):
        before = contents(out)
        told.append(interrupted_after(moments.uniform(0.1, whole), out, frames))
        after = contents(out)
        assert all(after[name].decode() == text for name, text in MINE.items())
        beside = {name for name in after if name.startswith("interrupted/")}
        changed = {name for name in {*before, *after} if before.get(name) != after.get(name)}
        assert not changed - (beside if told[-1] == "beside" else FILES if told[-1] == "too late" else set())
        assert Plan.load(out / "plan.npz").complete
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
    with capsys.disabled():
        print(f"\n{count} runs of {whole:.1f} s:", ", ".join(f"{told.count(one)} {one}" for one in set(told)))
    assert "beside" in told or count < 20


def pressing_ctrl_c_once(call):
    """The same call, before whose first Ctrl-C is pressed."""
    left = [signal.SIGINT]

    def pressed(*arguments, **options):
        if left:
            signal.raise_signal(left.pop())
        return call(*arguments, **options)

    return pressed


def test_ctrl_c_before_solving_begins_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(problems, "print_problem_notes", lambda _: signal.raise_signal(signal.SIGINT))
    for program in (solve_horizon, solve_per_frame):
        assert program(["cos", "--frames", "4", "--model", "dominant", "--out", str(tmp_path / "out")]) == 130
        assert "interrupted; nothing was written" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_interrupted_sweep_leaves_the_last_one(tmp_path, monkeypatch):
    arguments = ("arc", "--frames", 4, "--out", tmp_path / "out", "--sweep-motion-weight", 1e-3, 1e-5)
    monkeypatch.setattr(pareto_front, "COMPARED_VARIANTS", ("joint:ipopt",))
    assert solve(*arguments) == 0
    before = contents(tmp_path)
    monkeypatch.setattr(
        pareto_front, "sweep_motion_weights", pressing_ctrl_c_once(pareto_front.sweep_motion_weights)
    )
    assert solve(*arguments) == 130
    after = contents(tmp_path)
    assert {name: after[name] for name in before} == before
    assert "out/interrupted/plan.npz" in after


@pytest.mark.parametrize("moment", ["while frames are solved", "while the horizon is solved"])
def test_an_interrupted_run_leaves_a_good_plan_and_its_film(tmp_path, capsys, monkeypatch, moment):
    out, film = tmp_path / "out", tmp_path / "film.gif"
    arguments = ("cos", "--frames", 4, "--out", out, "--film", film)
    assert solve(*arguments) == 0
    before = contents(tmp_path)
    if moment == "while frames are solved":
        monkeypatch.setattr(NlpFrames, "step", pressing_ctrl_c_once(NlpFrames.step))
    else:
        solver = CHAIN_SOLVERS["banded"]
        monkeypatch.setitem(CHAIN_SOLVERS, "banded", lambda chain: pressing_ctrl_c_once(solver(chain)))
    capsys.readouterr()
    assert solve(*arguments) == 130
    told = capsys.readouterr().out.replace("\n", "")
    assert f"wrote {out / 'interrupted'}: " in told
    assert f"wrote {out / 'interrupted' / 'film.gif'}" in told
    after = contents(tmp_path)
    assert {name: after[name] for name in before} == before
    assert {name.removeprefix("out/interrupted/") for name in after if name not in before} == FILES | {"film.gif"}
    assert Plan.load(out / "interrupted" / "plan.npz").meta["interrupted"]


def test_horizons_are_compared_from_one_start(tmp_path, capsys):
    out = tmp_path / "out"
    variants = ["horizon:banded", "horizon:ipopt", "joint:ipopt"]
    assert compare_solvers(["arc", "--frames", "5", "--out", str(out), "--variants", *variants]) == 1
    (found,) = json.loads((out / "agreement.json").read_text())
    assert found["agree"]
    assert found["difference"] <= max(1e-4 * found["first_objective"], 1e-6)
    assert found["differing_limits"] == 0
    assert "do solvers of the horizon agree?" in capsys.readouterr().out
    rows = json.loads((out / "comparison.json").read_text())
    assert [row["variant"] for row in rows] == variants
    assert "Whether solvers of the horizon agree" in (out / "comparison.md").read_text()
