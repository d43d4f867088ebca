"""Reach of robots in a tree: outcomes, what binds, and plans that are kept."""

import math
from dataclasses import replace

import numpy as np
import pytest

import ctr_nlp as ctr
from ctr_nlp.anatomy.formats.vtk import write_vtk
from ctr_nlp.anatomy.lumen_tree import read_lumen_tree
from ctr_nlp.anatomy.reading import ReadOptions
from ctr_nlp.anatomy.synthetic_tree import synthetic_tree
from ctr_nlp.cli.terminal_output import print_table
from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.studies.reach.binding import find_binding
from ctr_nlp.studies.reach.cases import EndCase, TreeSource, bound_cases, end_cases
from ctr_nlp.studies.reach.outcomes import (
    MISSED,
    NARROW,
    NEARLY,
    UNENTERED,
    UNPLANNED,
    EndOutcome,
    best_outcome,
    count_outcomes,
    outcome_before_planning,
    outcome_of_plan,
)
from ctr_nlp.studies.reach.reach import Reach
from ctr_nlp.studies.reach.report import PAGE_NAME, TABLE_COLUMNS, table_row, totals, write
from ctr_nlp.studies.reached.cases import REACHED

pytest.importorskip("pyvista", reason='needs pyvista: pip install -e ".[anatomy]"')

THIN = ctr.Robot(
    (
        ctr.Tube(120, 60, 1 / 130, outer_diameter=2.4, inner_diameter=2.0),
        ctr.Tube(400, 150, 1 / 60, outer_diameter=1.6, inner_diameter=1.2),
    )
)
CHECKED = ("solved", "stable", "within_limits", "arrives", "within_wall", "holds")
BEFORE = EndOutcome(1, "thin", UNPLANNED, "", False, 0.0, 0.0, 0.0, 80.0, margin=1.0, narrowest=70.0)


def row(tip=0.5, contact=0.1, held=1.0, **words):
    """The row of a plan whose verdicts are yes but for those in words."""
    verdicts = {f"verdict_{name}": words.get(name, "yes") for name in CHECKED}
    figures = {"tip_last": tip, "clearance_min": -contact, "robustness_held_share": held, "e3": 1.0}
    return verdicts | figures | {"status": "done", "problem": "tree", "binds": "wall", "process_s": 1.0}


@pytest.fixture(scope="module")
def tree_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("tree") / "tree.vtp"
    write_vtk(path, synthetic_tree(0, 4))
    return path


@pytest.mark.parametrize(
    ("found", "outcome", "nominal"),
    [
        (row(), REACHED, True),
        (row(holds="no", held=0.9), NEARLY, True),
        (row(holds="NOT CHECKED", held=None), NEARLY, True),
        (row(tip=2.9, arrives="no"), NEARLY, False),
        (row(tip=3.1, arrives="no"), MISSED, False),
        (row(contact=1.4, within_wall="no"), NEARLY, False),
        (row(contact=1.6, within_wall="no"), MISSED, False),
        (row(tip=2.9, arrives="no", contact=1.6, within_wall="no"), MISSED, False),
        (row(tip=1.0, arrives="no"), MISSED, False),
        (row(stable="no"), MISSED, False),
        (row(solved="no"), MISSED, False),
    ],
)
def test_outcome_is_that_of_the_verdicts(found, outcome, nominal):
    made = outcome_of_plan(BEFORE, found)
    assert (made.outcome, made.nominal) == (outcome, nominal)
    assert (made.binds == "") == (outcome == REACHED)


def test_end_that_was_not_simulated_never_counts_as_reached():
    made = outcome_of_plan(BEFORE, row(holds="NOT CHECKED", held=0.0))
    assert made.outcome != REACHED
    assert math.isnan(made.held)


def test_plan_that_failed_tells_why():
    made = outcome_of_plan(BEFORE, {"status": "late", "reason": "it took longer than 1 s", "problem": "tree"})
    assert (made.outcome, made.reason) == (MISSED, "it took longer than 1 s")


def test_best_outcome_is_the_reached_one():
    ends = [replace(BEFORE, outcome=kind, tip=tip) for kind, tip in ((MISSED, 0.0), (REACHED, 1.9), (NEARLY, 0.1))]
    assert best_outcome(ends).outcome == REACHED
    assert best_outcome([replace(BEFORE, outcome=MISSED, tip=tip) for tip in (4.0, 3.0, math.nan)]).tip == 3.0
    counted = count_outcomes([*ends, replace(BEFORE, outcome=NARROW), replace(BEFORE, outcome=UNENTERED)])
    assert (counted["wide_enough"], counted[REACHED], counted[NARROW]) == (3, 1, 1)


def test_end_that_waits_for_another_robot_is_not_missed_yet():
    waiting = [replace(BEFORE, outcome=MISSED), replace(BEFORE, robot="other")]
    assert best_outcome(waiting).outcome == UNPLANNED


def test_interrupted_study_says_how_many_ends_are_not_planned(tree_file, tmp_path):
    tree = read_lumen_tree(tree_file)
    ends = [replace(BEFORE, end=end.number, robot=name) for end in tree.ends for name in ("thin", "other")]
    ends[0] = replace(ends[0], outcome=REACHED, nominal=True)  # end 1 by the robot thin
    ends[2] = replace(ends[2], outcome=MISSED)
    found = Reach(tree, ("thin", "other"), tuple(ends), robust=True)
    assert [sentence.partition(";")[0] for sentence in totals(found)] == [
        "thin: 1 of 4 wide-enough ends reached so far, 2 are not planned yet",
        "other: 0 of 4 wide-enough ends reached so far, 4 are not planned yet",
        "at least one robot: 1 of 4 wide-enough ends reached so far, 3 are not planned yet",
    ]
    write(found, tmp_path)
    assert "reached so far, 3 are not planned yet" in (tmp_path / PAGE_NAME).read_text(encoding="utf-8")
    done = replace(found, outcomes=tuple(replace(one, outcome=MISSED) for one in ends))
    assert totals(done)[0] == "thin: 0 of 4 wide-enough ends reached; 1 as described, 0 nearly, 0 too narrow"


