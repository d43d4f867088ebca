"""Verdicts on hand-made plans with known answers, one check after the other, and where they are reported."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lumens import straight
from test_contacts import touching
from test_metrics_plan import LINE, aside, made

from ctr_nlp import Load, Plan, Problem, Robot, Settings, Tube, growing, solve_per_frame, summary, table_i_robot
from ctr_nlp.cli import plan_report
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.settings import THRESHOLDS
from ctr_nlp.paths.distance_field import BLOCK_NODES, DistanceField, make_grid
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.paths.walls import Body
from ctr_nlp.plan import verdicts
from ctr_nlp.plan.measures import DeepestPoint
from ctr_nlp.plan.motion_evaluation import evaluate_motion
from ctr_nlp.plan.sample_outcomes import SampleOutcomes, sample_outcomes
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS, headline, remarks
from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, YES, Verdict, Verdicts, outcome_sentence
from ctr_nlp.problems import named_problem
from ctr_nlp.view.figures.parts.page import outcome

WORDS = {YES, NO, NOT_CHECKED}
OUT = np.array([0.0, 0, 0, 20, 50, 100, 0, 0])
"""A configuration well within the limits of Table I's robot."""


def shifted(*distances, options=None, model="elastic", **changes):
    """A plan that stands still, whose frames' shapes are aside of the target by these mm."""
    shape = [aside(distance) for distance in distances]
    plan = made(shape, [LINE] * len(distances), np.tile(OUT, (len(distances), 1)))
    described = {"options": options or {}, "failures": {}, "interrupted": False, "model": model}
    return replace(plan, meta=plan.meta | described | changes.pop("meta", {}), **changes)


def moving(*steps, limits=None, formulation="horizon"):
    """A plan that goes from OUT by these steps (8,), 0.1 s each."""
    q = OUT + np.vstack([np.zeros(8), np.cumsum(steps, axis=0)])
    plan = made([LINE] * len(q), [LINE] * len(q), q)
    robot = table_i_robot().with_limits(**(limits or {}))
    described = {"robot": robot.to_dict(), "formulation": formulation, "model": "elastic"}
    return replace(plan, meta=plan.meta | described)


def twisted(margins, between=None, snaps=(), options=None):
    """A plan on the elastic model with these margins."""
    margins = np.array(margins, dtype=float)
    described = {"snaps": [{"frame": frame, "tubes": [1], "jump": 1.0} for frame in snaps]}
    between = margins if between is None else np.array(between, dtype=float)
    zeros = np.zeros(len(margins))
    return shifted(*zeros, meta=described, options=options, stability=margins, stability_between=between)


def walled(*least, between=None, options=None, model="elastic"):
    """A plan in a lumen with these least clearances in its frames, and on the way to them, mm."""
    plan = touching(*least)
    there = plan.clearance if between is None else touching(*between).clearance
    described = plan.meta | {"model": model, "options": options or {}}
    return replace(plan, meta=described, clearance_between=there)


# Solved


def test_all_frames_solved_reads_yes_with_their_number():
    found = shifted(3, 4).verdicts.solved
    assert (found.word, found.number, found.unit, found.value) == (YES, 2, "frames", "2 frames")
    assert found.why == "All 2 frames were solved on the elastic model."


def test_a_frame_that_was_not_solved_reads_no():
    found = shifted(3, 4, success=np.array([True, False])).verdicts.solved
    assert (found.word, found.number) == (NO, 1)
    assert "1 of 2 frames were not solved" in found.why


def test_interpolated_frames_are_not_checked():
    found = shifted(0, 0, success=np.array([True, False]), meta={"interpolated": [2]}).verdicts.solved
    assert (found.word, found.number) == (NOT_CHECKED, 1)


def test_frames_without_a_residual_are_not_checked():
    found = shifted(0, 0, kkt=np.array([0.0, np.nan])).verdicts.solved
    assert (found.word, found.number, found.value) == (NOT_CHECKED, 1, "1 of 2 frames")
    assert found.why == "1 of 2 frames were given, not solved: they have no KKT residual."
    unsolved = shifted(0, 0, kkt=np.array([0.0, np.nan]), success=np.array([True, False])).verdicts.solved
    assert (unsolved.word, unsolved.number) == (NO, 1)


def test_the_cost_of_clearance_is_reported_in_percent():
    known = {"free": np.tile(OUT, (1, 1)), "meta": {"e3_free": 1.25}}
    why = shifted(1.75, **known).verdicts.solved.why
    assert "Keeping off the wall costs 40.0 % of e3." in why
    # Nothing is said where either of both errors is not known, or where the plan is judged otherwise than planned.
    unknown = (
        shifted(1.75, meta={"e3_free": 1.25}),
        shifted(1.75, free=np.tile(OUT, (1, 1)), meta={"e3_free": 0.0}),
        shifted(np.nan, **known),
        shifted(1.75, free=np.tile(OUT, (1, 1)), meta={"e3_free": 1.25, "evaluated": "dominant"}),
    )
    assert not any("Keeping off" in plan.verdicts.solved.why for plan in unknown)


# Arrives


