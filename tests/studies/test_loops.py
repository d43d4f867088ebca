"""The study of closed loops: what it counts, on two robots."""

import pytest
from loops_of import made_plan

from ctr_nlp.studies.loops import CASES, looped


def test_feedback_is_told_beside_open_loop():
    plan = made_plan()
    first, again = (looped("made", plan, "tip and 5 points", 2, seed=1) for _ in range(2))
    assert (first.opened, first.closed, first.lost) == (again.opened, again.closed, again.lost)
    assert first.draws == 2
    assert first.kept == pytest.approx(first.closed)
    assert 0 < first.cycle <= first.slowest


def test_cases_measure_what_their_names_say():
    assert {name: len(case.sensors) for name, case in CASES.items()} == {
        "tip and 5 points": 18,
        "tip alone": 3,
        "with play": 18,
        "with bending": 18,
    }
