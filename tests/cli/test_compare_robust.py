"""Robust variants beside others, and what becomes of elastic ones on draws."""

import json

import pytest

from ctr_nlp.cli.studies.compare import main as compare
from ctr_nlp.problems import named
from ctr_nlp.steer import solve_horizon
from ctr_nlp.studies.comparison import ROBUST, variants_here


def test_elastic_variants_are_tried_on_draws_and_robust_ones_lose_few(tmp_path, capsys):
    variants = ["horizon:banded:elastic", "joint:sqp", *ROBUST]
    given = ["cos", "--frames", "20", "--variants", *variants, "--out", str(tmp_path / "out")]
    assert compare(given) == 0
    plain, dominant, *robust = json.loads((tmp_path / "out" / "comparison.json").read_text())
    drawn = solve_horizon(named("cos", 20), model="elastic").robustness()
    assert plain["draws"] == 200
    assert plain["draws_e3"] == pytest.approx(drawn.errors.mean, rel=1e-3)
    assert plain["draws_lost"] == pytest.approx(drawn.share, abs=0.01)
    assert dominant["draws"] is None
    for row in robust:
        assert row["draws_lost"] <= 0.01 < plain["draws_lost"]
        assert row["e3"] < row["draws_e3"] < plain["draws_e3"]
        assert row["failed"] == 0
    page = (tmp_path / "out" / "comparison.md").read_text()
    line = next(line for line in page.split("the share lost:")[1].splitlines() if line.startswith("| cos |"))
    assert line.count("%") == 3
    assert "robust-horizon" in capsys.readouterr().out


def test_robust_variants_are_asked_for_by_name():
    assert not ROBUST.keys() & set(variants_here())