@pytest.mark.parametrize(
    ("last", "options", "word"),
    [
        (0.0, {}, YES),
        (2.0, {}, YES),
        (2.001, {}, NO),
        (43.9, {}, NO),
        (2.001, {"arrival_tolerance": 3.0}, YES),
        (1.5, {"arrival_tolerance": 1.0}, NO),
        (np.nan, {}, NOT_CHECKED),
    ],
)
def test_the_last_tip_decides_whether_a_plan_arrives(last, options, word):
    plan = shifted(9.0, 0.0, options=options)
    shape = plan.shape.copy()
    shape[1, -1] = np.array([last, 0.0, 100.0])
    found = replace(plan, shape=shape).verdicts.arrives
    assert found.word == word
    assert found.number == (None if math.isnan(last) else pytest.approx(last))


def test_direction_and_shortness_of_the_last_frame_stand_beside():
    q = np.tile(OUT, (1, 1))
    q[0, 5] = 90.0
    plan = made([LINE * 0.9], [LINE], q, tip_direction=np.array([[math.sin(0.5), 0, math.cos(0.5)]]))
    found = replace(plan, meta=plan.meta | {"model": "elastic"}).verdicts.arrives
    assert found.word == NO
    assert found.value == "10.00 mm, 28.6°"
    assert found.why.endswith("2 mm is allowed. The robot is 10.0 mm shorter than the path.")


def test_a_robot_that_cuts_bends_and_arrives_says_so():
    bent = LINE + np.outer(np.sin(np.pi * np.linspace(0, 1, 101)), [12.0, 0.0, 0.0])
    plan = made([LINE], [bent], np.tile(OUT, (1, 1)), tip_direction=np.array([[0.0, 0, 1]]))
    found = replace(plan, meta=plan.meta | {"model": "elastic"}).verdicts.arrives
    assert found.number == pytest.approx(0.0, abs=1e-9)
    assert re.search(r"2 mm is allowed\. The robot is \d\.\d mm shorter than the path, because it cuts", found.why)


@pytest.mark.parametrize(("least", "bound"), [(0.985, "at least 98.5 % of all robots"), (0.0, None)])
def test_a_certificate_names_only_a_bound_that_says_something(least, bound):
    plan = shifted(1.0)
    certificate = {"outcome": "0 of 200 simulated robots hold.", "holds_at_least": least, "held": True}
    found = replace(plan, meta=plan.meta | {"certificate": certificate})
    (told,) = [text for text in remarks(found, summary(found)) if text.startswith("certificate")]
    assert (bound in told) if bound else told == "certificate: 0 of 200 simulated robots hold"


def test_tolerances_of_simulated_robots_are_stated(sampled):
    told = [text for text in remarks(sampled, summary(sampled)) if text.startswith("simulated robots differ")]
    assert told == [
        "simulated robots differ from the one described by up to: curvature 2 %, bending stiffness 2 %, "
        "motor zero 0.02 rad (the defaults; `[tolerances]` in a robot file sets others)"
    ]
    assert not [text for text in remarks(shifted(1.0), summary(shifted(1.0))) if "simulated robots" in text]


def test_headline_names_goal_and_tubes():
    plan = shifted(1.0)
    x, y, z = plan.target[-1, -1]
    widths = ", ".join(f"{tube.outer_diameter:.2f}" for tube in plan.robot.tubes)
    told = f"to ({x:.1f}, {y:.1f}, {z:.1f}) mm, with {plan.robot.d} tubes of {widths} mm"
    assert headline(plan).endswith(told)
    moved = np.eye(4)
    moved[:3, 3] = 1.0, 2.0, 3.0
    scanned = replace(plan, meta=plan.meta | {"problem": {**plan.meta["problem"], "space": "RAS"}}, to_robot=moved)
    assert f"to ({x - 1:.1f}, {y - 2:.1f}, {z - 3:.1f}) mm in RAS, with" in headline(scanned)


def test_printed_verdicts_are_sentences():
    found = shifted(1.0).verdicts
    assert str(found.arrives).startswith("arrives: ")
    assert found.arrives.why.rstrip(".") in f"{found.arrives}"
    assert str(found).splitlines() == [str(verdict) for verdict in found]


def test_reaching_the_target_on_the_dominant_model_is_not_checked_and_missing_it_is_no():
    assert shifted(0.1, model="dominant").verdicts.arrives.word == NOT_CHECKED
    assert shifted(30.0, model="dominant").verdicts.arrives.word == NO


# Follows


@pytest.mark.parametrize(
    ("distances", "options", "word", "worst", "frame"),
    [
        ((1.0, 1.999, 0.5), {}, YES, 1.999, 2),
        ((1.0, 0.5, 2.1), {}, NO, 2.1, 3),
        ((2.1, 0.0, 0.0), {}, NO, 2.1, 1),
        ((2.1, 0.0), {"error_allowed": 2.5}, YES, 2.1, 1),
    ],
)
def test_the_worst_frame_decides_whether_a_plan_follows(distances, options, word, worst, frame):
    found = shifted(*distances, options=options).verdicts.follows
    assert (found.word, found.number) == (word, pytest.approx(worst))
    assert f"frame {frame}" in found.value


def test_a_frame_without_a_shape_leaves_following_not_checked():
    plan = shifted(1, 1)
    unknown = replace(plan, shape=np.where(np.arange(2)[:, None, None] == 1, np.nan, plan.shape))
    assert unknown.verdicts.follows.word == NOT_CHECKED
    assert "not known in 1 of 2 frames" in unknown.verdicts.follows.why


# Stable


