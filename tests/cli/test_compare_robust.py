"""Robust variants beside others, and what becomes of elastic ones on draws."""

import json

import pytest
from compare import main as compare
from methods.comparison import ROBUST_VARIANTS, available_variants

from ctr_nlp import Problem
from ctr_nlp.cli.problems import from_python
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.problems import named_problem

BEND = '''"""A bend in space that two tubes cannot follow exactly; many draws snap on the best plan for it."""

import casadi as ca

from ctr_nlp import Problem, Robot, Tube, curve_from_formula, growing


def problem(frames=8, duration=4.0, robot=None):
    robot = robot or Robot((Tube(90, 45, (0.01, 0.025), 4.0, 3.2), Tube(110, 80, 0.02, 2.6, 1.6)))
    path = curve_from_formula(lambda u: (12 * (1 - ca.cos(u / 40)), 4 * ca.sin(u / 60), u), 0.0, 70.0)
    return Problem("bend", robot, growing(path, frames), duration)
'''


def check_comparison(folder, given: str, plain_problem: Problem, frames: int, solver: str) -> None:
    """Robust plans lose fewer of 200 draws than a plain elastic one, and pay for that on the robot described."""
    variants = [f"horizon:{solver}:elastic", "joint:ipopt", *ROBUST_VARIANTS]
    out = folder / "out"
    assert compare([given, "--frames", str(frames), "--variants", *variants, "--out", str(out)]) == 1
    plain, dominant, *robust = json.loads((out / "comparison.json").read_text())
    plainly = Settings(arrival_weight=0.0)  # comparisons are of the paper's objective
    drawn = solve_horizon(plain_problem, solver=solver, model="elastic", settings=plainly).robustness()
    assert plain["draws"] == 200
    assert plain["draws_e3"] == pytest.approx(drawn.errors.mean, rel=1e-3)
    assert plain["draws_lost"] == pytest.approx(drawn.lost_share, abs=0.01)
    assert dominant["draws"] == 200, "also looked at on the elastic model"
    for row in robust:
        assert row["draws_lost"] <= 0.01 < plain["draws_lost"]
        assert row["e3"] < row["draws_e3"] < plain["draws_e3"]
        assert row["failed"] == 0
    page = (out / "comparison.md").read_text()
    name = plain_problem.name
    line = next(line for line in page.split("the share lost:")[1].splitlines() if line.startswith(f"| {name} |"))
    assert line.count("%") == 4


@pytest.mark.slow
def test_elastic_variants_are_tried_on_draws_and_robust_ones_lose_few(tmp_path, capsys):
    file = tmp_path / "bend.py"
    file.write_text(BEND)
    check_comparison(tmp_path, str(file), from_python(str(file), 8, 4.0, None), 8, "ipopt")
    assert "robust-horizon" in capsys.readouterr().out


@pytest.mark.slow
def test_so_they_do_with_three_tubes_along_a_wave(tmp_path):
    check_comparison(tmp_path, "cos", named_problem("cos", 20), 20, "banded")


def test_robust_variants_are_asked_for_by_name():
    assert not ROBUST_VARIANTS.keys() & set(available_variants())
