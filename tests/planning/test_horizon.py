"""Whole motions at once: what solve_horizon promises, against the problem itself and against frame by frame."""

import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from common import NAMES, named_problem
from frames import horizon
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ctr_nlp import problem_from_file, solve_horizon, solve_per_frame, summary
from ctr_nlp.exceptions import OptionError, ProblemError, RobotError
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.planning.horizon import Horizon
from ctr_nlp.planning.multistart import SolvedStart, describe_failures
from ctr_nlp.solvers import CHAIN_SOLVERS
from ctr_nlp.solvers.motion.chain_solution import evaluate_chain_solution
from ctr_nlp.support.interrupt import deferred_interrupt

AIRWAYS = ("chaste_ts002_RLL", "chaste_ts002_LLL", "chaste_ts002_RML", "hra_vhm_left_main")


@pytest.fixture(scope="module")
def problem():
    return named_problem("cos", 12)


@pytest.fixture(scope="module")
def plan(problem):
    return solve_horizon(problem, model="dominant")


def excess(plan, order=1):
    """By how much differences of q exceed the limits of speed (1) or acceleration (2) at most."""
    most = (plan.robot.speed, plan.robot.acceleration)[order - 1] * plan.dt**order
    return float((np.abs(np.diff(plan.q, n=order, axis=0)) - most).max())


def objective(problem, plan, weight):
    """J / duration in mm^2 from positions at the samples that the formulation takes, by numpy alone."""
    weights = np.full(21, 1 / 20)
    weights[[0, -1]] /= 2
    shape = (((plan.shape - plan.target)[:, ::5] ** 2).sum(axis=-1) @ weights).mean()
    steps = np.diff(plan.q, axis=0) * problem.robot.mm_per_unit
    return shape + weight * (steps**2).sum() / problem.dt**2 / problem.frames


def test_a_horizon_is_solved_keeps_all_limits_and_beats_its_start(problem, plan):
    assert plan.complete
    assert plan.kkt.max() <= 1e-5
    for q in plan.q:
        problem.robot.check(q)
    assert excess(plan) <= 1e-6
    assert plan.objective.mean() < min(start["start_objective"] for start in plan.meta["starts"]) - 1e-3
    assert np.isnan(plan.solve_time).all()


def test_every_motion_run_frame_by_frame_is_a_start_by_default(problem, plan):
    single = solve_horizon(problem, model="dominant", starts=1)
    assert len(single.meta["starts"]) == 1
    assert len(plan.meta["starts"]) > 1
    assert plan.objective.mean() <= single.objective.mean() * (1 + 1e-9)
    again = solve_horizon(problem, model="dominant", initial=[plan.q, single.q])
    assert len(again.meta["starts"]) == 2


def test_the_objective_is_the_one_of_the_design(problem, plan):
    weight = plan.meta["options"]["motion_weight"]
    assert plan.objective.mean() == pytest.approx(objective(problem, plan, weight), rel=1e-9)


def test_the_default_weight_makes_motion_a_tenth_of_the_starts_shape_errors(problem, plan):
    start = solve_per_frame(problem, model="dominant")
    weight = plan.meta["options"]["motion_weight"]
    shape, whole = objective(problem, start, 0.0), objective(problem, start, weight)
    assert whole - shape == pytest.approx(0.1 * shape, rel=1e-6)


def test_a_heavier_weight_gives_a_smoother_and_less_exact_motion(problem, plan):
    smooth = solve_horizon(problem, model="dominant", motion_weight=3e-4, initial=[plan.q])
    exact = solve_horizon(problem, model="dominant", motion_weight=1e-8, initial=[plan.q])
    assert summary(smooth)["roughness"] < summary(plan)["roughness"] < summary(exact)["roughness"]
    assert summary(exact)["e3"] < summary(plan)["e3"] < summary(smooth)["e3"]


def test_both_solvers_find_the_same_motion_from_the_same_start(problem, plan):
    other = solve_horizon(problem, model="dominant", solver="ipopt", initial=[plan.q + 0.01], motion_weight=1e-4)
    same = solve_horizon(problem, model="dominant", solver="banded", initial=[plan.q + 0.01], motion_weight=1e-4)
    assert other.complete
    assert other.objective.mean() == pytest.approx(same.objective.mean(), rel=1e-6)
    np.testing.assert_allclose(other.q, same.q, atol=1e-3)


