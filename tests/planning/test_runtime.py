"""The steerer for loops at run time: the frames of a plan, one by one, within limits whatever the target does."""

import functools
import math
import threading

import numpy as np
import pytest
from common import named_problem
from frames import joint
from hypothesis import example, given
from hypothesis import strategies as st
from lumens import bent
from strategies import numbers, seeds

from ctr_nlp import (
    Problem,
    Settings,
    Steerer,
    curve_from_formula,
    growing,
    shapes,
    solve_per_frame,
    table_i_robot,
)
from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.ocp.nlp import kkt_residual
from ctr_nlp.ocp.terms import ShapeDistance
from ctr_nlp.ocp.terms.shape import TARGET_SAMPLE_STRIDE
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.robot import MM_PER_RAD
from ctr_nlp.solvers import FEASIBILITY_TOLERANCE
from ctr_nlp.solvers.frame.adapter import KKT_TOLERANCE
from ctr_nlp.solvers.frame.run import FrameSequence

Q0 = np.array([3.0, 3, 3, 30, 70, 105, 0, 0])
DT, WEIGHT = 0.1, Settings().motion_weight
RETRACTED = 1e-3
"""A shape shorter than this, in mm, has no derivatives to compare: they depend on the order of beta / beta_d."""
ROBOTS = {
    "seed": table_i_robot(),
    "tilt locked": table_i_robot().with_locked_tilt(),
    "carriages apart": table_i_robot().with_limits(carriage_gap=60.0, theta_speed=math.inf),
}
EVERY_ROBOT = pytest.mark.parametrize("name", ROBOTS)


@functools.cache
def problem_of(name):
    """The NLP of a robot's step, to judge by."""
    return joint(ROBOTS[name], Settings())[0].nlp


def shape(robot, q):
    return shapes(robot, np.asarray(q)[None])[0]


def objective(robot, q, before, target, dt, weight=WEIGHT):
    """Mean square distance at equal sigma by the trapezoidal rule, and the motion's cost, in mm^2."""
    points, wanted = shape(robot, q)[::TARGET_SAMPLE_STRIDE], target[::TARGET_SAMPLE_STRIDE]
    squares = np.sum((points - wanted) ** 2, axis=-1)
    mm = np.array([MM_PER_RAD] * robot.d + [1.0] * robot.d + [MM_PER_RAD] * 2)
    return np.trapezoid(squares, SIGMA_GRID[::TARGET_SAMPLE_STRIDE]) + weight / dt**2 * np.sum(
        (mm * (q - before)) ** 2
    )


def residual(name, steerer, q, before, target, dt):
    """KKT residual of a step by the NLP's own functions and the multipliers of the solver."""
    nlp, robot = problem_of(name), ROBOTS[name]
    root = math.sqrt(WEIGHT) / dt
    values = {
        "tubes": robot.numbers,
        "shape_roots": ShapeDistance().roots,
        "target": target[::TARGET_SAMPLE_STRIDE],
    }
    values |= {} if robot.carriage_gap is None else {"gap": robot.carriage_gap}
    p = nlp.pack(values | {"previous": before, "motion_root": root})
    lower = np.maximum(robot.lower, before - robot.speed * dt)
    upper = np.minimum(robot.upper, before + robot.speed * dt)
    lam_x, lam_g = np.split(steerer._run.multipliers[0], [len(q)])
    return kkt_residual(nlp, q, p, lower, upper, lam_x, lam_g)


def assert_limits(robot, before, after, dt=DT):
    robot.check(after)
    assert (after >= robot.lower).all()
    assert (after <= robot.upper).all()
    assert (np.abs(after - before) <= robot.speed * dt + 1e-12 * np.abs(before)).all()


def stepped(name, targets, q=Q0, dt=DT):
    """The configurations of a new steerer for targets one after the other; every step is judged."""
    robot = ROBOTS[name]
    steerer, motion = Steerer(robot, q, dt, model="dominant"), []
    before = steerer.q
    for target in targets:
        after = steerer.step(target)
        assert_limits(robot, before, after, dt)
        assert steerer.objective == pytest.approx(objective(robot, after, before, target, dt), rel=1e-8, abs=1e-8)
        stay = objective(robot, before, before, target, dt)
        assert steerer.objective <= stay * (1 + 1e-9) + 1e-9, "worse than to stay"
        if after[2 * robot.d - 1] > RETRACTED:
            at = residual(name, steerer, after, before, target, dt)
            assert steerer.kkt == pytest.approx(at, rel=1e-6, abs=1e-6 * (1 + np.sqrt(stay)))
        assert steerer.is_solved == (steerer.kkt <= KKT_TOLERANCE)
        motion.append(after)
        before = after
    return np.array(motion), steerer


