"""Verdicts on hand-made plans with known answers, one matter after the other, and where they are told."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from lumens import straight
from test_contacts import touching
from test_metrics_plan import LINE, aside, made

from ctr_nlp import Plan, Problem, Settings, growing, solve_per_frame, summary, table_i_robot
from ctr_nlp.cli import report
from ctr_nlp.exceptions import OptionError
from ctr_nlp.figures.parts.page import outcome
from ctr_nlp.plan.verdicts import NO, NOT_ASKED, NOT_KNOWN, YES

WORDS = {YES, NO, NOT_ASKED, NOT_KNOWN}
OUT = np.array([0.0, 0, 0, 20, 50, 100, 0, 0])
"""A configuration well within the limits of the seed's robot."""


def shifted(*distances, options=None, **changes):
    """A plan that stands still, whose frames' shapes are aside of the target by these mm."""
    shape = [aside(distance) for distance in distances]
    plan = made(shape, [LINE] * len(distances), np.tile(OUT, (len(distances), 1)))
    told = plan.meta | {"options": options or {}, "failures": {}, "interrupted": False} | changes.pop("meta", {})
    return replace(plan, meta=told, **changes)


def moving(*steps, limits=None, formulation="horizon"):
    """A plan that goes from OUT by these steps (8,), 0.1 s each."""
    q = OUT + np.vstack([np.zeros(8), np.cumsum(steps, axis=0)])
    plan = made([LINE] * len(q), [LINE] * len(q), q)
    robot = table_i_robot().with_limits(**(limits or {}))
    return replace(plan, meta=plan.meta | {"robot": robot.to_dict(), "formulation": formulation})


def twisted(margins, between=None, snaps=()):
    """A plan on the elastic model with these margins."""
    margins = np.array(margins, dtype=float)
    told = {"model": "elastic", "snaps": [{"frame": frame, "tubes": [1], "jump": 1.0} for frame in snaps]}
    between = margins if between is None else np.array(between, dtype=float)
    return shifted(*np.zeros(len(margins)), meta=told, stability=margins, stability_between=between)


# Followed


def test_a_plan_whose_frames_are_all_solved_is_followed():
    found = shifted(3, 4).verdicts.followed
    assert (found.word, found.unit) == (YES, "mm")
    assert found.number == pytest.approx(math.sqrt(12.5))
    assert found.why == "All 2 frames were solved."


def test_a_frame_that_was_not_solved_is_not_followed():
    plan = shifted(3, 4, success=np.array([True, False]))
    assert plan.verdicts.followed.word == NO
    assert "1 of 2 frames were not solved" in plan.verdicts.followed.why


def test_a_frame_whose_shape_is_not_known_is_not_followed():
    plan = shifted(3, 4)
    lost = replace(plan, shape=np.where(np.arange(2)[:, None, None] == 1, np.nan, plan.shape))
    assert lost.verdicts.followed.word == NO
    assert "not known in 1 of 2 frames" in lost.verdicts.followed.why


@pytest.mark.parametrize(
    ("free", "cost", "word"),
    [(1.0, 0.1, YES), (1.0, 0.09, NO), (2.0, 0.0, YES), (0.0, 0.1, NO), (0.0, "inf", YES), (0.5, "inf", YES)],
)
def test_the_wall_may_cost_a_part_of_e3_and_no_more(free, cost, word):
    """e3 is 1.1 mm; clearance_cost is written as strict JSON has it."""
    known = {"free": np.tile(OUT, (2, 1)), "meta": {"e3_free": free}}
    found = shifted(1.1, 1.1, options={"clearance_cost": cost}, **known).verdicts.followed
    assert found.word == word
    assert f"{free:.3g} mm" in found.why


def test_growth_of_e3_is_told_in_percent():
    known = {"free": np.tile(OUT, (1, 1)), "meta": {"e3_free": 1.0}}
    why = shifted(1.75, options={"clearance_cost": 0.1}, **known).verdicts.followed.why
    assert "75.0% larger than 1 mm" in why
    assert "10% is allowed" in why


def test_where_e3_without_the_wall_is_not_known_neither_is_whether_it_was_followed():
    plan = shifted(1.0, free=np.full((1, 8), np.nan), meta={"e3_free": None})
    assert plan.verdicts.followed.word == NOT_KNOWN


# Stable


def test_the_dominant_model_is_not_asked_for_stability():
    found = shifted(1).verdicts.stable
    assert (found.word, found.number) == (NOT_ASKED, None)


