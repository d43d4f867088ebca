"""Which ends are reached: what counts, what a plan that fails counts for, and what the page says."""

import csv
import math

import pytest

from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, REACHED_VERDICT_NAMES, YES
from ctr_nlp.studies.grid.case import CASE_DONE, CASE_FAILED
from ctr_nlp.studies.grid.reports import write_report
from ctr_nlp.studies.reached.cases import REACHED, from_rows
from ctr_nlp.studies.reached.report import findings, page


def row(seed, method="horizon", words=(), **more):
    """A row of a study whose verdicts read yes, apart from the words given."""
    found = {
        "problem": f"synthetic:{seed}",
        "robot_name": "tubes",
        "method": method,
        "status": CASE_DONE,
        "tip_last": 0.4,
        "contact_depth": 0.9,  # summed over frames, which nothing is judged by
        "clearance_min": -0.1,
        "clearance_between_min": -0.2,
        "robustness_held_share": 0.97,
        "e3": 0.8,
        "verdict_follows": NO,  # an end is reached however well the way there is followed
    }
    return found | {f"verdict_{check}": YES for check in REACHED_VERDICT_NAMES} | dict(words) | more


NOT_PLANNED = {"problem": "synthetic:3", "robot_name": "tubes", "method": "horizon", "status": CASE_FAILED}
ROWS = [
    row(0),
    row(1, words={"verdict_within_wall": NO, "verdict_arrives": NO}, tip_last=4.0, clearance_min=-1.5),
    row(2, words={"verdict_holds": NOT_CHECKED}, robustness_held_share=math.nan),
    NOT_PLANNED,
    row(0, "robust-horizon"),
    row(1, "robust-horizon"),
]


def test_an_end_is_reached_where_every_check_but_following_reads_yes():
    plain, robust = from_rows(ROWS)
    assert [outcome.failed for outcome in plain.outcomes] == [REACHED, "arrives", "holds", "solved"]
    assert (plain.reached_count, robust.reached_count) == (1, 2)
    assert [outcome.problem for outcome in robust.outcomes] == ["synthetic 0", "synthetic 1"]


def test_contact_is_the_deepest_at_and_between_frames():
    plain, _ = from_rows(ROWS)
    assert [outcome.contact for outcome in plain.outcomes[:3]] == [0.2, 1.5, 0.2]
    assert math.isnan(plain.outcomes[3].contact)
    (clear,) = from_rows([row(0, clearance_min=0.3, clearance_between_min=math.nan)])
    assert clear.outcomes[0].contact == 0.0


def test_what_was_set_and_several_robots_tell_ways_apart():
    rows = [row(0, set_arrival_weight=0.0), row(0, set_arrival_weight=50.0), row(0, set_arrival_weight=math.nan)]
    assert [way.name for way in from_rows(rows)] == [
        "over all frames, arrival_weight 0",
        "over all frames, arrival_weight 50",
        "over all frames",
    ]
    others = from_rows([row(0), row(0, robot_name="other")])
    assert [way.name for way in others] == ["over all frames, tubes", "over all frames, other"]


def test_findings_and_tables_tell_why_ends_are_not_reached():
    told = findings(from_rows(ROWS))
    assert told[0] == (
        "over all frames: 1 of 4 ends are reached; of the other plans, 1 is not solved, 1 does not arrive, "
        "1 does not hold on built robots"
    )
    assert told[1] == "robust over all frames: 2 of 2 ends are reached"
    lines = page(from_rows(ROWS)).splitlines()
    assert "| over all frames | 1 | 1 | 0 | 0 | 1 | 0 | 1 |" in lines
    assert "| over all frames | 0.400 | 0.400 | 0.400 | 2.20 | 4.00 |" in lines
    unknown = page(from_rows([NOT_PLANNED])).splitlines()
    assert "| over all frames | – | – | – | – | – |" in unknown


def test_all_files_are_written(tmp_path):
    assert write_report("reached", ROWS, tmp_path) == findings(from_rows(ROWS))
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["reached.csv", "reached.md", "reached.pdf", "reached.png"]
    with (tmp_path / "reached.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [line["failed"] for line in rows] == ["reached", "arrives", "holds", "solved", "reached", "reached"]


def test_a_study_reads_its_robots_and_ends_with_the_page(tmp_path, capsys):
    pytest.importorskip("distributed", reason="the extra `study` is not installed")
    from ctr_nlp.cli.main import main

    (tmp_path / "study.toml").write_text(
        'name = "few"\nframes = 6\nreport = "reached"\n[problems]\nsynthetic = 1\n'
        '[[ways]]\nmodels = ["dominant"]\n'
    )
    out = tmp_path / "out"
    assert main(["study", str(tmp_path / "study.toml"), "--workers", "1", "--out", str(out)]) == 1
    told = " ".join(capsys.readouterr().out.split())
    assert "over all frames: 0 of 1 ends are reached" in told
    assert (out / "reached.md").read_text().count("| over all frames |") == 5
    assert (out / "reached.png").stat().st_size > 1000