def test_the_dominant_model_cannot_check_stability():
    found = shifted(1, model="dominant").verdicts.stable
    assert (found.word, found.number) == (NOT_CHECKED, None)
    assert found.why == "This model cannot predict snapping; use --model elastic."


@pytest.mark.parametrize(
    ("margins", "between", "snaps", "word", "least"),
    [
        ([0.4, 0.3], [0.4, 0.2], (), YES, 0.2),
        ([0.4, 0.3], [0.4, 0.0951], (), YES, 0.0951),
        ([0.4, 0.3], [0.4, 0.0949], (), NO, 0.0949),
        ([0.4, 0.3], [0.4, 0.3], (2,), NO, 0.3),
        ([0.4, 0.3], [0.4, 0.0], (), NO, 0.0),
        ([-0.1, 0.3], [0.1, 0.3], (), NO, -0.1),
        ([0.4, np.nan], [0.4, np.nan], (), NOT_CHECKED, 0.4),
        ([-0.4, np.nan], [0.4, np.nan], (), NO, -0.4),
        ([np.nan], [np.nan], (), NOT_CHECKED, None),
    ],
)
@pytest.mark.hazard("snap")
def test_stability_needs_the_margin_everywhere_and_no_snap(margins, between, snaps, word, least):
    found = twisted(margins, between, snaps).verdicts.stable
    assert (found.word, found.number) == (word, least)


@pytest.mark.parametrize(("asked", "word"), [(0.2, YES), (0.3, NO), (None, YES)])
def test_the_margin_that_was_asked_for_must_hold(asked, word):
    assert twisted([0.21], options={"stability_margin": asked}).verdicts.stable.word == word


def test_the_frame_of_a_snap_is_reported():
    assert "snaps on the way to frame 2" in twisted([0.4, 0.3], snaps=(2,)).verdicts.stable.why


def test_a_load_without_energy_leaves_stability_not_checked():
    """A force that turns with the tip has no energy, so that no margin says whether the robot is stable."""
    pushed = {axes: Load(force=(0.0, 0.1, 0.0), axes=axes).to_dict() for axes in ("base", "tool")}
    plan = twisted([0.4, 0.3])
    turning, fixed = (
        replace(plan, meta=plan.meta | {"load": pushed[axes]}).verdicts.stable for axes in ("tool", "base")
    )
    assert (turning.word, fixed.word) == (NOT_CHECKED, YES)
    assert "no energy" in turning.why
    assert turning.value == fixed.value == "0.300 at frame 2"


# Within limits


def one(axis, size):
    """A step (8,) of one axis."""
    step = np.zeros(8)
    step[axis] = size
    return step


@pytest.mark.parametrize(
    ("steps", "word", "part", "where"),
    [
        ([one(0, 0.1)], YES, 0.5, "speed of alpha_1 on the way to frame 2"),
        ([one(0, 0.1), one(4, 9.0)], YES, 1.0, "speed of beta_2 on the way to frame 3"),
        ([one(4, 9.0), one(7, 0.12)], NO, 1.5, "speed of theta_y on the way to frame 3"),
        ([one(3, 9.0)] * 4, NO, 1 + 6 / 150, "upper limit of beta_1 in frame 5"),
        ([one(3, -8.0)] * 3, NO, 1 + 4 / 150, "lower limit of beta_1 in frame 4"),
        ([one(4, -8.0)] * 4, NO, 1 + 2 / 150, "order of tubes 1 and 2 in frame 5"),
    ],
)
@pytest.mark.hazard("wrong tube order", "limit exceeded")
def test_limits_of_position_order_and_speed(steps, word, part, where):
    found = moving(*steps).verdicts.within_limits
    assert (found.word, found.number) == (word, pytest.approx(100 * part))
    assert where in found.why


def test_the_gap_between_carriages_is_a_limit():
    """Table I's second tube is 112 mm longer than its first; 30 mm further out its carriage is 82 mm behind."""
    steps = [one(4, 1.0)]
    assert moving(*steps, limits={"carriage_gap": 80.0}).verdicts.within_limits.word == YES
    found = moving(*steps, limits={"carriage_gap": 84.0}).verdicts.within_limits
    assert (found.word, found.number) == (NO, pytest.approx(100 * (1 + 3 / 150)))
    assert "carriages 1 and 2" in found.why


@pytest.mark.parametrize(("formulation", "hint"), [("joint", True), ("horizon", False)])
def test_accelerations_count_where_they_are_limited(formulation, hint):
    """From rest to 0.1 rad in 0.1 s: 10 rad/s^2."""
    steps = [np.zeros(8), one(0, 0.1)]
    assert moving(*steps, formulation=formulation).verdicts.within_limits.word == YES
    found = moving(*steps, limits={"alpha_acceleration": 4.0}, formulation=formulation).verdicts.within_limits
    assert (found.word, found.number) == (NO, pytest.approx(250))
    assert ("only the horizon formulation limits accelerations" in found.why) == hint


def test_frames_without_a_configuration_are_counted():
    plan = moving(one(0, 0.01), one(0, 0.01), one(0, 0.01))
    q = plan.q.copy()
    q[3] = np.nan
    found = replace(plan, alpha=q[:, :3], beta=q[:, 3:6], theta=q[:, 6:]).verdicts.within_limits
    assert found.word == NOT_CHECKED
    assert "1 frames have no configuration" in found.why