# The frames of a plan


@pytest.mark.parametrize(("name", "frames"), [("arc", 30), ("cos", 30), ("line_arc", 100)])
def test_steps_give_the_frames_of_a_plan(name, frames):
    problem = named_problem(name, frames)
    first = solve_per_frame(problem, "joint", model="dominant", solver="sqp", direction="forward").q[0]
    plan = solve_per_frame(problem, "joint", model="dominant", solver="sqp", direction="forward", start=first)
    steerer = Steerer(problem.robot, first, problem.dt, model="dominant")
    iterations = 0
    assert plan.success.all()
    for number, frame in enumerate(problem.target_frames):
        q = steerer.step(frame.points)
        iterations += steerer.iterations
        shape, others = shapes(problem.robot, q[None])[0], [0, 1, 2, 5, 6, 7]
        np.testing.assert_allclose(q[others], plan.q[number, others], atol=1e-3)
        np.testing.assert_allclose(
            shape, plan.shape[number], atol=1e-4, err_msg="where outer tubes end is known to a residual only"
        )
        assert steerer.is_solved
        assert steerer.objective == pytest.approx(plan.objective[number], abs=1e-6)
        assert steerer.kkt == pytest.approx(plan.kkt[number], abs=1e-6)
    assert iterations <= plan.meta["iterations"], "a step begins where the motion would go on"


def test_steps_from_a_configuration_far_from_the_target_give_the_frames_of_a_plan():
    problem = named_problem("arc", 40)
    plan = solve_per_frame(problem, "joint", model="dominant", solver="sqp", direction="forward", start=Q0)
    steerer = Steerer(problem.robot, Q0, problem.dt, model="dominant")
    for number, frame in enumerate(problem.target_frames):
        steerer.step(frame.points)
        assert steerer.objective == pytest.approx(plan.objective[number], abs=1e-6)


def test_the_motion_weight_of_the_settings_is_used(arc_problem):
    target, dt = arc_problem.target_frames[2].points, 0.1
    slow = Steerer(arc_problem.robot, Q0, dt, Settings(motion_weight=1.0), model="dominant")
    free = Steerer(arc_problem.robot, Q0, dt, Settings(motion_weight=0.0), model="dominant")
    assert np.abs(slow.step(target) - Q0).max() < 0.5 * np.abs(free.step(target) - Q0).max()
    for steerer, weight in ((slow, 1.0), (free, 0.0)):
        expected = objective(arc_problem.robot, steerer.q, Q0, target, dt, weight)
        assert steerer.objective == pytest.approx(expected, rel=1e-9)


# Within a lumen


def within(radius):
    """A problem of following a lumen's bent path, and a first configuration of its frames."""
    lumen = bent(radius)
    problem = Problem("bent", table_i_robot(), growing(lumen.part(0.0, 110.0), 12), lumen=lumen)
    settings = Settings(arrival_weight=0.0)  # steps are not told how much of the motion has passed
    return (
        problem,
        settings,
        solve_per_frame(problem, model="dominant", direction="forward", settings=settings).q[0],
    )


def test_steps_within_a_lumen_give_the_frames_of_a_plan_that_keeps_clear_of_its_wall():
    problem, settings, first = within(4.0)
    plan = solve_per_frame(
        problem, model="dominant", solver="sqp", direction="forward", start=first, settings=settings
    )
    steerer = Steerer(problem.robot, first, problem.dt, settings, model="dominant", lumen=problem.lumen)
    free = Steerer(problem.robot, first, problem.dt, settings, model="dominant")
    motion, alone = (np.array([each.step(f.points) for f in problem.target_frames]) for each in (steerer, free))
    np.testing.assert_allclose(
        motion[:-1], plan.q[:-1], atol=1e-3, err_msg="both are solved up to a residual only"
    )
    assert steerer.is_solved
    assert plan.clearance.min() > 0
    # In the last frame the wall pushes. A step begins where the motion would go on, a plan's frame at the frame
    # before: beside corners of the wall's cost they end apart. From the same place they end at the same point.
    np.testing.assert_allclose(shapes(problem.robot, motion[-1:])[0], plan.shape[-1], atol=0.02)
    for number in range(1, problem.frames):
        there = Steerer(
            problem.robot, plan.q[number - 1], problem.dt, settings, model="dominant", lumen=problem.lumen
        )
        q = there.step(problem.target_frames[number].points)
        np.testing.assert_allclose(q, plan.q[number], atol=1e-6)
        assert there.objective == pytest.approx(plan.objective[number], rel=1e-6)
    left = Lumen.from_curve(problem.lumen).clearance(
        problem.robot, alone[:, 3:6], SIGMA_GRID, shapes(problem.robot, alone)
    )
    assert left.min() < -0.1