@pytest.mark.parametrize(
    ("margins", "between", "snaps", "word", "least"),
    [
        ([0.4, 0.3], [0.4, 0.2], (), YES, 0.2),
        ([0.4, 0.3], [0.4, 0.3], (2,), NO, 0.3),
        ([0.4, 0.3], [0.4, 0.0], (), NO, 0.0),
        ([-0.1, 0.3], [0.1, 0.3], (), NO, -0.1),
        ([0.4, np.nan], [0.4, np.nan], (), NOT_KNOWN, 0.4),
        ([-0.4, np.nan], [0.4, np.nan], (), NO, -0.4),
        ([np.nan], [np.nan], (), NOT_KNOWN, None),
    ],
)
def test_stability_needs_a_margin_everywhere_and_no_snap(margins, between, snaps, word, least):
    found = twisted(margins, between, snaps).verdicts.stable
    assert (found.word, found.number) == (word, least)


def test_a_snap_is_told_with_its_frame():
    assert "snaps on the way to frame 2" in twisted([0.4, 0.3], snaps=(2,)).verdicts.stable.why


# Within limits


def one(axis, size):
    """A step (8,) of one axis."""
    step = np.zeros(8)
    step[axis] = size
    return step


@pytest.mark.parametrize(
    ("steps", "word", "part", "named"),
    [
        ([one(0, 0.1)], YES, 0.5, "speed of alpha_1 on the way to frame 2"),
        ([one(0, 0.1), one(4, 9.0)], YES, 1.0, "speed of beta_2 on the way to frame 3"),
        ([one(4, 9.0), one(7, 0.12)], NO, 1.5, "speed of theta_y on the way to frame 3"),
        ([one(3, 9.0)] * 4, NO, 1 + 6 / 150, "upper limit of beta_1 in frame 5"),
        ([one(3, -8.0)] * 3, NO, 1 + 4 / 150, "lower limit of beta_1 in frame 4"),
        ([one(4, -8.0)] * 4, NO, 1 + 2 / 150, "order of tubes 1 and 2 in frame 5"),
    ],
)
def test_limits_of_position_order_and_speed(steps, word, part, named):
    found = moving(*steps).verdicts.within_limits
    assert (found.word, found.number) == (word, pytest.approx(part))
    assert named in found.why


def test_the_gap_between_carriages_is_a_limit():
    """The seed's second tube is 112 mm longer than its first; 30 mm further out its carriage is 82 mm behind."""
    steps = [one(4, 1.0)]
    assert moving(*steps, limits={"carriage_gap": 80.0}).verdicts.within_limits.word == YES
    found = moving(*steps, limits={"carriage_gap": 84.0}).verdicts.within_limits
    assert (found.word, found.number) == (NO, pytest.approx(1 + 3 / 150))
    assert "carriages 1 and 2" in found.why


@pytest.mark.parametrize(("formulation", "hint"), [("joint", True), ("horizon", False)])
def test_accelerations_count_where_they_are_limited_and_who_keeps_them_is_told(formulation, hint):
    """From rest to 0.1 rad in 0.1 s: 10 rad/s^2."""
    steps = [np.zeros(8), one(0, 0.1)]
    assert moving(*steps, formulation=formulation).verdicts.within_limits.word == YES
    found = moving(*steps, limits={"alpha_acceleration": 4.0}, formulation=formulation).verdicts.within_limits
    assert (found.word, found.number) == (NO, pytest.approx(2.5))
    assert ("only a horizon" in found.why) == hint


def test_what_solvers_leave_is_within_limits():
    assert moving(one(0, 0.2 + 1e-6)).verdicts.within_limits.word == YES
    assert moving(one(0, 0.2 + 1e-4)).verdicts.within_limits.word == NO


# Within the wall


@pytest.mark.parametrize(
    ("least", "options", "word", "deepest"),
    [
        ((1, 2), {}, YES, 0.0),
        ((1, -0.9), {}, YES, 0.9),
        ((1, -1.0), {}, YES, 1.0),
        ((-1.1, 1), {}, NO, 1.1),
        ((-1.1, 1), {"contact_allowed": 1.5}, YES, 1.1),
        ((-1.1, 1), {"contact_weight": 0.0}, NOT_ASKED, 1.1),
        ((-1.1, np.nan), {}, NO, 1.1),
        ((-0.1, np.nan), {}, NOT_KNOWN, 0.1),
        ((np.nan, np.nan), {}, NOT_KNOWN, None),
    ],
)
def test_contact_beyond_what_is_allowed_fails(least, options, word, deepest):
    plan = touching(*least)
    found = replace(plan, meta=plan.meta | {"options": options}).verdicts.within_wall
    assert (found.word, found.unit) == (word, "mm")
    assert found.number == (None if deepest is None else pytest.approx(deepest))