def test_the_rounding_of_solvers_is_within_limits():
    assert moving(one(0, 0.2 + 1e-6)).verdicts.within_limits.word == YES
    assert moving(one(0, 0.2 + 1e-4)).verdicts.within_limits.word == NO


# Within the wall


@pytest.mark.parametrize(
    ("least", "options", "word", "deepest"),
    [
        ((1, 2), {}, YES, 0.0),
        ((1, -0.4), {}, YES, 0.4),
        ((1, -0.5), {}, YES, 0.5),
        ((-0.6, 1), {}, NO, 0.6),
        ((-1.1, 1), {"contact_allowed": 1.5}, YES, 1.1),
        ((-1.1, 1), {"contact_weight": 0.0}, NO, 1.1),
        ((-1.1, np.nan), {}, NO, 1.1),
        ((-0.1, np.nan), {}, NOT_CHECKED, 0.1),
        ((np.nan, np.nan), {}, NOT_CHECKED, None),
    ],
)
@pytest.mark.hazard("contact with the wall")
def test_contact_beyond_what_is_allowed_reads_no(least, options, word, deepest):
    found = walled(*least, options=options).verdicts.within_wall
    assert (found.word, found.unit) == (word, "mm of contact")
    assert found.number == (None if deepest is None else pytest.approx(deepest))


def test_clearance_and_depth_are_short_values():
    assert walled(1.25, 2).verdicts.within_wall.value == "1.25 mm clear"
    assert walled(2, -0.25).verdicts.within_wall.value == "0.25 mm deep, frame 2"


def test_clearance_is_told_with_the_margin_of_its_wall():
    """The margin is that of the wall that was named, and is left out where there is none."""
    grid = make_grid(np.zeros((5 + BLOCK_NODES,) * 3), np.eye(4))
    field = DistanceField((grid,))
    plan = replace(shifted(1), walls=(Body("vessel", field, True, 2.0), Body("lung", field)))

    def told(depth, name):
        place = DeepestPoint(depth, "in frame", 1, 2, 30.0, np.zeros(3))
        return verdicts._describe_deepest_point(plan, place, 0.0, name)

    at = "in frame 1, at tube 2, 30 mm along the robot"
    assert told(-3.0, "vessel") == f"vessel: the least clearance beyond the margin of 2 mm is 3.00 mm {at}."
    assert told(0.5, "vessel").startswith("vessel: the deepest contact within the margin of 2 mm is 0.50 mm")
    assert told(-3.0, "lung") == f"lung: the least clearance is 3.00 mm {at}."
    assert told(-3.0, "") == f"The least clearance is 3.00 mm {at}."


@pytest.mark.hazard("contact with the wall")
def test_contact_between_frames_counts():
    found = walled(0.2, 0.3, between=(0.2, -0.7)).verdicts.within_wall
    assert (found.word, found.number) == (NO, pytest.approx(0.7))
    assert "on the way to frame 2" in found.why
    assert "tube 3, 60 mm along the robot" in found.why


def test_the_place_of_contact_is_given_in_the_coordinates_of_the_file():
    plan = walled(0.2, 0.3)
    assert "mm in LPS" not in plan.verdicts.within_wall.why
    for space, named in (("LPS", "mm in LPS"), ("xyz", "mm in the file's axes")):
        problem = plan.meta["problem"] | {"space": space}
        known = replace(plan, meta=plan.meta | {"problem": problem}, to_robot=np.eye(4))
        assert named in known.verdicts.within_wall.why


def test_what_was_not_looked_at_between_frames_does_not_read_yes():
    plan = replace(walled(0.2, 0.3), clearance_between=None)
    assert plan.verdicts.within_wall.word == NOT_CHECKED


def test_without_a_wall_nothing_is_checked():
    found = shifted(1).verdicts.within_wall
    assert (found.word, found.number) == (NOT_CHECKED, None)


# The wall's force, of a robot that leans on it


def leaning(at, between=None, along=((10.0, 60.0),), margins=(1.0, 0.5), limit=0.2):
    """A plan that is 0.3 mm deep, on whose body the wall presses at two places with these forces, N.

    at: the largest force at a place in each frame. between: on the way to it.
    """
    plan = walled(-0.3, *[-0.2] * (len(at) - 1))
    at = np.array(at, dtype=float)
    # The second of two places has the whole force of the frame.
    pieces = np.stack([0.1 * at, at], axis=1)
    return replace(
        plan,
        wall_force=pieces,
        wall_force_along=np.broadcast_to(np.array(along), (len(at), 2)),
        wall_force_direction=np.broadcast_to([1.0, 0.0, 0.0], (len(at), 2, 3)),
        place_force=at,
        place_force_between=at if between is None else np.array(between, dtype=float),
        stability_without_wall=np.resize(np.array(margins, dtype=float), len(at)),
        meta=plan.meta | {"wall_contact": {"limit_N": limit}},
    )


