"""The programs as a user meets them: files, exit codes, messages, nothing half-written."""

import csv
import json
import re
import signal
import subprocess
import sys
import time
from argparse import Namespace

import numpy as np
import pytest
from common import ROOT, UNJUDGED
from compare import main as compare_solvers

from ctr_nlp import Plan
from ctr_nlp.cli import terminal_output
from ctr_nlp.cli.commands.plan import plan as solve_horizon
from ctr_nlp.cli.commands.plan import steer as solve_per_frame
from ctr_nlp.cli.output.folder import MARK
from ctr_nlp.cli.problems import load_all
from ctr_nlp.exceptions import OptionError, OutputError
from ctr_nlp.planning.nlp_frames import NlpFrames

FILES = {
    "plan.npz",
    "errors.csv",
    "summary.json",
    "shapes.png",
    "errors.png",
    "by_frame.png",
    "configuration.png",
    MARK,
}


def solve(*arguments):
    """Run `steer` on the dominant model, whose programs are compiled soon, whatever the plan is like."""
    return solve_per_frame([*UNJUDGED, *map(str, arguments), "--model", "dominant"])


@pytest.fixture
def straight(tmp_path):
    """A centreline file, 140 mm along a gentle curve, with radii."""
    t = np.linspace(0, 140, 141)
    table = np.column_stack([t, 5 * (1 - np.cos(t / 50)), 0 * t, np.full(141, 4.0)])
    path = tmp_path / "straight.csv"
    np.savetxt(path, table, delimiter=",", header="x_mm,y_mm,z_mm,radius_mm", comments="")
    return path


