"""Plans of whole problems: accuracy, limits, known configurations, retries and interruption."""

import signal
from dataclasses import replace

import numpy as np
import pytest
from common import named_problem

from ctr_nlp import (
    Limits,
    Problem,
    Robot,
    Settings,
    Tube,
    curve_from_formula,
    growing,
    problem_from_file,
    sequence,
    shape_curve,
    solve_per_frame,
    summary,
    table_i_robot,
)
from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.planning.per_frame import march
from ctr_nlp.solvers.frame import program
from ctr_nlp.solvers.frame.sqp import Sqp

JOINT_E3 = {"cos": 0.35, "arc": 0.36, "line": 1.10, "line_arc": 0.65, "synthesis": 0.02}
TWO_STAGE_E3 = {"cos": 1.81, "arc": 1.62, "line": 7.46, "line_arc": 2.67, "synthesis": 0.98}
AIRWAY_E3 = {
    "chaste_ts002_RLL": 0.60,
    "chaste_ts002_LLL": 0.95,
    "chaste_ts002_RML": 0.85,
    "hra_vhm_left_main": 1.00,
}


def assert_within_limits(plan):
    robot = plan.robot
    assert plan.complete
    assert (plan.q >= robot.lower - 1e-6).all()
    assert (plan.q <= robot.upper + 1e-6).all()
    assert (np.diff(plan.beta, axis=1) >= -1e-6).all()
    assert (np.abs(np.diff(plan.q, axis=0)) <= robot.speed * plan.dt + 1e-6).all()


@pytest.mark.parametrize("name", JOINT_E3)
def test_joint_follows_the_seeds_targets(name):
    plan = solve_per_frame(named_problem(name), "joint", model="dominant")
    found = summary(plan)
    assert found["e3"] <= JOINT_E3[name]
    assert_within_limits(plan)
    steps = found["max_step"]
    assert (steps["alpha"], steps["beta"], steps["theta"]) <= (0.3, 12, 0.1)
    assert steps["beta"] <= 12
    assert steps["theta"] <= 0.1


@pytest.mark.parametrize("name", TWO_STAGE_E3)
@pytest.mark.parametrize("formulation", ["two-stage", pytest.param("two-stage-exact", marks=pytest.mark.slow)])
def test_two_stage_is_no_worse_than_the_seed(name, formulation):
    plan = solve_per_frame(named_problem(name), formulation, direction="backward")
    assert summary(plan)["e3"] <= TWO_STAGE_E3[name]
    assert_within_limits(plan)


@pytest.mark.parametrize("name", AIRWAY_E3)
def test_joint_follows_real_airways(name, shared_data):
    problem = problem_from_file(shared_data / "airways" / f"{name}.csv")
    plan = solve_per_frame(problem, "joint", model="dominant", settings=Settings(contact_weight=0.0))
    assert summary(plan)["e3"] <= AIRWAY_E3[name]
    assert_within_limits(plan)
    assert plan.lumen_radius is not None


def test_sqp_agrees_with_ipopt():
    plans = [
        solve_per_frame(named_problem("arc", 20), model="dominant", solver=solver, direction="backward")
        for solver in ("ipopt", "sqp")
    ]
    assert plans[0].shape == pytest.approx(plans[1].shape, abs=1e-2)
    assert summary(plans[0])["e3"] == pytest.approx(summary(plans[1])["e3"], rel=1e-3)
    assert_within_limits(plans[1])


@pytest.mark.parametrize(("formulation", "tolerance"), [("joint", 0.01), ("two-stage", 0.2)])
def test_synthesis_recovers_its_extensions_and_the_rotations_it_can_know(formulation, tolerance):
    """Beta is unique, and so are differences between tubes' angles up to turns, once tube 3 shows enough.

    The motion hardly counts; without it, where alpha and the tilt turn alike, rounding would decide the way.
    """
    problem = named_problem("synthesis", 50)
    plan = solve_per_frame(problem, formulation, model="dominant", settings=Settings(motion_weight=1e-9))
    assert np.abs(plan.beta - problem.truth[:, 3:6]).max() < tolerance
    between = (np.diff(plan.alpha, axis=1) - np.diff(problem.truth[:, :3], axis=1))[10:]
    assert np.abs((between + np.pi) % (2 * np.pi) - np.pi).max() < 0.02


def test_a_known_configuration_is_found_by_search(robot):
    q = np.array([0.4, -1.1, 2.0, 30.0, 75.0, 120.0, 0.2, -0.3])
    plan = solve_per_frame(Problem("one", robot, sequence([shape_curve(robot, q)])), model="dominant")
    turns = (plan.q[0] - q)[:3]
    assert (turns + np.pi) % (2 * np.pi) - np.pi == pytest.approx(np.zeros(3), abs=1e-4)
    assert plan.q[0, 3:] == pytest.approx(q[3:], abs=1e-3)