@pytest.mark.parametrize(
    ("at", "between", "word", "number"),
    [
        ([0.1, 0.199], None, YES, 0.199),
        ([0.1, 0.203], None, YES, 0.203),
        ([0.1, 0.21], None, NO, 0.21),
        ([0.1, 0.1], [0.1, 0.21], NO, 0.21),
        ([0.3, 0.1], None, NO, 0.3),
        ([np.nan, 0.1], None, NOT_CHECKED, 0.1),
        ([0.1, 0.15], [np.nan, 0.1], NOT_CHECKED, 0.15),
        ([np.nan, 0.3], None, NO, 0.3),
    ],
)
def test_the_largest_force_at_a_place_decides_in_and_between_frames(at, between, word, number):
    """Rounding of the search, 2 % of the limit, is within it."""
    found = leaning(at, between).verdicts.within_wall
    assert (found.word, found.unit) == (word, "N at one place")
    assert found.number == pytest.approx(number)
    assert ("Forces are not known in 1 frames." in found.why) == (word == NOT_CHECKED)
    assert "0.2 N is allowed" in found.why
    assert "deepest contact is 0.30 mm" in found.why


def test_frames_without_known_forces_are_counted():
    assert "Forces are not known in 1 frames." in leaning([0.1, np.nan, 0.1]).verdicts.within_wall.why
    assert "Forces are not known in 2 frames." in leaning([np.nan, 0.1, np.nan]).verdicts.within_wall.why


def test_no_known_force_is_not_checked():
    found = leaning([np.nan, np.nan]).verdicts.within_wall
    assert (found.word, found.number) == (NOT_CHECKED, None)


def test_the_place_of_the_largest_force_is_told():
    """Tubes end at 20, 50 and 100 mm."""
    told = {
        60.0: "at tube 3, 60 mm",
        40.0: "at tube 2, 40 mm",
        15.0: "at tube 1, 15 mm",
        100.5: "at tube 3, 100 mm",
    }
    for along, words in told.items():
        why = leaning([0.1, 0.15], along=((10.0, along),)).verdicts.within_wall.why
        assert "around frame 2" in why
        assert words in why
    assert "on the way to frame 2" in leaning([0.0, 0.0], between=[0.0, 0.1]).verdicts.within_wall.why
    assert "frame 2" in leaning([0.1, 0.15]).verdicts.within_wall.value


def test_what_the_robot_does_without_the_wall_is_told():
    assert "would be 0.500 at least, in frame 2." in leaning([0.1, 0.1]).verdicts.within_wall.why
    assert (
        "would be 0.250 at least, in frame 1." in leaning([0.1, 0.1], margins=(0.25, 0.5)).verdicts.within_wall.why
    )
    why = leaning([0.1, 0.1], margins=(0.5, np.nan)).verdicts.within_wall.why
    assert "would snap on the way to frame 2." in why


def test_a_robot_that_swings_through_the_wall_between_two_frames_is_found():
    """A lone tube that turns by a whole turn from one frame to the next lies in the middle of a lumen in both, and
    sweeps through its wall between them.
    """
    tube = Robot((Tube(100.0, 60.0, 1 / 60, outer_diameter=2.0, inner_diameter=1.5),))
    simulator = Simulator(tube, KINEMATIC_MODELS["elastic"])
    q = np.array([[0.0, 60.0, 0.0, 0.0], [2 * np.pi, 60.0, 0.0, 0.0]])
    middle = simulator(q).shape[0]
    lumen = Lumen(np.column_stack([middle, np.full(len(middle), 3.0)]))
    found = evaluate_motion(simulator, q, target=np.stack([middle, middle]), wall=lumen).arrays
    assert found["clearance"].min() == pytest.approx(2.0, abs=0.05)
    # Half a turn away the tip is twice as far aside as in the frames: 2 * 60 mm * (1 - cos 1).
    aside = 2 * 60 * (1 - np.cos(1.0))
    assert -aside < found["clearance_between"][1].min() < -20
    assert found["clearance_between"][0].min() == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
@pytest.mark.parametrize("name", ["arrival_tolerance", "error_allowed", "contact_allowed"])
def test_thresholds_are_finite_numbers_of_mm(name, value):
    with pytest.raises(OptionError, match=f"{name} is {value}"):
        Settings(**{name: value})


@pytest.mark.parametrize("value", [0, -0.5, 1.01, 95, "most"])
def test_the_share_is_a_part_of_all_samples(value):
    with pytest.raises(OptionError, match="share is"):
        Settings(share=value)


# Holds on built robots


@pytest.fixture(scope="module")
def sampled():
    """A plan on the elastic model, with 20 samples."""
    return solve_per_frame(named_problem("bronchus", frames=8), model="elastic").with_samples(20, 3)


def judged_by_hand(plan, arrival=2.0, contact=1.0):
    """Flags of samples that are lost, miss the target's end, and press into the wall, from the plan's arrays."""
    drawn = plan.drawn
    tips = np.linalg.norm(drawn.cloud[-1, :, -1] - plan.target[-1, -1], axis=1)
    return drawn.lost > 0, ~(tips <= arrival), ~(-drawn.clearance <= contact)


@pytest.mark.parametrize(("arrival", "share"), [(0.5, 0.95), (2.0, 0.95), (6.0, 0.5), (60.0, 0.2), (200.0, 1.0)])
@pytest.mark.hazard("robot differs from its description")
def test_samples_are_judged_by_branch_arrival_and_contact(sampled, arrival, share):
    plan = sampled.with_thresholds(arrival_tolerance=arrival, share=share, contact_allowed=60.0)
    lost, missed, pressed = judged_by_hand(plan, arrival, 60.0)
    held = float((~(lost | missed | pressed)).mean())
    found = plan.verdicts.holds
    assert (found.word, found.number) == (YES if held >= share else NO, pytest.approx(held))
    # How to plan for such robots is said where they fail on a plan that was made for one robot.
    assert ("plans for such robots" in found.why) == (held < share)
    certified = replace(plan, meta=plan.meta | {"certificate": {}}).verdicts.holds
    assert "plans for such robots" not in certified.why