def test_a_named_problem_becomes_a_folder_of_results(tmp_path, capsys):
    out = tmp_path / "a" / "b"
    assert solve("arc", "--frames", 5, "--out", out) == 0
    assert {path.name for path in out.iterdir()} == FILES
    summary = json.loads((out / "summary.json").read_text())
    assert {
        "e3",
        "e4",
        "e_max",
        "tip_max",
        "roughness",
        "max_step",
        "solve_ms",
        "build_s",
        "frames",
        "failed",
    } <= set(summary)
    with open(out / "errors.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:6] == ["frame", "time", "e2", "max", "tip", "nearest"]
    assert [int(row["frame"]) for row in rows] == [1, 2, 3, 4, 5]
    rms = np.sqrt(np.mean([float(row["e2"]) ** 2 for row in rows]))
    assert summary["e3"] == pytest.approx(rms)
    assert str(out) in capsys.readouterr().out


def test_files_come_whole_or_not_at_all_before_anything_is_shown(tmp_path, capsys, monkeypatch):
    out, seen = tmp_path / "out", []

    def drawn(plan, folder, progress):
        seen.append((capsys.readouterr().out, out.exists() and set(out.iterdir())))
        raise OutputError("no room for pictures")

    assert solve("arc", "--frames", 3, "--out", out) == 0
    before = {path: path.read_bytes() for path in out.iterdir()}
    capsys.readouterr()
    monkeypatch.setattr("ctr_nlp.view.figures.save_all", drawn)
    assert solve("arc", "--frames", 4, "--out", out) == 2
    ((printed, _),) = seen
    assert printed == ""
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_without_figures_those_of_another_plan_are_gone(tmp_path, capsys):
    out = tmp_path / "out"
    assert solve("arc", "--frames", 3, "--out", out) == 0
    assert solve("arc", "--frames", 4, "--no-figures", "--out", out) == 0
    assert {path.name for path in out.iterdir()} == {name for name in FILES if not name.endswith(".png")}
    *_, last = [line for line in capsys.readouterr().out.splitlines() if line.startswith("wrote")]
    assert "shapes.png" not in last


def test_plan_arrays_have_their_documented_shapes(tmp_path, straight):
    out = tmp_path / "out"
    assert solve(straight, "--frames", 3, "--no-figures", "--out", out) == 0
    with np.load(out / "plan.npz", allow_pickle=False) as data:
        shapes = {name: data[name].shape for name in data.files}
        meta = json.loads(str(data["meta"]))
    expected = {
        "time": (3,), "alpha": (3, 3), "beta": (3, 3), "theta": (3, 2), "target": (3, 101, 3),
        "shape": (3, 101, 3),
        "solve_time": (3,), "success": (3,), "objective": (3,), "kkt": (3,), "stability": (3,),
        "stability_between": (3,), "to_robot": (4, 4), "lumen_radius": (3, 101),
    }  # fmt: skip
    assert expected.items() <= shapes.items()
    assert {"problem", "robot", "model", "formulation", "solver", "options", "versions", "format"} <= set(meta)


def test_a_rerun_replaces_its_files_and_leaves_the_user_s(tmp_path, capsys):
    out = tmp_path / "out"
    assert solve("arc", "--frames", 2, "--out", out) == 0
    (out / "thesis.tex").write_text("years of work")
    assert solve("arc", "--frames", 3, "--out", out) == 0
    assert {path.name for path in out.iterdir()} == FILES | {"thesis.tex"}
    assert (out / "thesis.tex").read_text() == "years of work"
    assert "thesis" not in capsys.readouterr().out
    assert len(Plan.load(out / "plan.npz").time) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_folder_with_other_files_is_refused(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert solve("arc", "--frames", 2, "--out", tmp_path) == 2
    assert "not empty" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_of_ours_that_the_user_changed_is_refused_before_solving(tmp_path, capsys, monkeypatch):
    assert solve("arc", "--frames", 2, "--out", tmp_path) == 0
    (tmp_path / "errors.csv").write_text("corrected by hand")
    capsys.readouterr()
    monkeypatch.setattr(NlpFrames, "search", lambda *_: pytest.fail("solving has started"))
    assert solve("arc", "--frames", 3, "--out", tmp_path) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "errors.csv is in the way" in line
    assert (tmp_path / "errors.csv").read_text() == "corrected by hand"
    assert len(Plan.load(tmp_path / "plan.npz").time) == 2


@pytest.mark.parametrize("name", ["../../x", "/x", "..", "a/b"])
def test_a_problem_s_name_makes_no_path(tmp_path, name, monkeypatch):
    work = tmp_path / "deep" / "deeper"
    work.mkdir(parents=True)
    (work / "own.py").write_text(
        "from dataclasses import replace\n"
        "from ctr_nlp.problems import named_problem\n"
        f"problem = lambda *options: replace(named_problem('arc', *options), name={name!r})\n"
    )
    monkeypatch.chdir(work)
    before = set(tmp_path.rglob("*"))
    for program in (solve_per_frame, solve_horizon):
        assert program([*UNJUDGED, "own.py", "--frames", "2", "--no-figures", "--model", "dominant"]) == 0
    made = sorted((work / "runs").iterdir())
    assert [path.name.partition("~")[2][8:] for path in made] == ["-horizon-dominant", "-joint-dominant"]
    assert {Plan.load(path / "plan.npz").meta["problem"]["name"] for path in made} == {name}
    assert {path for path in tmp_path.rglob("*") if path.parent not in made} == before | {work / "runs", *made}


@pytest.mark.parametrize("place", ["file/out", "file", "/proc/ctr_nlp"])
def test_a_folder_that_cannot_be_written_is_refused_before_solving(tmp_path, place, capsys, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(NlpFrames, "search", lambda *_: pytest.fail("solving has started"))
    assert solve("arc", "--frames", 2, "--out", tmp_path / place) == 2
    assert "output folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "problem is 'nowhere'; it must be one of arc, bronchus, cos"),
        (["arc", "--frames", "0"], "frames is 0; it must be a whole number of at least 1"),
        (["arc", "--duration", "-1"], "duration is -1.0 s"),
        (["arc", "--duration", "nan"], "duration is nan s"),
        (["arc", "--motion-weight", "nan"], "motion_weight is nan"),
        (["arc", "--reverse"], "--reverse goes with a centreline file"),
        (["arc", "--robot", "missing.toml"], "robot file missing.toml"),
        (["arc", "--start", "missing.json"], "configuration missing.json cannot be read"),
    ],
)
def test_bad_input_is_one_line_and_nothing_written(tmp_path, arguments, message, capsys):
    assert solve(*arguments, "--out", tmp_path / "out") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not list(tmp_path.iterdir())


def test_unknown_options_list_the_valid_ones(capsys):
    with pytest.raises(SystemExit) as stop:
        solve("arc", "--solver", "snopt")
    assert stop.value.code == 2
    assert "ipopt" in capsys.readouterr().err


def test_a_path_that_is_too_long_needs_trimming(tmp_path, capsys):
    t = np.linspace(0, 170, 60)
    long = tmp_path / "long.csv"
    np.savetxt(long, np.column_stack([t, 0 * t, 0 * t]), delimiter=",", header="x_mm,y_mm,z_mm", comments="")
    assert solve(long, "--frames", 2, "--out", tmp_path / "out") == 2
    assert "170.00 mm long and the robot reaches 150.00" in capsys.readouterr().err
    for end, last in (("start", 170), ("end", 150)):
        assert solve(long, "--frames", 2, "--trim", end, "--no-figures", "--out", tmp_path / "out") == 0
        plan = Plan.load(tmp_path / "out" / "plan.npz")
        tip = (plan.target[-1, -1] - plan.to_robot[:3, 3]) @ plan.to_robot[:3, :3]
        assert tip == pytest.approx([last, 0, 0], abs=1e-3)


def test_options_of_files_go_with_the_files_among_several_problems(tmp_path):
    t = np.linspace(0, 170, 60)
    long = tmp_path / "long.csv"
    np.savetxt(long, np.column_stack([t, 0 * t, 0 * t]), delimiter=",", header="x_mm,y_mm,z_mm", comments="")
    given = Namespace(robot=None, frames=2, duration=1.0, trim="end")
    assert [max(problem.target.lengths) for problem in load_all(["arc", str(long)], given)] == pytest.approx(
        [150, 150]
    )
    with pytest.raises(OptionError, match="--trim goes with a centreline file or a mask; arc is a named problem"):
        load_all(["arc", "cos"], given)


def test_reverse_follows_the_path_from_its_last_point(tmp_path, straight):
    assert solve(straight, "--frames", 2, "--reverse", "--no-figures", "--out", tmp_path / "out") == 0
    plan = Plan.load(tmp_path / "out" / "plan.npz")
    origin = -plan.to_robot[:3, :3].T @ plan.to_robot[:3, 3]
    assert origin == pytest.approx([140, 5 * (1 - np.cos(2.8)), 0], abs=1e-6)


def test_smoothing_is_bounded_and_reported(tmp_path, straight, capsys):
    assert solve(straight, "--frames", 2, "--smoothing", "0.5", "--no-figures", "--out", tmp_path / "out") == 0
    deviation = json.loads((tmp_path / "out" / "summary.json").read_text())["smoothing_deviation"]
    assert 0 < deviation <= 0.5 + 1e-4
    assert "smoothing moved the path" in capsys.readouterr().err


def test_robot_file_start_and_locked_tilt(tmp_path):
    start = tmp_path / "q.json"
    start.write_text(json.dumps({"alpha": [0, 0, 0], "beta": [0, 0, 5], "theta": [0, 0]}))
    arguments = ["--robot", ROOT / "examples" / "robot.toml", "--start", start, "--lock-tilt", "--frames", 20]
    assert solve("cos", *arguments, "--no-figures", "--out", tmp_path / "out") == 0
    plan = Plan.load(tmp_path / "out" / "plan.npz")
    assert np.abs(plan.theta).max() == 0
    assert abs(plan.beta[0, 2] - 5) <= 90 * plan.dt + 1e-6


def test_failed_frames_make_exit_status_1(tmp_path, monkeypatch, capsys):
    solved = NlpFrames.step

    def step(self, frame, before):
        result = solved(self, frame, before)
        return type(result)(before.q, success=False, status="made to fail") if frame == 1 else result

    monkeypatch.setattr(NlpFrames, "step", step)
    monkeypatch.setattr(NlpFrames, "_compiled_frames", None)
    out = tmp_path / "out"
    assert solve("arc", "--frames", 3, "--direction", "forward", "--no-figures", "--out", out) == 1
    assert json.loads((out / "summary.json").read_text())["failed"] == 1
    assert "frame 2 not solved: made to fail" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "failed"),
    [
        (("--contact-weight", 0.05, "--contact-allowed", 0.5), ["within_wall"]),
        (("--contact-weight", 0, "--contact-allowed", 0.5), ["within_wall"]),
        (("--contact-weight", 0.05, "--arrival-tolerance", 0.5), ["arrives"]),
        (("--contact-weight", 0.05, "--error-allowed", 0.5), ["follows"]),
        (("--contact-weight", 0.05), []),
    ],
)
def test_a_plan_that_misses_its_end_or_leaves_its_lumen_is_exit_status_1(
    options, failed, tmp_path, capsys, monkeypatch
):
    """Though all frames are solved, and nobody looked on the elastic model."""
    monkeypatch.setattr(terminal_output, "PIPED_TABLE_WIDTH", 200)  # so that cells are not broken
    given = "bronchus", "--frames", 20, *options, "--no-figures", "--out", tmp_path / "out"
    assert solve(*given) == bool(failed)
    found = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert found["failed"] == 0
    assert [name for name, verdict in found["verdicts"].items() if verdict["word"] == "no"] == failed
    assert found["verdicts"]["stable"]["word"] == "NOT CHECKED"
    printed = " ".join(capsys.readouterr().out.split())
    assert all(found["verdicts"][name]["value"] in printed for name in failed)