def test_a_wall_without_weight_is_none():
    problem, _, first = within(4.0)
    settings = Settings(contact_weight=0.0)
    walled, free = (
        Steerer(problem.robot, first, 0.1, settings, model="dominant", lumen=each)
        for each in (problem.lumen, None)
    )
    for frame in problem.target_frames[:4]:
        np.testing.assert_array_equal(walled.step(frame.points), free.step(frame.points))


@pytest.mark.parametrize("lumen", [3.0, curve_from_formula(lambda u: (0.0, 0.0, u), 0.0, 1.0)])
def test_a_lumen_without_radius_is_refused(lumen):
    with pytest.raises(OptionError, match=r"lumen is .* a curve with a radius"):
        Steerer(table_i_robot(), Q0, DT, model="dominant", lumen=lumen)


# Limits, whatever the target does


@EVERY_ROBOT
@given(seed=seeds, scale=st.sampled_from([1.0, 30.0, 200.0, 1e4]), dt=st.sampled_from([1e-3, 0.1, 2.0]))
def test_targets_of_random_points_never_lead_out_of_the_limits(name, seed, scale, dt):
    rng = np.random.default_rng(seed)
    stepped(name, rng.normal(scale=scale, size=(4, len(SIGMA_GRID), 3)), dt=dt)


@EVERY_ROBOT
@example(seed=42903)  # going on would end at a solution that is worse than to stay
@given(seed=seeds)
def test_targets_that_jump_from_shape_to_shape_never_lead_out_of_the_limits(name, seed):
    robot, rng = ROBOTS[name], np.random.default_rng(seed)
    d, targets = robot.d, []
    for _ in range(5):
        q = np.clip(rng.uniform(-3, 3, len(Q0)), robot.lower, robot.upper)
        q[d : 2 * d] = np.sort(rng.uniform(0, robot.reach, d)).clip(None, robot.upper[d : 2 * d])
        targets += [shape(robot, q)] * 2
    motion, _ = stepped(name, targets)
    assert np.ptp(motion, axis=0)[: 2 * d].max() > 0, "it moved at all"


@given(to=st.tuples(*[numbers(-1e3, 1e3)] * 3))
def test_a_target_in_a_single_point_never_leads_out_of_the_limits(to):
    stepped("seed", [np.tile(to, (len(SIGMA_GRID), 1))] * 3)


def test_a_target_out_of_reach_is_approached_until_the_limits_hold():
    """A straight line of 300 mm along z: everything is driven out at the speed limit, then stays."""
    robot, target = ROBOTS["seed"], np.outer(SIGMA_GRID, [0.0, 0, 300])
    motion, steerer = stepped("seed", [target] * 60)
    assert motion[0, 5] == pytest.approx(Q0[5] + robot.speed[5] * DT)
    assert motion[-1, 5] == pytest.approx(robot.reach)
    np.testing.assert_allclose(motion[-1], motion[-2], atol=1e-2)
    assert steerer.is_solved


def test_a_robot_at_its_limits_stays_within_them():
    robot = ROBOTS["seed"]
    for q in (
        np.concatenate([np.zeros(3), robot.lower[3:6], [0, 0]]),
        np.concatenate([np.ones(3), robot.upper[3:6], robot.upper[6:]]),
        np.array([1.0, 2, 3, 50, 50, 50, *robot.lower[6:]]),
    ):
        stepped("seed", [np.outer(SIGMA_GRID, [40.0, 20, 90])] * 3 + [np.zeros((len(SIGMA_GRID), 3))] * 3, q)


def test_bounds_that_meet_are_kept_exactly():
    q = np.concatenate([Q0[:6], [0, 0]])
    motion, _ = stepped("tilt locked", np.random.default_rng(0).normal(scale=50, size=(5, len(SIGMA_GRID), 3)), q)
    assert (motion[:, 6:] == 0).all()