def test_reasons_of_failed_samples_add_up(sampled):
    lost, missed, pressed = judged_by_hand(sampled)
    why = sampled.verdicts.holds.why
    assert f"{(~(lost | missed | pressed)).sum()} of 20 simulated robots hold" in why
    for flags, words in ((lost, "leave the branch"), (missed & ~lost, "do not arrive")):
        assert (f"{flags.sum()} " in why and words in why) or not flags.any()


def test_samples_of_a_plan_that_takes_a_detour_miss_by_their_path():
    far, none = np.full(20, 5.0), np.zeros(20)
    for shortcut, words in (
        ("15 mm short", "20 do not arrive along the path"),
        (None, "20 do not arrive within 2 mm"),
    ):
        found = SampleOutcomes(none > 0, far, none, 2.0, 1.0, wall_known=True, shortcut=shortcut)
        assert words in outcome_sentence(found)


def test_a_sample_may_touch_by_a_millimetre_or_as_much_as_the_plan(sampled):
    assert sample_outcomes(sampled).contact_allowed == 1.0
    assert sample_outcomes(sampled.with_thresholds(contact_allowed=1.7)).contact_allowed == 1.7


def test_plans_without_samples_or_on_a_model_without_snaps_are_not_checked(sampled):
    assert shifted(1).verdicts.holds.word == NOT_CHECKED
    rigid = sampled.evaluate_on("dominant").with_samples(3)
    assert rigid.verdicts.holds.word == NOT_CHECKED


def test_the_share_that_must_hold_and_tip_forces_are_told(sampled):
    why = sampled.with_thresholds(share=0.9).verdicts.holds.why
    assert "90 % must hold." in why
    assert "tip force" not in why
    pushed = replace(sampled.robot.tolerances, tip_force=0.05)
    robot = replace(sampled.robot, tolerances=pushed).to_dict()
    why = replace(sampled, meta=sampled.meta | {"robot": robot}).verdicts.holds.why
    assert "Each has a tip force of 0.05 N in a random direction." in why


@pytest.mark.parametrize("known", [True, False])
def test_samples_say_whether_there_is_no_wall(known):
    outcomes = SampleOutcomes(np.zeros(2, bool), np.zeros(2), np.zeros(2), 2.0, 1.0, wall_known=known)
    assert outcome_sentence(outcomes) == f"2 of 2 simulated robots hold.{'' if known else ' No wall is known.'}"


# All of them

PLANS = {
    "good": shifted(1.0, stability=np.array([0.5]), stability_between=np.array([0.5])),
    "snaps": twisted([0.4, 0.3], snaps=(2,)),
    "fast": moving(one(0, 0.3)),
    "in contact": walled(-3.0, 1.0),
    "not solved": shifted(1.0, success=np.array([False])),
    "not reached": walled(np.nan),
}
FAILED = {
    "good": (),
    "snaps": ("stable",),
    "fast": ("within limits",),
    "in contact": ("within the wall",),
    "not solved": ("solved",),
    "not reached": ("solved",),
}


@pytest.fixture(params=PLANS)
def name(request):
    return request.param


def test_failed_are_the_verdicts_whose_word_is_no(name):
    found = PLANS[name].verdicts
    assert found.failed_names == FAILED[name]
    assert found.unchecked_names == tuple(each.matter for each in found if each.word not in {YES, NO})


@pytest.mark.parametrize("other", [NO, NOT_CHECKED])
def test_the_end_is_reached_where_all_its_verdicts_are_yes(other):
    """Following counts for nothing here; *holds* counts for the robots that tolerances allow alone."""
    passed = Verdicts(**{name: Verdict(name, YES, 0.0, "", "Why.", "") for name in Verdicts._fields})
    assert passed.end_reached
    assert passed.end_reached_as_described
    for name in Verdicts._fields:
        found = passed._replace(**{name: getattr(passed, name)._replace(word=other)})
        assert found.end_reached == (name == "follows")
        assert found.end_reached_as_described == (name in {"follows", "holds"})


def test_every_verdict_has_a_word_and_a_sentence(name):
    for verdict in PLANS[name].verdicts:
        assert verdict.word in WORDS
        assert not verdict.why[0].islower()
        assert verdict.why.endswith(".")


def test_verdicts_cannot_be_changed():
    plan = shifted(1.0)
    with pytest.raises(AttributeError):
        plan.verdicts.stable = plan.verdicts.solved
    with pytest.raises(AttributeError):
        plan.verdicts.solved.word = NO


def test_a_failed_verdict_is_exit_status_1_and_an_interruption_130(name):
    plan = PLANS[name]
    described = plan.meta | {"interrupted": False}
    assert plan_report.exit_status(replace(plan, meta=described)) == (1 if FAILED[name] else 0)
    assert plan_report.exit_status(replace(plan, meta=described | {"interrupted": True})) == 130


def test_failed_samples_are_exit_status_1(sampled):
    assert "holds on built robots" in sampled.verdicts.failed_names
    assert plan_report.exit_status(sampled.with_thresholds(arrival_tolerance=500, error_allowed=500)) == 1