def test_the_duration_changes_without_retuning(problem, plan):
    free = problem.robot.with_limits(alpha_speed=np.inf, beta_speed=np.inf, theta_speed=np.inf)
    slow, fast = (
        solve_horizon(replace(problem, robot=free, duration=seconds), model="dominant", initial=[plan.q])
        for seconds in (40.0, 10.0)
    )
    weights = [one.meta["options"]["motion_weight"] for one in (slow, fast)]
    assert weights[0] == pytest.approx(16 * weights[1], rel=1e-9)
    np.testing.assert_allclose(slow.q, fast.q, atol=1e-4)


def test_a_robot_that_stands_somewhere_starts_from_there_and_ends_where_told(problem, plan):
    start, end = plan.q[0] + [0.1, -0.1, 0.1, 0, 0.5, 1, 0.01, 0], plan.q[-1].copy()
    end[0] += 0.2
    found = solve_horizon(problem, model="dominant", start=start, end=end)
    assert found.complete
    np.testing.assert_allclose(found.q[-1], end, atol=1e-12)
    assert (np.abs(found.q[0] - start) <= problem.robot.speed * problem.dt + 1e-6).all()
    assert found.meta["options"]["start"] == start.tolist()


def test_accelerations_are_kept_and_given_ends_are_at_rest(problem):
    robot = problem.robot.with_limits(alpha_acceleration=4.0, beta_acceleration=60.0, theta_acceleration=1.0)
    limited = replace(problem, robot=robot)
    free = solve_horizon(limited, model="dominant")
    assert free.complete
    assert excess(free, 2) <= 1e-6
    start = np.concatenate([np.zeros(3), [1.0, 5.0, 12.0], np.zeros(2)])
    fixed = solve_horizon(limited, model="dominant", start=start, end=free.q[-1])
    assert fixed.complete
    padded = np.vstack([start, start, fixed.q, fixed.q[-1]])
    assert (np.abs(np.diff(padded, n=2, axis=0)) <= robot.acceleration * problem.dt**2 + 1e-6).all()


def test_tighter_speeds_are_kept(problem):
    robot = problem.robot.with_limits(alpha_speed=0.3, theta_speed=0.05)
    found = solve_horizon(replace(problem, robot=robot), model="dominant")
    assert found.complete
    assert excess(found) <= 1e-6


def test_a_locked_tilt_stays(problem):
    found = solve_horizon(replace(problem, robot=problem.robot.with_locked_tilt()), model="dominant")
    assert found.complete
    assert (found.theta == 0).all()


def test_a_retraction_is_the_way_back(problem, plan):
    weight = plan.meta["options"]["motion_weight"]
    back = solve_horizon(problem.retraction(), model="dominant", initial=[plan.q[::-1]], motion_weight=weight)
    assert back.complete
    np.testing.assert_allclose(back.target, plan.target[::-1])
    assert back.objective.mean() <= plan.objective.mean() * (1 + 1e-6)
    fresh = solve_horizon(problem.retraction(), model="dominant", start=plan.q[-1])
    assert fresh.complete
    assert (np.abs(fresh.q[0] - plan.q[-1]) <= plan.robot.speed * plan.dt + 1e-6).all()


def test_a_motion_played_backwards_is_a_plan(problem, plan):
    back = plan.reversed()
    np.testing.assert_array_equal(back.q, plan.q[::-1])
    np.testing.assert_array_equal(back.time, plan.time)
    assert summary(back)["e3"] == pytest.approx(summary(plan)["e3"], rel=1e-14)  # squares in another order
    assert back.meta["reversed"]
    assert not back.reversed().meta["reversed"]


@pytest.mark.parametrize("solver", ["banded", "ipopt"])
def test_the_result_is_never_worse_than_its_start(problem, solver):
    rng = np.random.default_rng(3)
    for _ in range(3):
        q = np.tile(rng.uniform([-1, -1, -1, 2, 8, 20, -0.1, -0.1], [1, 1, 1, 5, 15, 60, 0.1, 0.1]), (12, 1))
        found = solve_horizon(problem, model="dominant", solver=solver, initial=[q], motion_weight=1e-5)
        (start,) = found.meta["starts"]
        assert found.objective.mean() <= start["start_objective"] * (1 + 1e-9)
        assert excess(found) <= 1e-6


def test_several_starts_are_reproducible_and_the_best_is_kept(problem):
    first, second = (solve_horizon(problem, model="dominant", starts=8, motion_weight=1e-6) for _ in range(2))
    np.testing.assert_array_equal(first.q, second.q)
    starts = first.meta["starts"]
    assert len(starts) == 8
    solved = [one["objective"] for one in starts if one["solved"]]
    assert first.objective.mean() == pytest.approx(min(solved), rel=1e-12)


