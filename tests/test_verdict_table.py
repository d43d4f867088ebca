"""The library's verdicts beside those of a judge that shares no code with it."""

import pytest
from independent_judge import NO, NOT_CHECKED, YES
from verdict_plans import (
    DESIGNED,
    NOT_COVERED_AFTER_SNAPS,
    OWN,
    VERDICTS,
    Case,
    agreement,
    cases,
    faults,
    page,
    planned,
    row_of,
    rows,
)

QUICK_FRAMES, QUICK_SAMPLES = 25, 20
AGREE_MM = 0.02
"""By how much shapes of the two models may differ."""


SAMPLE_TIP_MM = 0.05
"""By how much a simulated robot's distance from the target's end may differ: samples move in coarser steps."""


def checked_row(case, folder, data, frames=QUICK_FRAMES, samples=QUICK_SAMPLES):
    raw = planned(case, data, frames)
    checked, path = raw.check(samples, 0), folder / "plan.npz"
    checked.save(path)
    return row_of(case, raw, checked, path)


@pytest.mark.parametrize(
    ("name", "model"), [("arc", "elastic"), ("bronchus", "dominant"), ("bronchus", "elastic")]
)
def test_verdicts_of_short_plans_agree_with_judge(name, model, tmp_path):
    row = checked_row(Case(name, OWN, model), tmp_path, tmp_path)
    assert faults(row) == []
    assert row["differ_mm"] < AGREE_MM
    assert bool(row["snaps"]) == (row["samples"] == {})
    assert row["samples"].get("count", QUICK_SAMPLES) == QUICK_SAMPLES
    assert row["samples"].get("differ", 0) <= 1
    assert row["samples"].get("tip_differ_mm", 0.0) < SAMPLE_TIP_MM
    walled = NO, YES
    assert (row["library"]["within_wall"][0] in walled) == (name == "bronchus")
    assert "DISAGREE" not in page([row])


def test_words_may_differ_near_the_threshold_alone():
    row = {
        "case": ["p", OWN, "elastic"],
        "library": {name: [YES, 1.0] for name in VERDICTS},
        "judge": {name: [YES, 1.0, 1.0] for name in VERDICTS},
        "raw": dict.fromkeys(VERDICTS, NOT_CHECKED),
        "samples": {},
        "differ_mm": 0.0,
        "snaps": [],
    }
    assert faults(row) == []
    row["judge"]["arrives"] = [NO, 2.01, -0.01]
    assert agreement(row, "arrives") == "borderline"
    assert faults(row) == []
    row["judge"]["follows"] = [NO, 2.1, -0.1]
    row["judge"]["stable"] = [NOT_CHECKED, None, 0.0]
    row["raw"]["holds"] = YES
    assert [agreement(row, name) for name in ("follows", "stable")] == ["DISAGREE"] * 2
    assert len(faults(row)) == 3
    assert "DISAGREE" in page([row])


def test_judge_stops_at_a_snap():
    words = dict.fromkeys(NOT_COVERED_AFTER_SNAPS, NOT_CHECKED) | {"stable": NO}
    row = {
        "case": ["p", OWN, "elastic"],
        "library": {name: [NO, 9.0] for name in VERDICTS},
        "judge": {name: [words.get(name, NO), None, None] for name in VERDICTS},
        "raw": dict.fromkeys(VERDICTS, NOT_CHECKED),
        "samples": {},
        "differ_mm": 0.0,
        "snaps": [3],
    }
    assert faults(row) == []
    assert agreement(row, "stable") == "agree"
    assert {agreement(row, name) for name in NOT_COVERED_AFTER_SNAPS} == {"not covered"}
    assert "no 9.00 / not covered" in page([row])
    row["judge"]["stable"] = [NOT_CHECKED, None, None]
    assert len(faults(row)) == 1
    row["snaps"] = []
    assert len(faults(row)) == 5


def test_there_are_forty_plans():
    found = cases()
    assert len(set(found)) == 40
    assert {case.planned for case in found} == {"dominant", "elastic", "robust"}
    assert {case.robot for case in found} == {OWN, DESIGNED}


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_verdicts_of_forty_plans_agree_with_judge(case, shared_data, tmp_path):
    (row,) = rows(tmp_path, shared_data, [case])
    assert faults(row) == []
    assert row["differ_mm"] is None or row["differ_mm"] < AGREE_MM
    assert row["samples"].get("differ", 0) <= 0.02 * row["samples"].get("count", 0)
    assert row["samples"].get("tip_differ_mm", 0.0) < SAMPLE_TIP_MM
