"""What commands suggest to do next, and where a page goes that nobody named a place for."""

import json

import numpy as np
import pytest
from common import UNJUDGED, named_problem
from PIL import Image

from ctr_nlp import Problem, curve_from_points, growing, problem_from_file, solve_per_frame, table_i_robot
from ctr_nlp.cli.commands import branches, report
from ctr_nlp.cli.commands.plan import _write_nominal_plan, steer
from ctr_nlp.cli.studies.reach import _read_robots
from ctr_nlp.exceptions import ProblemError

QUICK = [*UNJUDGED, "--model", "dominant", "--frames", "3", "--no-figures"]


@pytest.fixture
def made(tmp_path, capsys):
    """The folder of a plan that the program wrote, and what it printed."""
    out = tmp_path / "a plan"
    assert steer(["arc", *QUICK, "--out", str(out)]) == 0
    return out, capsys.readouterr().out


def test_a_plan_is_followed_by_its_page_and_its_check(made):
    out, printed = made
    assert f"next, a page on which the robot moves: ctr-nlp report '{out / 'plan.npz'}'\n" in printed
    assert f"next, an independent check: ctr-nlp check '{out / 'plan.npz'}'\n" in printed
    assert "ctr-nlp play" not in printed  # this plan was not judged


def test_the_nominal_plan_is_filmed_while_the_robust_one_is_sought(tmp_path, capsys):
    plan = solve_per_frame(named_problem("arc", frames=3), model="dominant")
    _write_nominal_plan(plan, tmp_path / "out", figures=False, film=tmp_path / "motion.gif")
    place = tmp_path / "out" / "nominal"
    with Image.open(place / "motion.gif") as film:
        assert film.n_frames == 3
    printed = capsys.readouterr().out
    assert f"wrote {place}: errors.csv, motion.gif, plan.npz, summary.json" in printed
    assert "now planning for all robots within the tolerances" in printed
    assert not (tmp_path / "motion.gif").exists()  # that of the robust plan


def test_json_has_no_suggestions(tmp_path, capsys):
    assert steer(["arc", *QUICK, "--json", "--out", str(tmp_path / "out")]) == 0
    assert not [line for line in json.loads(capsys.readouterr().out)["lines"] if line.startswith("next")]


@pytest.mark.parametrize(("count", "more"), [(1, ""), (2, " --branch NUMBER")])
def test_branches_are_followed_by_a_plan(count, more, tmp_path, capsys):
    curves = [
        {"type": "Curve", "controlPoints": [{"position": [k * t, 5 * k * t, t]} for t in range(0, 60, 10)]}
        for k in range(count)
    ]
    file = tmp_path / "tree.mrk.json"
    units = {"coordinateSystem": "LPS", "coordinateUnits": "mm"}
    file.write_text(json.dumps({"markups": [curve | units for curve in curves]}))
    assert branches.main([str(file)]) == 0
    assert f"next, a plan to the tip of a branch: ctr-nlp plan {file}{more}\n" in capsys.readouterr().out


def test_the_page_of_a_plan_lies_beside_it(made, monkeypatch, tmp_path, capsys):
    pytest.importorskip("k3d", reason='needs k3d: pip install "ctr_nlp[report]"')
    monkeypatch.setattr(report, "page", lambda *_: "a page")
    monkeypatch.chdir(tmp_path)
    plan = made[0] / "plan.npz"
    assert report.main([str(plan)]) == 0
    assert f"wrote {made[0] / 'report.html'}" in capsys.readouterr().out.replace("\n", "")
    assert report.main([str(plan), str(plan)]) == 0
    assert (tmp_path / "runs" / "report" / "report.html").is_file()
    # A plan that came by mail, say: its folder is the user's.
    (tmp_path / "mine").mkdir()
    own = tmp_path / "mine" / "plan.npz"
    own.write_bytes(plan.read_bytes())
    assert report.main([str(own)]) == 0
    assert [path.name for path in own.parent.iterdir()] == ["plan.npz"]


@pytest.mark.parametrize("suffix", ["pdf", "svg"])
def test_figures_for_print_lie_beside_the_page(made, monkeypatch, tmp_path, capsys, suffix):
    monkeypatch.setattr(report, "page", lambda *_: "a page")
    plan, out = made[0] / "plan.npz", tmp_path / "out"
    assert report.main([str(plan), "--figures", suffix, "--out", str(out)]) == 0
    drawn = {path.stem for path in out.glob(f"*.{suffix}")}
    assert {"shapes", "errors", "by_frame", "configuration"} <= drawn
    assert f"shapes.{suffix}" in capsys.readouterr().out
    assert report.main([str(plan), "--out", str(out)]) == 0
    assert not list(out.glob(f"*.{suffix}"))


def test_figures_for_print_are_those_of_one_plan(made, tmp_path, capsys):
    plan = str(made[0] / "plan.npz")
    assert report.main([plan, plan, "--figures", "pdf", "--out", str(tmp_path / "out")]) == 2
    assert "--figures goes with one plan, and 2 were given" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_new_plan_removes_the_page_of_the_old_one(made, monkeypatch):
    monkeypatch.setattr(report, "page", lambda *_: "a page")
    out = made[0]
    assert report.main([str(out / "plan.npz")]) == 0
    assert (out / "report.html").is_file()
    assert steer(["arc", *QUICK, "--out", str(out)]) == 0
    assert not (out / "report.html").exists()


def test_only_paths_of_files_are_offered_a_trim(tmp_path):
    points = np.column_stack([np.zeros(60), np.zeros(60), np.linspace(0, 170, 60)])
    with pytest.raises(ProblemError, match=r"reaches 150\.00 mm .*; choose a longer robot or a shorter path"):
        Problem("long", table_i_robot(), growing(curve_from_points(points), 2))
    file = tmp_path / "long.csv"
    np.savetxt(file, points, delimiter=",", header="x_mm,y_mm,z_mm", comments="")
    with pytest.raises(ProblemError, match=r"--trim start moves the robot.s base 20\.0 mm inwards"):
        problem_from_file(file, table_i_robot(), frames=2)


def test_without_robots_a_tree_is_tried_with_those_of_the_package(capsys):
    robots = _read_robots(None)
    assert len(robots) > 1
    assert f"robots: {', '.join(robots)}, which come with the package" in capsys.readouterr().out


def test_a_plan_that_fails_within_an_anatomy_is_followed_by_a_comparison_of_robots(tmp_path, capsys):
    u = np.linspace(0.0, 60.0, 31)
    file = tmp_path / "a bend.csv"
    rows = np.stack([15 * (1 - np.cos(u / 15)), 0 * u, 15 * np.sin(u / 15), np.full(31, 2.0)], axis=1)
    np.savetxt(file, rows, delimiter=",", header="x_mm,y_mm,z_mm,radius_mm", comments="")
    told = ["--robot", "stock_1", "--smoothing", "0.5", "--out", str(tmp_path / "out")]
    assert steer([str(file), "--model", "dominant", "--frames", "3", "--no-figures", *told]) == 1
    printed = capsys.readouterr().out
    words = f"ctr-nlp choose '{file}' --smoothing 0.5"
    assert f"next, which robots of the package reach this end: {words}\n" in printed