def test_a_dominant_plan_is_looked_at_on_the_elastic_model_by_itself(tmp_path, capsys):
    """The first command of the README before: green then, and on the elastic model it snaps."""
    out = tmp_path / "out"
    given = ["bronchus", "--frames", "50", "--model", "dominant", "--no-figures", "--out", str(out)]
    assert solve_horizon([*given, "--samples", "20"]) == 1
    plan = Plan.load(out / "plan.npz")
    assert (plan.meta["model"], plan.evaluated_model_name, len(plan.drawn)) == ("dominant", "elastic", 20)
    failed = {"arrives", "follows", "stable", "within the wall", "holds on built robots"}
    assert failed <= set(plan.verdicts.failed_names)
    assert plan.verdicts.unchecked_names == ()
    assert "judged on the elastic model" in capsys.readouterr().out


def test_without_evaluation_nothing_reads_yes_that_needs_it(tmp_path, capsys):
    out = tmp_path / "out"
    assert solve("arc", "--frames", 4, "--no-figures", "--out", out) == 0
    found = json.loads((out / "summary.json").read_text())["verdicts"]
    unchecked = {name for name, verdict in found.items() if verdict["word"] == "NOT CHECKED"}
    assert unchecked == {"arrives", "follows", "stable", "within_wall", "holds"}
    assert "This plan passes 2 of 7 checks. Not checked: arrives, follows," in capsys.readouterr().out