def test_starts_in_processes_give_what_they_give_in_one(problem):
    alone = solve_horizon(problem, model="dominant", starts=3, motion_weight=1e-5)
    beside = solve_horizon(problem, model="dominant", starts=3, jobs=2, motion_weight=1e-5)
    assert [one["objective"] for one in beside.meta["starts"]] == pytest.approx(
        [one["objective"] for one in alone.meta["starts"]], rel=1e-9
    )
    np.testing.assert_allclose(beside.shape, alone.shape, atol=1e-6)


def test_many_frames_start_from_some_of_them():
    found = solve_horizon(named_problem("arc", 430), model="dominant")
    assert found.complete
    assert excess(found) <= 1e-6
    assert summary(found)["e3"] <= 0.319


def test_a_plan_can_start_from_another(problem, plan):
    again = solve_horizon(
        problem, model="dominant", initial=[plan.q], motion_weight=plan.meta["options"]["motion_weight"]
    )
    assert again.complete
    assert again.objective.mean() == pytest.approx(plan.objective.mean(), rel=1e-6)


def test_progress_tells_iterations_and_objective(problem):
    told = []
    solve_horizon(
        problem, model="dominant", starts=1, progress=lambda done, total, note: told.append((done, total, note))
    )
    own = [(done, total) for done, total, note in told if "objective" in note]
    assert len(own) > 2
    assert [done for done, _ in own] == list(range(len(own)))
    assert all(total > done for done, total in own)
    assert "objective" in told[-1][2]


def test_ctrl_c_leaves_the_best_feasible_motion_so_far(problem):
    def press(done, total, note):
        if "objective" in note and done == 2:  # at 3 the start is found to be nearly optimal
            signal.raise_signal(signal.SIGINT)

    found = solve_horizon(problem, model="dominant", progress=press)
    assert found.meta["interrupted"]
    assert not found.success.any()
    (start,) = found.meta["starts"]  # the others were not begun
    assert start["status"] == "Interrupted"
    assert found.objective.mean() <= start["start_objective"] * (1 + 1e-12)
    assert excess(found) <= 1e-6
    for q in found.q:
        problem.robot.check(q)


def test_ctrl_c_before_the_horizon_leaves_what_the_frames_gave(problem):
    found = solve_horizon(problem, model="dominant", progress=lambda *_: signal.raise_signal(signal.SIGINT))
    assert found.meta["interrupted"]
    assert not found.success.any()
    assert found.meta["starts"] == []
    assert excess(found) <= 1e-6


def test_ctrl_c_stops_ipopt_too(problem):
    def press(done, total, note):
        if "objective" in note and done == 3:
            signal.raise_signal(signal.SIGINT)

    found = solve_horizon(problem, model="dominant", solver="ipopt", progress=press)
    assert found.meta["interrupted"]
    assert found.meta["starts"][0]["status"] == "User_Requested_Stop"


def test_ctrl_c_stops_other_processes(problem):
    hard = named_problem("bronchus", 300)
    alarm = threading.Timer(6.0, signal.raise_signal, [signal.SIGINT])
    motions = [np.tile(np.full(8, 0.1), (300, 1))]
    with deferred_interrupt() as interrupted:
        alarm.start()
        begin = time.perf_counter()
        found = Horizon(hard, model="dominant", settings=Settings(contact_weight=0.0)).solve(
            motions, 1e-6, starts=60, jobs=2
        )
        assert time.perf_counter() - begin < 60
        assert interrupted()
    assert found.meta["interrupted"]
    assert "Interrupted" in {one["status"] for one in found.meta["starts"]}


def test_a_failed_solve_leaves_its_feasible_start_and_is_no_solution(problem, plan, monkeypatch):
    def gives_up(chain):
        return lambda x0, watch, *_: evaluate_chain_solution(
            chain, x0 + 1, np.zeros(chain.bounds[0].size), "Gave_Up", 0
        )

    monkeypatch.setitem(CHAIN_SOLVERS, "banded", gives_up)
    found = solve_horizon(problem, model="dominant", initial=[plan.q])
    assert not found.success.any()
    assert np.isnan(found.kkt).all()
    np.testing.assert_array_equal(found.q, plan.q)
    assert found.meta["failures"]["all"].startswith("Gave_Up, KKT residual")


