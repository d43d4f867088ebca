"""Configurations from other programs: the plan that they make, and what is said of bad ones."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from scipy.io import savemat

from ctr_nlp import Plan, Problem, curve_from_formula, growing, shapes, table_i_robot
from ctr_nlp.cli.exchange.configurations import main
from ctr_nlp.exceptions import OptionError
from ctr_nlp.view.exchange.configurations import plan_through, read_configurations
from ctr_nlp.view.exchange.mat import encode_mat

FRAMES = 4
HEADER = [
    *("alpha_1_rad", "alpha_2_rad", "alpha_3_rad", "beta_1_mm", "beta_2_mm", "beta_3_mm"),
    *("theta_x_rad", "theta_y_rad"),
]


@pytest.fixture(scope="module")
def q():
    t = np.linspace(0.25, 1.0, FRAMES)
    return np.column_stack([0.3 * t, -0.2 * t, 9 + t, 20 * t, 20 + 30 * t, 40 + 60 * t, 0.1 * t, -0.2 * t])


@pytest.fixture(scope="module")
def problem():
    curve = curve_from_formula(lambda u: (0.001 * u**2, 0.0, u), 0.0, 100.0)
    return Problem("parabola", table_i_robot(), growing(curve, FRAMES), duration=2.0)


def table(path, header, rows):
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def test_both_kinds_of_file_are_read_whatever_the_order_of_columns(q, tmp_path):
    savemat(tmp_path / "q.mat", {"q": q, "time": 0.5 * np.arange(1, FRAMES + 1)})
    order = [7, 2, 0, 4, 3, 5, 1, 6]
    table(tmp_path / "q.csv", [HEADER[k] for k in order], q[:, order].tolist())
    assert np.array_equal(read_configurations(tmp_path / "q.mat").q, q)
    assert read_configurations(tmp_path / "q.mat").duration == pytest.approx(0.5 * FRAMES)
    assert np.array_equal(read_configurations(tmp_path / "q.csv").q, q)
    assert read_configurations(tmp_path / "q.csv").duration is None


@pytest.mark.interpreted
@pytest.mark.parametrize("model", ["dominant", "elastic"])
def test_a_plan_is_that_of_the_robot_moved_through_them(problem, q, model, tmp_path):
    plan = plan_through(problem, q, model, "q.mat")
    assert np.array_equal(plan.q, q)
    assert (plan.meta["formulation"], plan.meta["model"], plan.options["source"]) == (
        "configurations",
        model,
        "q.mat",
    )
    assert np.abs(plan_through(problem, q, model="dominant").shape - shapes(problem.robot, q)).max() < 1e-9
    assert np.isfinite(plan.stability).all() == (model == "elastic")
    assert plan.verdicts.solved.word == "NOT CHECKED"
    plan.save(tmp_path / "plan.npz")
    assert Plan.load(tmp_path / "plan.npz").verdicts == plan.verdicts


def test_limits_are_left_to_the_verdicts(problem, q):
    beyond = q + np.array([0, 0, 0, 40.0, 0, 0, 0, 0]) * (np.arange(FRAMES) == FRAMES - 1)[:, None]
    beyond[-1, 4] = 65.0
    assert plan_through(problem, beyond, model="dominant").verdicts.within_limits.word == "no"
    assert plan_through(problem, q, model="dominant").verdicts.within_limits.word == "yes"


def changed(q, frame, column, value):
    q = q.copy()
    q[frame - 1, column] = value
    return q


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda q: q.T, r"q has shape \(8, 4\); .* must be \(4, 8\), alpha_1_rad, .*; it seems to be transposed"),
        (lambda q: q[:, :7], r"q has shape \(4, 7\); for 4 frames of a robot of 3 tubes it must be \(4, 8\)"),
        (lambda q: changed(q, 2, 1, np.nan), "alpha_2 in frame 2 is nan; it must be finite"),
        (
            lambda q: changed(q, 3, 4, -152.0),
            r"beta_2 in frame 3 is -152 mm; it must lie in \[0, 202\]; is it the pos",
        ),
        (
            lambda q: changed(q, 3, 5, 85000.0),
            r"beta_3 in frame 3 is 85000 mm; .* did you mean 85 mm \(85000 µm\)",
        ),
        (
            lambda q: changed(q, 1, 3, 30.0),
            "beta_1 in frame 1 is 30 mm and exceeds beta_2, 27.5 mm; tube 1 is the ou",
        ),
        (
            lambda q: changed(q, 4, 7, 30.0),
            r"theta_y in frame 4 is 30 rad; .* did you mean 0.5236 rad \(30 degrees\)",
        ),
        (lambda q: q * [1, 1, 1, 1e-3, 1e-3, 1e-3, 1, 1], "beta is at most 0.1 mm .* are these in metres"),
        (lambda q: q * [1, 1, 1, 0, 0, 0, 1, 1], "beta_3 in frame 1 is 0 mm; something of the robot must be out"),
        (lambda q: "no numbers", "q holds .*; it must be numbers"),
    ],
)
def test_configurations_that_cannot_be_are_refused(problem, q, change, told):
    with pytest.raises(OptionError, match=told):
        plan_through(problem, change(q), model="dominant")


@pytest.mark.parametrize(
    ("header", "told"),
    [
        (
            ["alpha_1_deg", *HEADER[1:]],
            "it has a column 'alpha_1_deg'; it must be named alpha_1_rad, and be in that",
        ),
        (["alpha_1", *HEADER[1:]], "it has a column 'alpha_1'; it must be named alpha_1_rad"),
        (["gamma", *HEADER[1:]], "it has a column 'gamma', which is unknown; known are alpha_1_rad"),
        (HEADER[:6] + HEADER[7:], "it has no column theta_x_rad"),
        ([*HEADER, "theta_x_rad"], "it has the column 'theta_x_rad' twice"),
        (HEADER[:5], "it has no column beta_3_mm"),
    ],
)
def test_headers_that_cannot_be_are_refused(header, told, tmp_path):
    with pytest.raises(OptionError, match=f"q.csv: {told}"):
        read_configurations(table(tmp_path / "q.csv", header, [[1.0] * len(header)]))


@pytest.mark.parametrize(
    ("name", "held", "told"),
    [
        ("q.txt", b"", "its name must end in .mat or .csv"),
        ("q.mat", b"nothing of MATLAB's, but longer than a header" * 9, "it is damaged, or no file of MATLAB"),
        ("q.csv", b"\xff\xfe", "it is no table"),
        ("q.csv", b"", "it holds no rows"),
        ("q.csv", (",".join(HEADER) + "\n1,2\n").encode(), "line 2 has 2 cells; the header has 8"),
        ("q.csv", (",".join(HEADER) + "\n1,2,3,4,5,6,7,x\n").encode(), "theta_y_rad in line 2 is 'x'"),
    ],
)
def test_files_that_cannot_be_read_are_refused(name, held, told, tmp_path):
    (tmp_path / name).write_bytes(held)
    with pytest.raises(OptionError, match=told):
        read_configurations(tmp_path / name)


@pytest.mark.parametrize(
    ("variables", "told"),
    [
        ({"Q": np.ones((4, 8))}, r"it has no variable q, only Q; it must have q, \(T, 2d \+ 2\)"),
        ({"q": np.ones((4, 7))}, r"q has shape \(4, 7\); it must be \(T, 2d \+ 2\)"),
        (
            {"q": np.ones((4, 8)), "time": np.arange(4.0)},
            "time runs from 0 to 3 s; frames must be even steps apart",
        ),
        ({"q": np.ones((4, 8)), "time": np.ones(3)}, r"time has shape \(3,\)"),
    ],
)
def test_variables_that_cannot_be_are_refused(variables, told, tmp_path):
    savemat(tmp_path / "q.mat", variables)
    with pytest.raises(OptionError, match=told):
        read_configurations(tmp_path / "q.mat")


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(OptionError, match=r"none.mat cannot be read: .*No such file"):
        read_configurations(tmp_path / "none.mat")


def test_an_exported_plan_comes_back(problem, q, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.toml").write_text(table_i_robot().to_toml())
    first = plan_through(problem, q, model="dominant")
    (tmp_path / "plan.mat").write_bytes(encode_mat(first))
    call = ["plan.mat", "--problem", "line", "--robot", "robot.toml", "--model", "dominant", "--no-figures"]
    call += ["--out", "again"]
    assert main(call) in (0, 1)
    again = Plan.load("again/plan.npz")
    assert np.array_equal(again.q, q)
    assert again.time == pytest.approx(first.time)
    assert again.meta["problem"]["name"] == "line"
    assert json.loads((tmp_path / "again" / "summary.json").read_text())["frames"] == FRAMES
    assert "wrote again" in capsys.readouterr().out