def test_a_u_turn_is_never_called_good(shared_data, tmp_path):
    """No such robot can follow it: its tip is 44 mm off."""
    path = shared_data / "cases" / "uturn.csv"
    given = [str(path), "--model", "dominant", "--frames", "20", "--no-figures", "--out", str(tmp_path / "out")]
    assert solve_horizon([*given, "--samples", "5"]) == 1
    found = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert found["verdicts"]["arrives"]["word"] == found["verdicts"]["follows"]["word"] == "no"
    assert found["tip_last"] > 20


def test_folders_of_different_requests_differ(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = ["arc", "--frames", "2", "--model", "dominant", "--no-figures"]
    for more in ([], ["--retract"], ["--lock-tilt"], ["--robot", str(ROOT / "examples" / "robot.toml")]):
        assert solve_horizon([*UNJUDGED, *given, *more]) == 0
    names = {path.name for path in (tmp_path / "runs").iterdir()}
    plain = "arc-horizon-dominant"
    assert names == {plain, "arc-retraction-horizon-dominant", f"{plain}-locked-tilt", f"{plain}-on-robot"}


def test_ctrl_c_writes_what_was_solved_and_exits_with_130(tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "ctr_nlp", "steer", "cos", "--frames", "1500"]
    command += ["--model", "dominant"]
    command += ["--solver", "ipopt", "--no-figures", "--out", out]
    for seconds in (3, 6, 12):  # a busy machine may not have begun to solve so early
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        time.sleep(seconds)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=120)
        assert process.returncode == 130, errors
        if "nothing was written" not in errors:
            break
    assert f"wrote {out / 'interrupted'}" in output.replace("\n", "")
    assert [path.name for path in out.iterdir()] == ["interrupted"]
    assert json.loads((out / "interrupted" / "summary.json").read_text())["interrupted"]
    plan = Plan.load(out / "interrupted" / "plan.npz")
    assert plan.success.any()