@pytest.mark.parametrize("far", [1e20, 1e160, 1e300, 1.7e308])
def test_after_a_target_beyond_all_arithmetic_the_robot_stands_and_the_next_step_is_as_ever(arc_problem, far):
    robot, target = arc_problem.robot, arc_problem.target_frames[2].points
    steerer = Steerer(robot, Q0, DT, model="dominant")
    after = steerer.step(np.full((len(SIGMA_GRID), 3), far))
    assert_limits(robot, Q0, after)
    assert not steerer.is_solved
    fresh = Steerer(robot, after, DT, model="dominant")
    np.testing.assert_allclose(steerer.step(target), fresh.step(target), atol=1e-6)
    assert steerer.is_solved


def test_where_nothing_better_is_found_the_robot_stays_and_the_next_step_is_as_ever(arc_problem, monkeypatch):
    """No result counts as one within the limits of a step, wherever the solver ends."""
    steerer, target = Steerer(arc_problem.robot, Q0, DT, model="dominant"), arc_problem.target_frames[2].points
    with monkeypatch.context() as patched:
        patched.setattr(steerer._run._given, "feasible", -1.0)
        np.testing.assert_array_equal(steerer.step(target), Q0)
    assert not steerer.is_solved
    np.testing.assert_array_equal(
        steerer.step(target), Steerer(arc_problem.robot, Q0, DT, model="dominant").step(target)
    )
    assert steerer.is_solved


# What it says and keeps


def test_before_the_first_step_nothing_is_solved():
    steerer = Steerer(ROBOTS["seed"], Q0.tolist(), DT, model="dominant")
    np.testing.assert_array_equal(steerer.q, Q0)
    assert not steerer.is_solved
    assert math.isnan(steerer.objective)
    assert math.isnan(steerer.kkt)
    assert steerer.iterations == 0


def test_a_robot_that_has_the_targets_shape_stays_without_an_iteration():
    steerer = Steerer(ROBOTS["seed"], Q0, DT, model="dominant")
    q = steerer.step(shape(ROBOTS["seed"], Q0))
    np.testing.assert_allclose(q, Q0, atol=1e-9)
    assert steerer.iterations == 0
    assert steerer.objective == pytest.approx(0, abs=1e-12)
    assert steerer.is_solved


def test_a_step_that_ends_far_from_a_kkt_point_is_not_called_solved(arc_problem, monkeypatch):
    steerer = Steerer(arc_problem.robot, Q0, DT, model="dominant")
    call = FrameSequence.__call__

    def unsure(run, frames):
        solved = call(run, frames)
        run.kkt[:] = 2 * KKT_TOLERANCE
        return solved

    monkeypatch.setattr(FrameSequence, "__call__", unsure)
    assert_limits(arc_problem.robot, Q0, steerer.step(arc_problem.target_frames[2].points))
    assert not steerer.is_solved


def test_arrays_given_and_returned_are_copies(arc_problem):
    frames = [frame.points.copy() for frame in arc_problem.target_frames]
    clean = Steerer(arc_problem.robot, Q0, DT, model="dominant")
    expected = [clean.step(frame) for frame in frames]
    q0 = Q0.copy()
    steerer = Steerer(arc_problem.robot, q0, DT, model="dominant")
    q0[:] = np.nan
    for frame, q in zip(frames, expected, strict=True):
        target = frame.copy()
        returned = steerer.step(target)
        np.testing.assert_array_equal(target, frame)
        np.testing.assert_array_equal(returned, q)
        target[:] = returned[:] = np.nan
        np.testing.assert_array_equal(steerer.q, q)


def motions(arc_problem, cos_problem):
    """Two series of targets that differ, and the motions of a steerer alone for each."""
    series = [[frame.points for frame in problem.target_frames] * 20 for problem in (arc_problem, cos_problem)]
    steerers = [Steerer(arc_problem.robot, Q0, DT, model="dominant") for _ in series]
    alone = [
        [steerer.step(target) for target in targets] for steerer, targets in zip(steerers, series, strict=True)
    ]
    assert np.abs(alone[0][-1] - alone[1][-1]).max() > 1e-3
    return series, alone


def test_two_steerers_in_turn_move_as_each_alone(arc_problem, cos_problem):
    series, alone = motions(arc_problem, cos_problem)
    steerers = [Steerer(arc_problem.robot, Q0, DT, model="dominant") for _ in series]
    for number in range(min(map(len, series))):
        for steerer, targets, expected in zip(steerers, series, alone, strict=True):
            np.testing.assert_array_equal(steerer.step(targets[number]), expected[number])


