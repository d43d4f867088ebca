"""What no motion can do, against closed forms: growth of the path, and the way from one end to the other."""

import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from frames import horizon
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from ctr_nlp import Limits, Problem, Robot, Target, Tube, curve_from_formula, growing, table_i_robot
from ctr_nlp.exceptions import ProblemError
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.planning.validation import check_ends, check_growth
from ctr_nlp.solvers import CHAIN_SOLVERS, FEASIBILITY_TOLERANCE, Watch

INF = np.inf
LINE = curve_from_formula(lambda u: (0, 0, u), 0.0, 150.0)
ANY = {"alpha_speed": INF, "beta_speed": INF, "theta_speed": INF}


# Growth


def path(lengths, duration, speed):
    """The paper's robot, which reaches 150 mm, before a straight path of given lengths."""
    robot = table_i_robot().with_limits(beta_speed=[INF, INF, speed])
    return Problem("line", robot, Target((LINE,) * len(lengths), tuple(lengths)), duration)


def steady(speed):
    """Ten frames in 10 s that grow by 10 mm each: over nine steps, a slide at speed lags by 90 - 9 speed mm.

    Of that, one half may be ahead and one half behind: 0.75 mm each, 0.5 % of 150 mm. That is at 9.8333 mm/s.
    """
    return path(np.arange(10.0, 101, 10), 10.0, speed)


SAID = (
    "the path of {name} changes its length by 90.0 mm from frame 1 to 10, at 10.0 mm/s; beta_3 may slide at 9.83 "
    "mm/s. Raise its speed, or give a duration of at least 10.2 s"
)


@pytest.mark.parametrize("name", ["line", "line-retraction"])
def test_a_path_that_grows_or_shrinks_too_fast_is_refused_with_its_numbers(name):
    problem = steady(9.83)
    with pytest.raises(ProblemError, match=re.escape(SAID.format(name=name))):
        check_growth(problem if name == "line" else problem.retraction())


def test_a_path_just_slower_than_that_passes():
    check_growth(steady(9.84))
    check_growth(steady(9.84).retraction())


def test_the_duration_that_is_asked_for_is_enough():
    check_growth(replace(steady(9.83), duration=10.2))


@pytest.mark.parametrize("jump", [1.4, -1.4])
def test_a_moments_excess_within_half_a_percent_of_the_reach_passes(jump):
    """In a path at the carriage's speed otherwise, a jump may be 1 % of the reach, 1.5 mm."""
    lengths = np.arange(20.0, 101, 10)
    lengths[4:] += jump
    check_growth(path(lengths, 9.0, 10.0))


def test_a_moments_excess_beyond_that_is_refused_where_it_is():
    lengths = np.full(10, 50.0)
    lengths[6:] += 11.6
    with pytest.raises(ProblemError, match=r"by 11\.6 mm from frame 6 to 7, at 11\.6 mm/s"):
        check_growth(path(lengths, 10.0, 10.0))


def test_excesses_add_up_where_the_path_never_waits():
    """Two jumps of 1 mm pass with a rest of 1 mm between them, and not in a path at full speed."""
    lengths = 20.0 + 10 * np.arange(10)
    lengths[3:] += 1
    lengths[7:] += 1
    with pytest.raises(ProblemError, match="to 8, at"):
        check_growth(path(lengths, 10.0, 10.0))
    lengths[5:] -= 1
    check_growth(path(lengths, 10.0, 10.0))


def test_a_carriage_of_any_speed_follows_any_path():
    check_growth(path([1.0, 150.0, 2.0], 1e-3, INF))


def test_the_first_frame_may_be_of_any_length():
    """Where the motion comes from is not known here."""
    check_growth(path([140.0, 141.0, 142.0], 3.0, 1.0))


@given(st.lists(st.floats(1, 150), min_size=2, max_size=12), st.floats(1, 50))
def test_growth_is_judged_by_all_pairs_of_frames(lengths, speed):
    """By brute force: the most that any stretch is faster than the carriage, against twice 0.75 mm."""
    lengths, step = np.array(lengths), np.abs(np.subtract.outer(range(len(lengths)), range(len(lengths))))
    excess = np.max(np.abs(np.subtract.outer(lengths, lengths)) - speed * step)
    if abs(excess - 1.5) < 1e-9:
        return
    problem = path(lengths, float(len(lengths)), speed)
    if excess < 1.5:
        check_growth(problem)
    else:
        with pytest.raises(ProblemError, match="changes its length"):
            check_growth(problem)