def test_where_no_wall_is_known_none_is_asked_for():
    found = shifted(1).verdicts.within_wall
    assert (found.word, found.number) == (NOT_ASKED, None)


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_contact_allowed_is_a_finite_number_of_mm(value):
    with pytest.raises(OptionError, match=f"contact_allowed is {value}"):
        Settings(contact_allowed=value)


# All of them


def test_draws_were_not_asked_for():
    assert shifted(1).verdicts.survives_draws.word == NOT_ASKED


PLANS = {
    "good": shifted(1.0),
    "snaps": twisted([0.4, 0.3], snaps=(2,)),
    "fast": moving(one(0, 0.3)),
    "in contact": touching(-3.0, 1.0),
    "not solved": shifted(1.0, success=np.array([False])),
    "not reached": touching(np.nan),
}
FAILED = {
    "good": (),
    "snaps": ("stable",),
    "fast": ("within limits",),
    "in contact": ("within the wall",),
    "not solved": ("followed",),
    "not reached": ("followed",),
}


@pytest.fixture(params=PLANS)
def name(request):
    return request.param


def test_failed_are_the_matters_whose_word_is_no(name):
    assert PLANS[name].verdicts.failed == FAILED[name]


def test_every_verdict_has_a_word_and_a_sentence(name):
    for verdict in PLANS[name].verdicts:
        assert verdict.word in WORDS
        assert not verdict.why[0].islower()
        assert verdict.why.endswith(".")


def test_verdicts_cannot_be_changed():
    plan = shifted(1.0)
    with pytest.raises(AttributeError):
        plan.verdicts.stable = plan.verdicts.followed
    with pytest.raises(AttributeError):
        plan.verdicts.followed.word = NO


def test_a_failed_verdict_is_exit_status_1_and_an_interruption_130(name):
    plan = PLANS[name]
    told = plan.meta | {"interrupted": False}
    assert report.exit_status(replace(plan, meta=told)) == (1 if FAILED[name] else 0)
    assert report.exit_status(replace(plan, meta=told | {"interrupted": True})) == 130


def test_summary_terminal_and_python_say_the_same_words(name, capsys):
    plan = PLANS[name]
    plan = replace(plan, meta=plan.meta | {"failures": {}, "interrupted": False})
    found = json.loads(json.dumps(summary(plan), allow_nan=False))["verdicts"]
    assert [each["word"] for each in found.values()] == [verdict.word for verdict in plan.verdicts]
    assert list(found) == ["followed", "stable", "within_limits", "within_wall", "survives_draws"]
    report.print_report(plan)
    lines = capsys.readouterr().out.partition("numbers")[0].splitlines()
    for verdict in plan.verdicts:
        (line,) = [line for line in lines if line.strip().startswith(verdict.matter)]
        assert f" {verdict.word} " in line
        assert verdict.why in line


def test_pictures_name_what_failed(name):
    text = outcome(summary(PLANS[name]))
    assert text.endswith(f"no: {', '.join(FAILED[name])}" if FAILED[name] else "e3 = 1 mm")


def test_a_file_from_before_there_were_verdicts_is_judged_by_the_defaults(tmp_path):
    """Neither a motion without the wall, nor what contact is allowed, is in it."""
    touching(-3.0, 1.0).save(tmp_path / "plan.npz")
    plan = Plan.load(tmp_path / "plan.npz")
    assert "e3_free" not in plan.meta
    assert plan.verdicts.failed == ("within the wall",)


def test_what_contact_is_allowed_stays_with_the_plan(tmp_path):
    problem = Problem("narrow", table_i_robot(), growing(straight(2.0).part(0, 60.0), 4), lumen=straight(2.0))
    for allowed, failed in ((0.5, ("within the wall",)), (5.0, ())):
        plan = solve_per_frame(problem, settings=Settings(contact_allowed=allowed))
        plan.save(tmp_path / "plan.npz")
        assert plan.verdicts.failed == Plan.load(tmp_path / "plan.npz").verdicts.failed == failed