def test_what_a_point_exceeds_is_said_by_limit_frame_and_amount(problem):
    start = np.concatenate([np.full(3, 3.0), [1.0, 5.0, 12.0], np.zeros(2)])
    chain = horizon(problem.robot, problem.target_frames, problem.dt, 1e-6, EndConfigurations(start))
    x = np.tile(start - np.repeat([2.0, 0.0], [1, 7]), 12)
    x[5 * 8 + 3] = -0.25
    solution = evaluate_chain_solution(chain, x, np.zeros(chain.bounds[0].size), "Gave_Up", 0)
    found = describe_failures(chain, SolvedStart(solution, x, chain.parameters, False, np.inf, 0.0))
    assert not solution.success
    assert found["1"].startswith("speed of alpha_1 exceeded by 0.333 rad; relax it")
    assert found["6"].startswith("limits of beta_1 exceeded by 0.25 mm")
    assert set(found) == {"1", "6"}


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"solver": "sqp"}, OptionError, "solver of a horizon is 'sqp'; it must be one of banded, ipopt"),
        ({"model": "rigid"}, OptionError, "model of a horizon is 'rigid'"),
        ({"motion_weight": -1.0}, OptionError, "motion_weight is -1.0 s\\^2"),
        ({"motion_weight": np.nan}, OptionError, "motion_weight is nan"),
        ({"starts": 0}, OptionError, "starts is 0"),
        ({"jobs": 0}, OptionError, "jobs is 0"),
        ({"initial": [np.zeros((3, 8))]}, OptionError, r"shape \(3, 8\); it must be \(12, 8\)"),
        ({"initial": [np.full((12, 8), np.nan)]}, OptionError, "finite"),
        (
            {"start": [0, 0, 0, 60, 70, 80, 0, 0]},
            RobotError,
            r"beta_1 of start is 60 mm; it must lie in \[0, 50\] mm",
        ),
        ({"end": [0, 0, 0, 60, 70, 80, 0, 0]}, RobotError, "beta_1 of end is 60"),
        ({"start": [0.0] * 7}, RobotError, "start has shape"),
        ({"start": [0] * 8, "end": [40] + [0] * 7}, ProblemError, "speed of alpha_1 would have to be 2.00 times"),
    ],
)
def test_bad_input_is_refused_before_solving(problem, options, error, words, monkeypatch):
    monkeypatch.setattr(
        "ctr_nlp.planning.horizon.horizon.per_frame_motions", lambda *_: pytest.fail("began to solve")
    )
    with pytest.raises(error, match=words):
        solve_horizon(problem, **{"model": "dominant"} | options)


def test_one_frame_is_no_motion():
    with pytest.raises(OptionError, match="frames is 1"):
        solve_horizon(named_problem("arc", 1), model="dominant")


def test_a_path_faster_than_the_tube_is_refused_with_numbers(problem):
    slow = replace(problem, robot=problem.robot.with_limits(beta_speed=10.0))
    with pytest.raises(ProblemError, match=r"at 1\d\.\d mm/s; beta_3 may slide at 10 mm/s.*at least 1\d\.\d s"):
        solve_horizon(slow, model="dominant")


@settings(max_examples=5)
@example(seed=265, weight=1e-7)  # its third tube is turned by 24 turns on the way to the solution
@given(seed=st.integers(0, 1000), weight=st.sampled_from([1e-7, 1e-5, 1e-3]))
def test_from_any_motion_the_result_is_feasible_and_solved(seed, weight):
    problem = named_problem("line_arc", 6)
    rng = np.random.default_rng(seed)
    q = rng.uniform([-3] * 3 + [0] * 3 + [-0.3] * 2, [3] * 3 + [50, 107, 150] + [0.3] * 2, (6, 8))
    found = solve_horizon(problem, model="dominant", initial=[q], motion_weight=weight)
    assert excess(found) <= 1e-6
    for one in found.q:
        problem.robot.check(one)
    assert found.complete


E3 = {"cos": 0.27, "arc": 0.33, "line": 1.08, "line_arc": 0.64, "synthesis": 0.005}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_100_frames_reach_the_kinematic_limit(name):
    found = solve_horizon(named_problem(name), model="dominant")
    assert found.complete
    numbers = summary(found)
    assert numbers["e3"] <= E3.get(name, 1.0)
    steps = numbers["max_step"]
    assert steps["alpha"] <= 0.2 + 1e-6
    assert steps["beta"] <= 9.0 + 1e-6
    assert steps["theta"] <= 0.06


@pytest.mark.slow
@pytest.mark.parametrize("name", AIRWAYS)
def test_real_airways_are_followed_better_and_more_smoothly_than_frame_by_frame(shared_data, name):
    problem = problem_from_file(shared_data / "airways" / f"{name}.csv")
    whole, frames = (
        summary(solve_horizon(problem, model="dominant")),
        summary(solve_per_frame(problem, model="dominant")),
    )
    assert whole["failed"] == 0
    assert whole["e3"] <= 1.01 * frames["e3"]
    assert whole["roughness"] < frames["roughness"]