def test_comparison_prints_every_variant_and_writes_three_files(tmp_path, capsys):
    out = tmp_path / "out"
    variants = ["joint:ipopt", "paper-two-stage", "tip-jacobian"]
    arguments = ["arc", "line", "--variants", *variants, "--frames", "3", "--out", str(out)]
    assert compare_solvers(arguments) == 1, "on the elastic model these plans fail"
    printed, _ = capsys.readouterr()
    assert all(variant in printed for variant in variants)
    rows = json.loads((out / "comparison.json").read_text())
    assert [(row["problem"], row["variant"]) for row in rows] == [
        (p, v) for p in ("arc", "line") for v in variants
    ]
    tables = re.split("e3 in mm on the .* model:|Mean e3 in mm|Everything:", (out / "comparison.md").read_text())[
        1:
    ]
    lines = [[line for line in table.splitlines() if "|" in line] for table in tables]
    assert [len(table) for table in lines] == [2 + 2, 2 + 2, 2 + 2, 2 + len(rows)]
    assert all(len({line.count("|") for line in table}) == 1 for table in lines)
    assert all("| line | " in table[-1] for table in lines[:2])
    for half, published in zip(lines, ("| 7.46 | 7.58 |", "| 9.91 | 11.2 |"), strict=False):
        assert half[-1].endswith(published)
    with open(out / "comparison.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(rows)


def test_the_example_files_go_together(tmp_path):
    files = (ROOT / "examples" / "synthetic_airway.csv", "--robot", ROOT / "examples" / "robot.toml")
    fitting = "--frames", 10, "--trim", "start", "--no-figures"
    assert solve(*files, *fitting, "--out", tmp_path / "out") == 0
    assert solve(*files, "--frames", 10, "--out", tmp_path / "other") == 2


def test_plans_need_not_be_simulated_and_a_negative_number_is_refused_before_anything_is_solved(tmp_path, capsys):
    asked = ["arc", "--model", "dominant", "--formulation", "joint", "--frames", "3", "--no-figures"]
    assert solve_horizon([*asked, "--samples", "0", "--out", str(tmp_path / "out")]) in (0, 1)
    assert Plan.load(tmp_path / "out" / "plan.npz").verdicts.holds.word == "NOT CHECKED"
    with pytest.raises(SystemExit, match="2"):
        solve_horizon([*asked, "--samples", "-1", "--out", str(tmp_path / "other")])
    assert "--samples: -1 is negative; it must be 0 or more" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()
