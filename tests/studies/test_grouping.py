"""Rows of a study by a column: tables, the worst plans, failures and the picture."""

from __future__ import annotations

import numpy as np
import pytest

from ctr_nlp.exceptions import OptionError

pytest.importorskip("pyarrow", reason="the extra `study` is not installed")

from ctr_nlp.studies.grid.case import CASE_DONE, CASE_FAILED
from ctr_nlp.studies.grid.groups import LISTED_WORST_PLANS, group_rows
from ctr_nlp.studies.grid.picture import draw_groups, pareto_optimal
from ctr_nlp.studies.grid.results import Results


def row(number, margin, e3, **more):
    """Of a plan."""
    told = {"digest": f"d{number}", "problem": "arc", "robot_name": "own", "set_margin": margin, "e3": e3}
    return told | {"status": CASE_DONE, "reason": "", "complete": True, "lost": 1.0 - margin} | more


def failure(number, margin, reason):
    """A row without a plan."""
    told = row(number, margin, None) | {"status": CASE_FAILED, "reason": reason}
    return {name: value for name, value in told.items() if name not in ("e3", "complete", "lost")}


@pytest.fixture
def results(tmp_path):
    """Rows in several files, which do not have the same columns."""
    kept = Results(tmp_path)
    kept.add([row(k, 0.1, 1.0 + k) for k in range(6)])
    kept.add([row(6, 0.05, 9.0), row(7, 10.0, 0.5), failure(8, 0.1, "no start"), failure(9, 0.1, "no start")])
    return kept


def test_groups_stand_in_order_with_their_values(results):
    found = group_rows(results, {f"d{k}" for k in range(10)}, "set_margin", ["e3", "lost"])
    assert [(group.name, group.plans, group.failed) for group in found.groups] == [
        ("0.05", 1, 0),
        ("0.1", 8, 2),
        ("10.0", 1, 0),
    ]
    np.testing.assert_allclose(sorted(found.groups[1].column_values("e3")), np.arange(1.0, 7.0))
    assert found.groups[1].quantile("e3", 0.5) == 3.5
    assert np.isnan(found.groups[1].quantile("nothing", 0.5))
    assert [(bad.error, bad.digest) for bad in found.worst] == [
        (9.0, "d6"),
        *((6.0 - k, f"d{5 - k}") for k in range(4)),
    ]
    assert len(found.worst) == LISTED_WORST_PLANS
    assert [(each.reason, each.plans) for each in found.failures] == [("no start", 2)]
    assert not found.complete


def test_only_rows_of_the_study_count(results):
    found = group_rows(results, {"d0", "d7", "other"}, "set_margin", ["e3"])
    assert [group.name for group in found.groups] == ["0.1", "10.0"]
    assert found.complete
    with pytest.raises(OptionError, match="holds no rows of this study"):
        group_rows(results, {"other"}, "set_margin", ["e3"])
    with pytest.raises(OptionError, match="colour is no column of the study; those are complete, digest"):
        group_rows(results, {"d0"}, "colour", ["e3"])
    with pytest.raises(OptionError, match="holds no rows of a study"):
        group_rows(Results(results.folder / "none"), {"d0"}, "problem", ["e3"])


def test_the_best_are_those_that_no_other_is_below_in_both():
    medians = np.array([[0.0, 3.0], [1.0, 1.0], [2.0, 2.0], [0.0, 4.0], [np.nan, 0.0]])
    assert pareto_optimal(medians).tolist() == [True, True, False, False, False]


def test_pictures_show_every_group_and_what_they_are_weighed_against(results):
    found = group_rows(results, {f"d{k}" for k in range(10)}, "set_margin", ["e3", "lost"])
    left, right = draw_groups(found, "e3", "lost").axes
    assert [label.get_text() for label in left.get_yticklabels()] == ["0.05", "0.1", "10.0"]
    assert (left.get_xlabel(), right.get_xlabel(), right.get_ylabel()) == ("e3 (mm)", "lost", "e3 (mm)")
    assert len(draw_groups(found, "e3").axes) == 1