def test_summary_terminal_and_python_have_the_same_words_and_numbers(name, capsys):
    plan = PLANS[name]
    plan = replace(plan, meta=plan.meta | {"failures": {}, "interrupted": False})
    found = json.loads(json.dumps(summary(plan), allow_nan=False))["verdicts"]
    assert [each["word"] for each in found.values()] == [verdict.word for verdict in plan.verdicts]
    assert [each["number"] for each in found.values()] == [verdict.number for verdict in plan.verdicts]
    assert list(found) == list(Verdicts._fields)
    plan_report.print_report(plan)
    text = capsys.readouterr().out
    assert NOT_FOR_PATIENTS in text
    lines = text.partition("numbers")[0].splitlines()
    for verdict in plan.verdicts:
        (line,) = [line for line in lines if line.strip().startswith(f"{verdict.matter} ")]
        assert f" {verdict.word} " in line
        assert verdict.value in line


@pytest.mark.parametrize(
    ("plan", "text"),
    [
        ("fast", "This plan fails 1 of 7 checks: within limits. Not checked: stable, within the wall"),
        ("good", "This plan passes 5 of 7 checks. Not checked: within the wall, holds on built robots."),
    ],
)
@pytest.mark.hazard("what was not checked reads as passed")
def test_what_was_not_checked_is_never_summed_up_as_passed(plan, text, capsys):
    plan_report.print_verdicts(summary(PLANS[plan]))
    assert text in capsys.readouterr().out


def test_pictures_name_what_failed_and_what_was_not_checked(name):
    text = outcome(summary(PLANS[name]))
    assert "NOT CHECKED: " in text
    assert all(matter in text for matter in FAILED[name])
    assert ("no: " in text) == bool(FAILED[name])


def test_a_file_from_before_there_were_verdicts_is_judged_by_the_defaults(tmp_path):
    """Neither a motion without the wall, nor what contact is allowed, nor the way between frames is in it."""
    old = touching(-3.0, 1.0)
    assert old.clearance_between is None
    old.save(tmp_path / "plan.npz")
    plan = Plan.load(tmp_path / "plan.npz")
    assert "e3_free" not in plan.meta
    assert plan.verdicts.failed_names == ("within the wall",)
    assert plan.clearance_between is not None


def test_samples_of_a_file_from_before_are_judged_for_arrival(sampled, tmp_path):
    sampled.save(tmp_path / "plan.npz")
    assert Plan.load(tmp_path / "plan.npz").verdicts.holds == sampled.verdicts.holds


def test_thresholds_stay_with_the_plan(tmp_path):
    problem = Problem("narrow", table_i_robot(), growing(straight(2.0).part(0, 60.0), 4), lumen=straight(2.0))
    for allowed, failed in ((0.5, True), (5.0, False)):
        chosen = {"arrival_tolerance": 3.0, "error_allowed": 4.0, "contact_allowed": allowed, "share": 0.5}
        plan = solve_per_frame(problem, model="dominant", settings=Settings(**chosen))
        plan.save(tmp_path / "plan.npz")
        loaded = Plan.load(tmp_path / "plan.npz")
        assert ("within the wall" in loaded.verdicts.failed_names) == failed
        assert {name: loaded.options[name] for name in THRESHOLDS} == chosen
        assert loaded.verdicts == plan.verdicts


@pytest.mark.parametrize("given", [{"tolerance": 1.0}, {"share": 2.0}, {"error_allowed": -1.0}])
def test_bad_thresholds_are_refused(given):
    with pytest.raises(OptionError):
        shifted(1.0).with_thresholds(**given)


# Random plans against a direct computation

finite = st.floats(0.0, 6.0)


@given(
    offsets=st.lists(st.tuples(finite, finite, st.floats(-8.0, 8.0)), min_size=1, max_size=6),
    clear=st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)), min_size=6, max_size=6),
    arrival=finite,
    error=finite,
    contact=finite,
    on=st.sampled_from(["elastic", "dominant"]),
)
def test_verdicts_equal_a_direct_computation_from_shapes_and_thresholds(
    offsets, clear, arrival, error, contact, on
):
    """Each frame's shape leaves the target by an offset that grows to one of its own at the tip."""
    count, sigma = len(offsets), np.linspace(0, 1, 101)
    shape = np.array([LINE + np.outer(sigma**2, [a, 0, c]) + np.array([0, b, 0]) for a, b, c in offsets])
    plan = walled(*(own for own, _ in clear[:count]), between=[min(pair) for pair in clear[:count]], model=on)
    options = {"arrival_tolerance": arrival, "error_allowed": error, "contact_allowed": contact}
    plan = replace(plan, shape=shape, meta=plan.meta | {"options": options})
    away = np.linalg.norm(shape - plan.target, axis=2)
    weights = np.r_[0.5, np.ones(99), 0.5] / 100
    worst = math.sqrt((away**2 @ weights).max())
    deepest = -min(min(pair) for pair in clear[:count])
    for verdict, number, limit in (
        (plan.verdicts.arrives, away[-1, -1], arrival),
        (plan.verdicts.follows, worst, error),
        (plan.verdicts.within_wall, max(deepest, 0.0), contact),
    ):
        assert verdict.number == pytest.approx(number, abs=1e-6)
        if abs(number - limit) > 1e-6:
            assert verdict.word == (NO if number > limit else YES if on == "elastic" else NOT_CHECKED)


# Exact counts and places in what is said