def test_ends_that_are_narrow_or_too_far_are_not_planned(tree_file):
    tree = read_lumen_tree(tree_file)
    thick = ctr.Robot((ctr.Tube(300, 200, 1 / 400, outer_diameter=17, inner_diameter=16.5),))
    for end in tree.ends:
        narrow = outcome_before_planning(tree, end, "thick", thick, trim=False)
        assert narrow.outcome == NARROW
        assert narrow.margin < 0.2
        assert f"{narrow.narrowest:.0f} mm" in narrow.reason
        short = replace(THIN, limits=ctr.Limits(beta=((0, 20), (0, 30))))
        long = outcome_before_planning(tree, end, "short", short, trim=False)
        assert (long.outcome, long.binds) == (MISSED, "length of tube 2")
        # A robot of 30 mm leaves the rest of the straight line to the end.
        assert long.bound == pytest.approx(np.linalg.norm(end.tip - tree.entry) - 30, abs=1e-3)
        assert outcome_before_planning(tree, end, "thin", THIN, trim=True).outcome == UNPLANNED


def test_source_survives_as_json():
    source = TreeSource(
        "a.nii.gz", (1.0, 2.0, 3.0), True, ReadOptions(labels=(1, 2), accept=("leak",)), ("b.vtp",)
    )
    assert TreeSource.from_json(source.to_json()) == source


def case_of(tree_file, **more):
    asked = {"robust": False, "frames": 4, "samples": 0, "seed": 0, "trim": True, "smoothing": 0.0} | more
    source = TreeSource(str(tree_file), from_carina=True)
    return end_cases(source, "digest", [(1, "thin")], {"thin": THIN}, **asked)[0]


def test_cases_differ_by_what_was_asked_for(tree_file):
    cases = [case_of(tree_file), case_of(tree_file, frames=5), case_of(tree_file, trim=False)]
    cases += bound_cases(cases[:1], 1.0) + bound_cases(cases[:1], 2.0)
    assert len({case.digest for case in cases}) == 5
    assert case_of(tree_file).digest == cases[0].digest


def test_row_of_a_plan_tells_how_it_ends(tree_file, monkeypatch):
    plans = []

    def plan_quickly(case, problem):
        plans.append(ctr.solve_per_frame(problem, model="dominant"))
        return plans[-1]

    monkeypatch.setattr(EndCase, "plan_motion", plan_quickly)
    found = case_of(tree_file, frames=1).row()
    assert found["status"] == "done", found["reason"]
    assert (found["end"], found["robot_name"]) == (1, "thin")
    assert {"contact_x", "contact_along", "verdict_arrives"} <= found.keys()
    assert found["binds"] == ", ".join(find_binding(plans[0]))
    at_length = plans[0].beta[-1, -1] > THIN.reach - 0.01
    assert ("length of tube 2" in found["binds"]) == bool(at_length)
    made = outcome_of_plan(BEFORE, found)
    # The dominant model proves nothing about real tubes.
    assert made.outcome in (NEARLY, MISSED)
    assert made.contact_x == found["contact_x"]


@pytest.mark.parametrize(
    ("asked", "error", "named"),
    [
        ({"robots": {}}, RobotError, "robots"),
        ({"robots": {"thin": 3}}, RobotError, "thin"),
        ({"samples": -1}, OptionError, "samples"),
        ({"bound_s": -1.0}, OptionError, "bound_s"),
    ],
)
def test_bad_requests_are_refused_early(tree_file, tmp_path, asked, error, named):
    with pytest.raises(error, match=named):
        ctr.reach_tree(tree_file, folder=tmp_path, **({"robots": {"thin": THIN}} | asked))


@pytest.mark.slow
def test_second_call_plans_only_what_is_missing(tree_file, tmp_path):
    pytest.importorskip("distributed", reason='needs dask: pip install -e ".[study]"')
    asked = {"from_carina": True, "robust": False, "frames": 4, "samples": 5, "trim": True, "bound_s": 0.1}
    seen = []
    first = ctr.reach_tree(tree_file, {"thin": THIN}, tmp_path, callback=seen.append, **asked)
    assert first.complete
    assert seen[0].done_before == 0
    again = ctr.reach_tree(tree_file, {"thin": THIN}, tmp_path, callback=seen.append, **asked)
    assert seen[-1].done_before == seen[-1].total
    assert [one.outcome for one in again.outcomes] == [one.outcome for one in first.outcomes]


def test_table_is_at_most_100_columns_wide(capsys):
    long = replace(
        BEFORE, robot="a" * 40, tip=12.34, contact=12.34, held=1.0, binds="b" * 90, end=100, depth=123.0
    )
    rows = [replace(long, outcome=NEARLY, failed=failed) for failed in CHECKED] + [replace(long, outcome=NARROW)]
    print_table("ends", TABLE_COLUMNS, [table_row(one) for one in rows], text=("robot", "outcome", "binds"))
    assert max(len(line.rstrip()) for line in capsys.readouterr().out.splitlines()) <= 100