# From one end to the other


ONE = Robot((Tube(160, 150, 0.01, 2, 1),))
TWO = Robot(table_i_robot().tubes[1:])


def moved(robot, start, end, frames, duration, **limits):
    """A problem of so many frames, and its chain between betas (d,) or whole q (2d + 2,) at both ends."""
    made = Robot(robot.tubes, Limits(**(ANY | limits)))
    arc = curve_from_formula(lambda u: (100 * ca.cos(u) - 100, 0, 100 * ca.sin(u)), 0.0, 1.0)
    problem = Problem("between", made, growing(arc, frames), duration)
    known = [np.array(q, dtype=float) for q in (start, end)]
    ends = EndConfigurations(
        *(np.concatenate([np.zeros(made.d), q, [0, 0]]) if len(q) == made.d else q for q in known)
    )
    return problem, horizon(made, problem.target_frames, problem.dt, 1e-4, ends)


def needed(problem, chain):
    """The factor and the limit that check_ends asks for."""
    with pytest.raises(ProblemError) as refused:
        check_ends(problem, chain)
    said = re.search(r": (.*) would have to be ([\d.]+) times what is allowed, at frame (\d+)", str(refused.value))
    assert f"in {problem.duration:g} s" in str(refused.value)
    return float(said[2]), said[1]


def test_a_way_at_constant_speed_needs_its_length_over_the_time():
    """100 mm in five steps of 0.4 s at 2 mm/s: 25 times too fast."""
    factor, name = needed(*moved(ONE, [20], [120], 5, 2.0, beta_speed=2.0))
    assert factor == pytest.approx(25, abs=0.005)
    assert name == "speed of beta_1"


def test_the_slowest_axis_decides():
    """Of 1.5 rad and 100 mm in 2 s at 0.06 rad/s and 3.333 mm/s, angles need 12.5 times and carriages 15."""
    start, end = [0.5, 20, 0, 0], [-1.0, 120, 0, 0]
    factor, name = needed(*moved(ONE, start, end, 4, 2.0, alpha_speed=0.06, beta_speed=10 / 3))
    assert factor == pytest.approx(15, abs=0.005)
    assert name == "speed of beta_1"


def furthest(frames, step, gain=INF):
    """How far steps lead that gain so much at most from rest to rest: 1, 2, .., 2, 1 times that, cut at step."""
    count = np.arange(1, frames + 1)
    ramp = np.minimum(count, count[::-1])
    return np.minimum(gain * ramp, step).sum()


@pytest.mark.parametrize("frames", [2, 3, 6, 9])
@pytest.mark.parametrize("speed", [INF, 6.0])
def test_from_rest_to_rest_half_the_way_is_for_starting_and_half_for_stopping(frames, speed):
    """At 3 mm/s^2 for 2 s, and cut off by a speed: both limits grow by the same factor."""
    problem, chain = moved(ONE, [0], [150], frames, 2.0, beta_speed=speed, beta_acceleration=3.0)
    dt = problem.dt
    factor, name = needed(problem, chain)
    assert factor == pytest.approx(150 / furthest(frames, speed * dt, 3.0 * dt**2), abs=0.0051)
    assert name.removeprefix("speed").removeprefix("acceleration") == " of beta_1"


def by_program(problem, start, end):
    """The least factor by a linear program over betas (T, 2), from differences of the padded sequence by numpy."""
    frames, robot, dt = problem.frames, problem.robot, problem.dt
    size = 2 * frames

    def rows(function):
        known = function(np.zeros(size))
        return np.stack([function(e) - known for e in np.eye(size)], axis=-1), known

    def padded(x, order):
        return np.vstack([[start] * order, x.reshape(frames, 2), [end]])

    matrix, right = [], []
    for order, most in ((1, robot.speed[2:4] * dt), (2, robot.acceleration[2:4] * dt**2)):
        own, known = rows(lambda x, order=order: np.diff(padded(x, order), order, axis=0).ravel())
        limit = np.resize(most, len(known))
        keep = np.isfinite(limit)
        for sign in (1, -1):
            matrix.append(np.column_stack([sign * own, -limit])[keep])
            right.append(-sign * known[keep])
    growth, _ = rows(lambda x: -np.diff(x.reshape(frames, 2), axis=1).ravel())
    matrix.append(np.column_stack([growth, np.zeros(frames)]))
    right.append(np.zeros(frames))
    bounds = [*zip(np.resize(robot.lower[2:4], size), np.resize(robot.upper[2:4], size), strict=True), (0, None)]
    bounds[size - 2 : size] = [(value, value) for value in end]
    cost = np.append(np.zeros(size), 1)
    return linprog(cost, np.vstack(matrix), np.concatenate(right), bounds=bounds).fun


