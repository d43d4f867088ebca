"""How plans of airways survive: what the study measures, what it keeps when it is stopped, and what it says."""

import csv
import os
import signal

import numpy as np
import pytest

from ctr_nlp.cli.studies.survival import main
from ctr_nlp.exceptions import OptionError
from ctr_nlp.studies.clearance.cases import problem_of
from ctr_nlp.studies.survival import Airway, cases
from ctr_nlp.studies.survival.cases import FIRST_SEED, read_rows, write_rows
from ctr_nlp.studies.survival.distributions import distributions
from ctr_nlp.studies.survival.report import findings, page
from ctr_nlp.studies.trade import MARGINS, Traded, traded

FILES = ["survival.csv", "survival.md", "survival.pdf", "survival.png"]


def airway(seed, means, losses, robust=(1.2, 0), solved=True):
    """Of made-up plans with these mean errors, mm, and draws lost of 100."""
    each = zip(MARGINS, means, losses, strict=True)
    plans = [Traded(f"synthetic {seed}", 0.0, margin, 1.0, mean, lost, 100, True) for margin, mean, lost in each]
    return Airway(seed, 100, tuple(plans), Traded(f"synthetic {seed}", 1.0, 0.1, 1.1, *robust, 100, solved))


CLEAR = airway(0, (8.0, 4.0, 2.0, 1.9), (60, 30, 0, 0))
CLOSE = airway(1, (8.0, 1.5, 1.1, None), (60, 1, 2, 100), (1.2, 1), solved=False)


def test_the_best_margin_loses_fewest_then_errs_least():
    assert (CLEAR.plain.margin, CLEAR.best.margin, CLOSE.best.margin) == (0.1, 0.7, 0.3)


def test_findings_tell_where_robust_plans_are_worse():
    told = " ".join(findings([CLEAR, CLOSE]))
    assert "plain: 120 of 200 draws are lost, at most 1% in 0 of 2 airways" in told
    assert "best margin: 1 of 200 draws" in told
    assert "robust: 1 of 200 draws are lost, at most 1% in 2 of 2" in told
    assert "lose no more draws than any margin in 2 of 2 airways, and have no larger mean e3 than any in 1" in told
    assert "not solved: plans of synthetic 1" in told
    rows = [line for line in page([CLEAR, CLOSE]).splitlines() if line.startswith("| robust |")]
    assert rows[0] == "| robust | 1.20 | 1.20 | 1.20 | 1.20 | 1.20 | 1.20 |"
    assert rows[1] == "| robust | 0.0% | 0.2% | 0.5% | 0.8% | 1.0% | 0.5% |"
    assert len(distributions([CLEAR, CLOSE]).axes) == 2


def test_a_table_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "survival.csv"
    write_rows([CLEAR, CLOSE], path)
    assert read_rows(path, 100, 100) == [CLEAR, CLOSE]
    assert read_rows(tmp_path / "none.csv", 100, 100) == []
    with pytest.raises(OptionError, match="100 frames and 100 draws, not 50 and 100"):
        read_rows(path, 50, 100)
    path.write_text("airway,frames,draws\n1,100,100\n")
    with pytest.raises(OptionError, match="not a table of this study"):
        read_rows(path, 100, 100)


def test_a_study_goes_on_where_it_was_stopped(tmp_path, capsys, monkeypatch):
    """Ctrl-C after the second of three airways: two are kept, and the next run plans the third alone."""
    planned = []

    def measured(seed, frames, draws):
        planned.append(seed)
        if len(planned) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return airway(seed, (8.0, 4.0, 2.0, 1.9), (60, 30, 0, 0))

    monkeypatch.setattr(cases, "measured", measured)
    given = ["--seeds", "3", "--out", str(tmp_path / "out")]
    assert main(given) == 130
    with (tmp_path / "out" / "survival.csv").open() as file:
        assert [row["airway"] for row in csv.DictReader(file)] == ["0"] * 5 + ["1"] * 5
    assert main(given) == 0
    assert planned == [0, 1, 2]
    assert sorted(path.name for path in (tmp_path / "out").glob("survival.*")) == FILES
    assert "robust: 0 of 300 draws" in capsys.readouterr().out
    assert main([*given, "--draws", "50"]) == 2


def test_plans_of_an_airway_are_those_of_the_trade(tmp_path):
    assert main(["--seeds", "1", "--frames", "6", "--draws", "10", "--out", str(tmp_path)]) == 0
    (found,) = read_rows(tmp_path / "survival.csv", 6, 10)
    assert [plan.margin for plan in found.margins] == list(MARGINS)
    (known,) = traded(problem_of(0, 6), (), (0.5,), 10, FIRST_SEED)
    np.testing.assert_allclose(found.margins[2].mean, known.mean, rtol=1e-9)
    assert found.robust.amount == 1
    assert found.robust.lost == 0


@pytest.mark.parametrize("wrong", [("--seeds", "0"), ("--draws", "0"), ("--jobs", "0"), ("--frames", "1")])
def test_bad_input_is_refused(wrong, tmp_path, capsys):
    assert main([*wrong, "--out", str(tmp_path / "out")]) == 2
    assert wrong[0][2:] in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