@pytest.mark.parametrize("angle", [0.7, 2.9])
def test_turning_the_target_about_the_base_axis_leaves_the_error_unchanged(angle):
    problem = named_problem("cos", 1)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    target = problem.target
    turned = replace(problem, target=replace(target, curves=tuple(c.apply_transform(turn) for c in target.curves)))
    errors = [summary(solve_per_frame(p, model="dominant"))["e3"] for p in (problem, turned)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-4)


def test_a_locked_tilt_stays_zero(cos_problem):
    plan = solve_per_frame(replace(cos_problem, robot=cos_problem.robot.with_locked_tilt()), model="dominant")
    assert np.abs(plan.theta).max() <= 1e-9
    assert_within_limits(plan)


def test_a_motion_leads_from_its_start_at_the_robots_speed(cos_problem):
    start = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    slow = Robot(cos_problem.robot.tubes, Limits(alpha_speed=0.1, beta_speed=20.0))
    plan = solve_per_frame(replace(cos_problem, robot=slow), model="dominant", start=start)
    steps = np.diff(np.vstack([start, plan.q]), axis=0)
    assert (np.abs(steps) <= slow.speed * plan.dt + 1e-6).all()
    assert plan.meta["options"]["direction"] == "forward"


@pytest.mark.parametrize("formulation", ["joint", "two-stage", "two-stage-exact"])
def test_a_motion_can_start_fully_retracted(arc_problem, formulation):
    plan = solve_per_frame(arc_problem, formulation, model="dominant", start=np.zeros(8))
    assert_within_limits(plan)


def test_a_start_outside_the_limits_is_refused(arc_problem):
    with pytest.raises(RobotError, match=r"beta_1 of start is 60 mm; it must lie in \[0, 50\] mm"):
        solve_per_frame(arc_problem, model="dominant", start=[0, 0, 0, 60, 70, 80, 0, 0])


def test_a_start_goes_forward(arc_problem):
    with pytest.raises(OptionError, match="backward"):
        solve_per_frame(arc_problem, model="dominant", start=np.zeros(8), direction="backward")


@pytest.mark.parametrize(
    ("option", "value", "valid"),
    [
        ("formulation", "jiont", "joint, two-stage"),
        ("solver", "ipot", "ipopt, sqp"),
        ("model", "rigid", "dominant"),
        ("direction", "up", "forward, backward, best"),
    ],
)
def test_unknown_names_list_the_valid_ones(arc_problem, option, value, valid):
    with pytest.raises(OptionError, match=f"{option} is '{value}'.*{valid}"):
        solve_per_frame(arc_problem, **{option: value})


@pytest.mark.parametrize(
    "settings", [{"motion_weight": -1}, {"motion_weight": np.nan}, {"jump_width": 0}, {"seed": -1}]
)
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(OptionError, match=next(iter(settings))):
        Settings(**settings)


def test_more_motion_weight_makes_a_smoother_motion(cos_problem):
    plans = [
        solve_per_frame(
            cos_problem, model="dominant", direction="forward", settings=Settings(motion_weight=weight)
        )
        for weight in (1e-6, 1e-1)
    ]
    assert summary(plans[1])["roughness"] < summary(plans[0])["roughness"]


class Failing(NlpFrames):
    """Fails on one frame, whatever the start."""

    _compiled_frames = None

    def _solve(self, index, guess, before):
        if index == 2:
            return FrameResult(guess.q, success=False, status="made to fail")
        return super()._solve(index, guess, before)


def test_a_frame_that_fails_is_marked_and_the_motion_goes_on(cos_problem):
    plan = march(cos_problem, Failing.of(cos_problem, model="dominant"), "forward")
    assert plan.success.tolist() == [True, True, False, True, True, True]
    assert plan.q[2] == pytest.approx(plan.q[1])
    assert plan.meta["failures"] == {"3": "made to fail"}
    assert summary(plan)["failed"] == 1


class Flaky(NlpFrames):
    """Fails on frame 2 from the frame before it, but not from other starts."""

    _compiled_frames = None

    def _solve(self, index, guess, before):
        if index == 2 and guess.warm is not None:
            return FrameResult(guess.q, success=False, status="made to fail")
        return super()._solve(index, guess, before)


def test_a_frame_that_fails_is_tried_from_other_starts(cos_problem):
    plan = march(cos_problem, Flaky.of(cos_problem, model="dominant"), "forward")
    assert_within_limits(plan)