def with_solver_results(success, kkt, interpolated=()):
    """A plan that stands still, with these marks and residuals of its frames."""
    plan = shifted(*[0.0] * len(success), meta={"interpolated": list(interpolated)})
    return replace(plan, success=np.array(success), kkt=np.array(kkt, dtype=float))


@pytest.mark.parametrize(
    ("success", "kkt", "interpolated", "word", "number", "why", "value"),
    [
        ([True, False, False], [0, 0, 0], (), NO, 1, "2 of 3 frames were not solved.", "1 of 3 frames"),
        ([True, False, False], [0, 0, 0], [3], NO, 1, "1 of 3 frames were not solved.", "1 of 3 frames"),
        ([True, False, True], [0, 0, 0], [2], NOT_CHECKED, 2, "1 of 3 frames are interpolated.", "2 of 3 frames"),
        ([True, True, True], [0, np.nan, np.nan], (), NOT_CHECKED, 1, "2 of 3 frames were given", "1 of 3 frames"),
        ([True, True, True], [0, 0, 0], (), YES, 3, "All 3 frames were solved on the elastic model.", "3 frames"),
    ],
)
def test_frames_are_counted_by_how_they_came_about(success, kkt, interpolated, word, number, why, value):
    found = with_solver_results(success, kkt, interpolated).verdicts.solved
    assert (found.word, found.number, found.value) == (word, number, value)
    assert why in found.why


def test_unknown_shapes_and_margins_are_counted():
    shape = [aside(0.5), np.full((101, 3), np.nan), aside(0.25)]
    plan = shifted(0.5, 0.0, 0.25)
    follows = replace(plan, shape=np.array(shape)).verdicts.follows
    assert (follows.word, follows.value) == (NOT_CHECKED, "0.50 mm in frame 1")
    assert "The shape is not known in 1 of 3 frames." in follows.why
    stable = twisted([0.5, np.nan, 0.4, 0.3]).verdicts.stable
    assert (stable.word, stable.value) == (NOT_CHECKED, "0.300 at frame 4")
    assert stable.why == "The stability margin is not known in 1 frames."


def test_snaps_are_counted_and_the_first_is_named():
    assert "on the way to frame 2." in twisted([0.5, 0.5, 0.5], snaps=[2]).verdicts.stable.why
    assert "on the way to frame 2, and 2 times more." in twisted([0.5] * 3, snaps=[2, 3, 3]).verdicts.stable.why
    assert "unstable in frame 3 or on the way" in twisted([0.5, 0.5, -0.1]).verdicts.stable.why
    assert "bifurcation around frame 2;" in twisted([0.5, 0.0005, 0.1]).verdicts.stable.why


def test_the_wall_that_is_missed_by_most_comes_first(monkeypatch):
    def points(_):
        return {
            name: DeepestPoint(depth, "in frame", frame, 1, 30.0, np.zeros(3))
            for name, depth, frame in (("lumen", 0.2, 1), ("vessel", 0.9, 2), ("nodule", -3.0, 1))
        }

    monkeypatch.setattr(verdicts, "find_deepest_points", points)
    found = walled(0.2, 0.3).verdicts.within_wall
    assert (found.word, found.number) == (NO, pytest.approx(0.9))
    assert found.value == "0.90 mm deep, frame 2 (vessel)"
    assert found.why.index("vessel") < found.why.index("lumen") < found.why.index("nodule")


@pytest.mark.parametrize(("bulge", "word"), [(5.0, YES), (40.0, NO)])
def test_a_tip_that_arrives_beside_the_path_has_taken_a_shortcut(bulge, word):
    shape = LINE + bulge * np.sin(np.pi * SIGMA_GRID)[:, None] * [1.0, 0.0, 0.0]
    found = made([LINE, shape], [LINE, LINE], np.tile(OUT, (2, 1)))
    described = {"options": {}, "failures": {}, "interrupted": False, "model": "elastic"}
    verdict = replace(found, meta=found.meta | described).verdicts.arrives
    assert verdict.word == word
    assert ("does not come along the path" in verdict.why) == (word == NO)
    # Where the tip does not arrive, how it came there is not said.
    late = made([LINE, shape + np.array([0, 0, 9.0])], [LINE, LINE], np.tile(OUT, (2, 1)))
    missed = replace(late, meta=late.meta | described).verdicts.arrives
    assert missed.word == NO
    assert "does not come along the path" not in missed.why


def test_a_robot_that_fails_for_several_reasons_counts_for_the_first():
    """One snaps, misses and presses, two miss and press, three press, and one holds."""
    lost, tip = np.arange(7) < 1, np.where(np.arange(7) < 3, 9.0, 0.0)
    found = SampleOutcomes(lost, tip, np.where(np.arange(7) < 6, 5.0, 0.0), 2.0, 1.0, wall_known=True)
    told = "1 snap or leave the branch, 2 do not arrive within 2 mm, 3 touch the wall"
    assert f"1 of 7 simulated robots hold; {told}" in outcome_sentence(found)


@pytest.mark.parametrize(("allowed", "words"), [(0.5, "0.5 mm is allowed."), (0.0, "none is allowed.")])
def test_contact_is_told_with_what_is_allowed(allowed, words):
    plan = touching(-2.0, 1.0)
    options = {"options": plan.options | {"contact_allowed": allowed}}
    assert replace(plan, meta=plan.meta | options).verdicts.within_wall.why.endswith(words)