def test_two_steerers_in_two_threads_move_as_each_alone(arc_problem, cos_problem):
    series, alone = motions(arc_problem, cos_problem)
    steerers = [Steerer(arc_problem.robot, Q0, DT, model="dominant") for _ in series]
    found = [[], []]
    together = threading.Barrier(2)

    def follow(which):
        together.wait(timeout=60)
        found[which] = [steerers[which].step(target) for target in series[which]]

    threads = [threading.Thread(target=follow, args=(which,)) for which in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    for which in range(2):
        np.testing.assert_array_equal(found[which], alone[which])


# Bad input


@pytest.mark.parametrize("shape", [(100, 3), (101, 2), (3, 101), (303,), (1, 101, 3), (0, 3)])
def test_a_target_of_another_shape_is_refused_and_changes_nothing(shape):
    steerer = Steerer(ROBOTS["seed"], Q0, DT, model="dominant")
    with pytest.raises(OptionError) as refused:
        steerer.step(np.zeros(shape))
    assert f"target has shape {shape}" in str(refused.value)
    assert "(101, 3)" in str(refused.value)
    np.testing.assert_array_equal(steerer.q, Q0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [(0, 0), (1, 1), (100, 2)], ids=["first", "a sample that is not used", "last"])
def test_a_target_that_is_not_finite_is_refused_and_changes_nothing(arc_problem, value, place):
    steerer, good = Steerer(arc_problem.robot, Q0, DT, model="dominant"), arc_problem.target_frames[2].points
    bad = good.copy()
    bad[place] = value
    with pytest.raises(OptionError, match=r"target .*finite"):
        steerer.step(bad)
    np.testing.assert_array_equal(steerer.q, Q0)
    np.testing.assert_array_equal(
        steerer.step(good), Steerer(arc_problem.robot, Q0, DT, model="dominant").step(good)
    )


@pytest.mark.parametrize("dt", [0, 0.0, -0.1, math.nan, math.inf, -math.inf])
def test_a_time_step_that_is_no_positive_number_is_refused(dt):
    with pytest.raises(OptionError) as refused:
        Steerer(ROBOTS["seed"], Q0, dt, model="dominant")
    assert str(refused.value) == f"dt is {dt} s; it must be a finite number > 0"


@pytest.mark.parametrize(
    ("q", "message"),
    [
        ([*Q0[:5], 151, 0, 0], r"beta_3 of q is 151 mm; it must lie in \[0, 150\]"),
        ([*Q0[:3], -1, *Q0[4:]], r"beta_1 of q is -1 mm; it must lie in"),
        ([*Q0[:7], 3.2], r"theta_y of q is 3.2 rad; it must lie in"),
        ([*Q0[:3], 40, 30, 105, 0, 0], r"beta_1 of q is 40 mm and exceeds beta_2, 30 mm"),
        ([np.nan, *Q0[1:]], r"alpha_1 of q is nan"),
        ([np.inf, *Q0[1:]], r"alpha_1 of q is inf"),
        (Q0[:7], r"q has shape \(7,\); it must be \(8,\)"),
        ([*Q0, 0], r"q has shape \(9,\); it must be \(8,\)"),
        (Q0[None], r"q has shape \(1, 8\); it must be \(8,\)"),
        ([], r"q has shape \(0,\)"),
    ],
)
def test_a_configuration_that_the_robot_cannot_have_is_refused(q, message):
    with pytest.raises(RobotError, match=message):
        Steerer(ROBOTS["seed"], q, DT, model="dominant")


def test_carriages_too_near_are_refused():
    """With a gap of 60 mm, beta_2 may exceed beta_1 by 112 - 60 mm."""
    with pytest.raises(RobotError, match=r"carriages 1 and 2 of q are 50 mm apart; carriage_gap is 60 mm"):
        Steerer(ROBOTS["carriages apart"], [0, 0, 0, 10, 72, 105, 0, 0], DT, model="dominant")


def test_without_compiled_code_there_is_no_steerer_and_the_error_says_why(monkeypatch):
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    with pytest.raises(OptionError, match="CTR_NLP_COMPILE is 0"):
        Steerer(ROBOTS["seed"], Q0, DT, model="dominant")


def test_the_order_of_tubes_is_kept_to_the_tolerance_of_solutions():
    """Points of which the far ones come first: every tube wants to be shorter than the one around it."""
    motion, _ = stepped("seed", [np.outer(SIGMA_GRID[::-1], [0.0, 30, 100])] * 20)
    assert np.diff(motion[:, 3:6], axis=1).min() >= -FEASIBILITY_TOLERANCE