class Interrupted(NlpFrames):
    """Ctrl-C on frame 3."""

    _compiled_frames = None

    def step(self, frame, before):
        if frame == 3:
            signal.raise_signal(signal.SIGINT)
        return super().step(frame, before)


def test_an_interrupted_plan_keeps_what_was_solved(cos_problem):
    plan = march(cos_problem, Interrupted.of(cos_problem, model="dominant"), "forward")
    assert plan.meta["interrupted"]
    assert plan.success.tolist() == [True, True, True, True, False, False]
    assert np.isnan(plan.q[4:]).all()
    assert np.isfinite(summary(plan)["e3"])


class Short(Sqp):
    """Solves no more than two frames in one go."""

    def solve_sequence(self, x0, p, reach, here, warm, local_parameters=None):
        return super().solve_sequence(x0, p[:2], reach, here, warm, local_parameters)


@pytest.mark.parametrize("model", ["dominant", "elastic"])
def test_what_is_not_solved_in_one_go_is_solved_by_steps(cos_problem, model):
    """Of the shape alone: where the tip is led to the end, six frames on the elastic model are not all held."""
    told = {"model": model, "settings": Settings(arrival_weight=0.0)}
    whole, short = (NlpFrames.of(cos_problem, **told) for _ in range(2))
    one = short._compiled_frames
    short.__dict__["_compiled_frames"] = replace(one, solver=Short(one.stage.nlp))
    plans = [march(cos_problem, frames, "forward") for frames in (whole, short)]
    assert all(plan.complete for plan in plans)
    np.testing.assert_allclose(plans[1].q, plans[0].q, atol=1e-5)


TUBES = table_i_robot().tubes
ROBOTS = {
    "one tube": Robot(TUBES[2:]),
    "two tubes": Robot(TUBES[:2]),
    "four tubes": Robot((Tube(80, 40, 1 / 150, 8.0, 6.2), *TUBES)),
    "straight outermost tube": Robot((replace(TUBES[0], curvature=0.0), *TUBES[1:])),
    "transmissions deployed": Robot(TUBES, Limits(beta=[(0, 80), (0, 150), (0, 300)])),
    "carriages kept apart": Robot(TUBES, Limits(carriage_gap=60.0)),
    "never retracted": Robot(TUBES, Limits(beta=[(5, 50), (10, 107), (20, 150)])),
    "Table I taken literally": table_i_robot(literal=True),
}

THIN = "two tubes", "carriages kept apart"
"""Robots for which every formulation and solver is tried in each run."""
SOLVED = [
    pytest.param(name, *way, marks=[] if way == ("joint", "sqp") or name in THIN else [pytest.mark.slow])
    for name in ROBOTS
    for way in (("joint", "ipopt"), ("joint", "sqp"), ("two-stage", "sqp"))
]


@pytest.mark.parametrize(("name", "formulation", "solver"), SOLVED)
def test_any_robot_follows_a_gentle_curve_within_its_limits(name, formulation, solver):
    path = curve_from_formula(lambda u: (0.002 * u**2, 0.0003 * u**2, u), 0.0, 95.0)
    plan = solve_per_frame(
        Problem(name, ROBOTS[name], growing(path, 4)),
        formulation,
        model="dominant",
        solver=solver,
        direction="backward",
    )
    assert_within_limits(plan)
    assert summary(plan)["e3"] < 4
    for q in plan.q:
        plan.robot.check(q)


def test_a_single_frame_and_other_numbers_of_tubes(robot):
    for tubes in (robot.tubes[:2], robot.tubes):
        other = Robot(tubes)
        q = np.concatenate([np.zeros(other.d), np.linspace(30, 90, other.d), [0.1, 0.2]])
        plan = solve_per_frame(Problem("one", other, sequence([shape_curve(other, q)])), model="dominant")
        assert summary(plan)["e3"] < 0.01
        assert summary(plan)["roughness"] == 0


def test_frames_that_were_left_to_ipopt_are_in_the_plan(arc_problem, monkeypatch):
    """Compiled programs that end at once have solved nothing, unless they began at a solution."""
    plain = solve_per_frame(arc_problem, model="dominant", solver="sqp", direction="forward")
    monkeypatch.setattr(program, "SQP_KKT_TOLERANCE", np.inf)
    left = solve_per_frame(arc_problem, model="dominant", solver="sqp", direction="forward")
    assert plain.meta["fallbacks"] == {}
    assert left.complete
    assert set(left.meta["fallbacks"]) >= {str(j + 1) for j in range(1, arc_problem.frames)}
    assert summary(left)["e3"] == pytest.approx(summary(plain)["e3"], rel=1e-2)