TOGETHER = {"beta_speed": [INF, 0.9], "beta_acceleration": [0.5, INF]}


def test_a_tube_gives_way_to_the_one_around_it():
    """Both tubes come out 100 mm in five steps of 1 s. Each by itself would need 100 / 4.5 times what is allowed.

    One step before its rest at the end, the outer one lacks 0.5 f at most, and the inner one is ahead of it: at
    4 * 0.9 f at most.
    """
    problem, chain = moved(TWO, [0, 0], [100, 100], 5, 5.0, **TOGETHER)
    factor, _ = needed(problem, chain)
    alone = [100 / furthest(5, INF, 0.5), 100 / furthest(5, 0.9)]
    assert alone == pytest.approx([100 / 4.5] * 2)
    assert factor == pytest.approx(100 / 4.1, abs=0.0051)
    assert by_program(problem, [0, 0], [100, 100]) == pytest.approx(100 / 4.1)


def test_a_tube_waits_for_the_one_around_it_where_carriages_would_meet():
    """The same with both in each other's place; the inner one, 188 mm longer, may be 1 mm ahead at most.

    After its first step it is at 0.5 f at most and one before its last at 100 - 0.5 f at least. The outer one, not
    before it and less than 1 mm behind it, goes the way between in three steps of 0.9 f.
    """
    limits = {"beta_speed": [0.9, INF], "beta_acceleration": [INF, 0.5], "carriage_gap": 187.0}
    problem, chain = moved(TWO, [0, 0], [100, 100], 5, 5.0, **limits)
    assert needed(problem, chain)[0] == pytest.approx(99 / 3.7, abs=0.0051)


@pytest.mark.parametrize("start", [[0, 0], [10, 40], [0, 100]])
@pytest.mark.parametrize("end", [[100, 100], [20, 140], [5, 60]])
def test_tubes_of_different_speeds_need_what_a_linear_program_says(start, end):
    limits = {"beta_speed": [0.3, 0.4], "beta_acceleration": [0.2, 0.15]}
    problem, chain = moved(TWO, start, end, 7, 7.0, **limits)
    assert needed(problem, chain)[0] == pytest.approx(by_program(problem, start, end), abs=0.0051)


def test_order_alone_asks_for_no_more():
    """With the same profile for both tubes, order holds all along."""
    problem, chain = moved(TWO, [0, 0], [100, 100], 5, 5.0, beta_speed=[2.0, 1.0])
    assert needed(problem, chain)[0] == pytest.approx(20, abs=0.005)


def test_what_is_just_possible_passes_and_what_is_not_is_refused():
    """150 mm of 150 mm from rest to rest in six frames; a thousandth more or less."""
    dt = 0.5
    enough = 150 / furthest(6, INF, dt**2)
    check_ends(*moved(ONE, [0], [150], 6, 3.0, beta_acceleration=enough * 1.0001))
    factor, _ = needed(*moved(ONE, [0], [150], 6, 3.0, beta_acceleration=enough / 1.01))
    assert factor == pytest.approx(1.01)


def test_any_motion_is_possible_without_limits_of_speed():
    check_ends(*moved(ONE, [0], [150], 2, 1e-3))
    check_ends(*moved(TWO, [0, 0], [100, 140], 2, 1e-3))


def test_to_stand_still_is_always_possible():
    check_ends(*moved(TWO, [30, 60], [30, 60], 3, 1e-3, beta_speed=1e-3, beta_acceleration=1e-3))


@pytest.mark.parametrize("solver", CHAIN_SOLVERS)
@pytest.mark.parametrize("spare", [1.02, 1.5])
def test_where_the_check_passes_a_solver_finds_a_feasible_motion(solver, spare):
    """Coupled tubes, with a little more speed and acceleration than the least."""
    grown = {name: [value * 100 / 4.1 * spare for value in values] for name, values in TOGETHER.items()}
    problem, chain = moved(TWO, [0, 0], [100, 100], 5, 5.0, **grown)
    check_ends(problem, chain)
    solution = CHAIN_SOLVERS[solver](chain)(np.zeros(chain.lower.size) + 0.5, Watch())
    assert chain.violation(chain.evaluate(solution.x)[1]) <= FEASIBILITY_TOLERANCE
