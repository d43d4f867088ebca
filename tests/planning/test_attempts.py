"""Attempts: what is kept of a solver's work, whatever that does; side by side in processes; random starts."""

import itertools
import signal
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from frames import horizon
from hypothesis import given
from hypothesis import strategies as st
from strategies import configurations, robots, seeds

from ctr_nlp import Limits, Problem, Robot, Tube, curve_from_formula, growing, table_i_robot
from ctr_nlp.exceptions import RobotError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.planning.motions import perturb_motion
from ctr_nlp.planning.multistart import (
    SolvedStart,
    best_solved_start,
    describe_failures,
    distinct,
    no_worse,
    solve_from_motion,
    wall_rounds_done,
)
from ctr_nlp.planning.starts.processes import Task, solve_starts_in_processes
from ctr_nlp.solvers import CHAIN_SOLVERS, FEASIBILITY_TOLERANCE, Iterate, Solution
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.solvers.motion.chain_solution import evaluate_chain_solution
from ctr_nlp.support.interrupt import deferred_interrupt

START = np.array([3, 3, 3, 20, 20, 30, 0, 0.0])
EVERY_SOLVER = pytest.mark.parametrize("solver", CHAIN_SOLVERS)


@pytest.fixture(scope="module")
def task(arc_problem):
    return Task(
        arc_problem.robot,
        arc_problem.target_frames,
        arc_problem.dt,
        1e-3,
        EndConfigurations(start=START),
        "banded",
        KINEMATIC_MODELS["dominant"],
    )


@pytest.fixture(scope="module")
def chain(task):
    return horizon(task.robot, task.frames, task.dt, task.motion_weight, task.ends, fastest_functions)


@pytest.fixture(scope="module")
def solution(chain):
    return CHAIN_SOLVERS["banded"](chain)(standing(), lambda iterate: False)


def standing():
    """The robot stands still where it starts: allowed, and bad."""
    return np.tile(START, 4)


def feasible(chain, x):
    return chain.violation(chain.evaluate(x)[1]) <= FEASIBILITY_TOLERANCE


def tried(chain, solve, x0, stop=lambda: False):
    return solve_from_motion(chain, lambda _: solve, x0, None, stop)


class Fake:
    """A solver that shows iterates to the watch and then returns a point, as a success where it is allowed."""

    def __init__(self, chain, shown, returned, success=True):
        self.chain, self.shown, self.returned, self.success = chain, shown, returned, success
        self.starts, self.answers = [], []

    def __call__(self, x0, watch, barrier=0.0, multipliers=None, tolerance=None):
        self.starts.append(x0)
        for number, x in enumerate(self.shown):
            objective, value = self.chain.evaluate(x)
            self.answers.append(watch(Iterate(number, objective, self.chain.violation(value), 1.0, x)))
        nothing = np.zeros(len(self.chain.bounds[0]))
        found = evaluate_chain_solution(self.chain, self.returned, nothing, "Fake", 1)
        return replace(found, success=self.success and feasible(self.chain, self.returned))


# One attempt


@EVERY_SOLVER
def test_a_solution_is_handed_on_as_it_is(chain, solver):
    solve = CHAIN_SOLVERS[solver](chain)
    found, alone = tried(chain, solve, standing()), solve(standing(), lambda iterate: False)
    np.testing.assert_array_equal(found.solution.x, alone.x)
    assert found.solution.objective == alone.objective < found.start_objective
    assert found.solution.success
    assert found.feasible
    assert found.start_objective == chain.evaluate(standing())[0]


@pytest.mark.parametrize("success", [True, False])
def test_the_start_is_kept_from_a_solver_that_makes_it_worse(chain, solution, success):
    """A local solution may be worse than where the solver began."""
    fake = Fake(chain, [standing()], standing(), success)
    found = tried(chain, fake, solution.x)
    np.testing.assert_array_equal(found.solution.x, solution.x)
    assert found.solution.objective == solution.objective
    assert found.feasible


def test_the_best_iterate_is_kept_from_a_solver_that_fails(chain, solution):
    half = 0.5 * (standing() + solution.x)
    fake = Fake(chain, [standing(), half, standing()], standing() + 50.0, success=False)
    found = tried(chain, fake, standing())
    np.testing.assert_array_equal(found.solution.x, half)
    assert found.solution.objective == chain.evaluate(half)[0]
    assert not found.solution.success
    assert found.feasible


def test_a_better_iterate_that_is_not_allowed_is_not_kept(chain, solution):
    """The solution with its second frame tilted faster than the robot can."""
    beyond = solution.x.copy()
    beyond[8 + 7] += 0.8 * 2.5 + 0.1
    assert not feasible(chain, beyond)
    assert chain.evaluate(beyond)[0] < chain.evaluate(standing())[0]
    fake = Fake(chain, [beyond], beyond, success=False)
    np.testing.assert_array_equal(tried(chain, fake, standing()).solution.x, standing())


def test_a_failure_is_followed_by_one_more_try_from_the_best_point(chain, solution):
    half = 0.5 * (standing() + solution.x)
    fake = Fake(chain, [half], standing(), success=False)
    tried(chain, fake, standing())
    assert len(fake.starts) == 2
    np.testing.assert_array_equal(fake.starts, [standing(), half])


def test_work_that_was_stopped_is_not_begun_again(chain):
    fake = Fake(chain, [standing()], standing(), success=False)
    found = tried(chain, fake, standing(), stop=lambda: True)
    assert len(fake.starts) == 1
    assert fake.answers == [True]
    np.testing.assert_array_equal(found.solution.x, standing())


@EVERY_SOLVER
def test_an_interrupted_solve_leaves_the_best_feasible_point(chain, solver):
    seen = []

    def report(iterate):
        seen.append(iterate)

    found = solve_from_motion(chain, CHAIN_SOLVERS[solver], standing(), report, lambda: len(seen) == 12)
    assert len(seen) == 12
    assert not found.solution.success
    assert found.feasible
    allowed = [one.objective for one in seen if one.violation <= FEASIBILITY_TOLERANCE]
    assert found.solution.objective <= min([*allowed, found.start_objective]) + 1e-9


@given(seeds)
def test_an_attempt_is_never_worse_than_a_start_that_is_allowed(chain, solution, seed):
    """Between two allowed points all are; the solver that starts there is a random one."""
    rng = np.random.default_rng(seed)
    points = [standing() + part * (solution.x - standing()) for part in rng.uniform(0, 1, 4)]
    jumbled = np.clip(points[1] + rng.normal(size=points[1].size), chain.lower.ravel(), chain.upper.ravel())
    fake = Fake(chain, [points[1], jumbled, points[2]], (jumbled, points[3])[seed % 2], bool(seed % 3))
    found = tried(chain, fake, points[0])
    start = chain.evaluate(points[0])[0]
    assert found.feasible == feasible(chain, found.solution.x)
    assert found.feasible
    assert found.start_objective == start
    assert no_worse(found.solution.objective, start)
    assert found.solution.objective == chain.evaluate(found.solution.x)[0]


def test_a_start_that_is_not_allowed_is_replaced_by_the_nearest_that_is(chain):
    """Angles run to and fro faster than they may, extensions are at random, and the solver does nothing.

    Allowed motions are a convex set: from the nearest of them, no other lies in the direction of the start. To
    1e-3 mm^2: 100 rows with a complementarity of 1e-6 each leave a tenth of that.
    """
    rng = np.random.default_rng(0)
    away = standing().reshape(4, 8) + np.outer([1, -1, 1, -1], [3, 3, 3, 0, 0, 0, 1.2, 1.2])
    away[:, 3:6] = rng.uniform(0, [50, 107, 150], (4, 3))
    away = away.ravel()
    assert not feasible(chain, away)
    fake = Fake(chain, [], away, success=False)
    found = tried(chain, fake, away)
    (start,) = fake.starts[:1]
    assert found.feasible
    np.testing.assert_array_equal(found.solution.x, start)
    assert found.start_objective == found.solution.objective == chain.evaluate(start)[0]
    scale = np.tile(chain.scale, 4)
    for _ in range(50):
        other = standing().reshape(4, 8) + rng.uniform(-0.9, 0.9, (4, 8)) * [2.5, 2.5, 2.5, 0, 0, 0, 1, 1]
        other[:, 3:6] = np.sort(rng.uniform(0, 50, (4, 3)), axis=1)
        assert feasible(chain, other.ravel())
        assert (scale * (away - start)) @ (scale * (other.ravel() - start)) <= 1e-3


def test_a_start_beyond_the_bounds_is_put_back_first(chain, solution):
    beyond = standing()
    beyond[6::8] = 9.0
    fake = Fake(chain, [], beyond, success=False)
    found = tried(chain, fake, beyond)
    assert found.feasible
    assert (np.abs(found.solution.x[6::8]) <= np.pi).all()


@EVERY_SOLVER
@pytest.mark.parametrize("seed", range(3))
def test_any_start_leads_to_a_solution(chain, solver, seed):
    """Frames at random within the bounds."""
    rng = np.random.default_rng(seed)
    low, high = (np.tile(np.clip(bound, -4, 150), 4) for bound in (table_i_robot().lower, table_i_robot().upper))
    start = rng.uniform(low, high)
    assert not feasible(chain, start)
    found = tried(chain, CHAIN_SOLVERS[solver](chain), start)
    assert found.feasible
    assert found.solution.success


def random_task(seed):
    """A random robot at random limits, before an arc it can reach, from one end at random; and a random motion."""
    rng = np.random.default_rng(seed)
    d, wall = int(rng.integers(1, 5)), 0.1
    outer, curved = 2 - 4 * wall * np.arange(d), np.cumsum(rng.uniform(10, 45, d))
    lengths = np.maximum.accumulate(curved + rng.uniform(0, 60, d))
    tubes = [
        Tube(lengths[i], curved[i], rng.uniform(0, 0.04), outer[i], outer[i] - 2 * wall)
        for i in range(d)
    ]  # fmt: skip
    choices = {
        "alpha_speed": (np.inf, 2.0, 0.2),
        "beta_speed": (np.inf, 90.0, 20.0),
        "theta_speed": (np.inf, 0.8, 0.05),
        "alpha_acceleration": (np.inf, 2.0, 0.3),
        "beta_acceleration": (np.inf, 100.0, 30.0),
        "theta_acceleration": (np.inf, 0.8, 0.1),
    }
    limits = {name: float(rng.choice(values)) for name, values in choices.items()}
    if rng.random() < 0.3:
        limits["theta"] = (0.0, 0.0)
    robot = Robot(tuple(tubes), Limits(**limits))

    def q():
        beta = np.minimum.accumulate((np.sort(rng.uniform(0, 1, d)) * robot.upper[d : 2 * d])[::-1])[::-1]
        return np.concatenate([rng.uniform(-3, 3, d), beta, np.clip(rng.uniform(-0.5, 0.5, 2), *bounds)])

    bounds = robot.lower[-2:], robot.upper[-2:]
    radius, length, frames = rng.uniform(30, 300), robot.reach * rng.uniform(0.5, 1), int(rng.integers(2, 11))
    arc = curve_from_formula(
        lambda u: (radius * ca.cos(u) - radius, 0, radius * ca.sin(u)), 0, min(length / radius, 6)
    )
    problem = Problem("random", robot, growing(arc, frames), float(rng.uniform(2, 10)))
    ends = (
        EndConfigurations(),
        EndConfigurations(start=q()),
        EndConfigurations(end=q()),
        EndConfigurations(start=np.zeros(2 * d + 2)),
    )[rng.integers(4)]
    weight = float(rng.choice([0.0, 1e-9, 1e-4, 1e-1]))
    return Task(
        robot, problem.target_frames, problem.dt, weight, ends, "banded", KINEMATIC_MODELS["dominant"]
    ), np.concatenate([q() for _ in range(frames)])


def solved_parts(numbers):
    """The part of random tasks that was solved; all end feasible, since a robot may stand still at one end."""
    solved = []
    for number in numbers:
        task, start = random_task(number)
        chain = horizon(task.robot, task.frames, task.dt, task.motion_weight, task.ends)
        found = tried(chain, CHAIN_SOLVERS["banded"](chain), start)
        assert found.feasible, number
        solved.append(found.solution.success)
    return np.mean(solved)


def test_random_tasks_become_feasible_and_most_are_solved():
    assert solved_parts(range(4)) >= 3 / 4


@pytest.mark.slow
def test_many_random_tasks_become_feasible_and_most_are_solved():
    assert solved_parts(range(100, 200)) >= 0.95


def test_an_objective_is_no_worse_than_one_that_is_equal_but_for_rounding():
    assert no_worse(1.0 + 1e-12, 1.0)
    assert no_worse(1e6 * (1 + 1e-12), 1e6)
    assert no_worse(0.5, 1.0)
    assert not no_worse(1.0 + 1e-6, 1.0)


# Several


def made(objective, success, start, allowed=True):
    found = Solution(
        np.zeros(1), objective, 0.0 if success else 1.0, success, "Fake", 1, np.zeros(1), np.zeros(0), np.zeros(1)
    )
    return SolvedStart(found, np.zeros((4, 8)), np.zeros(0), allowed, start, 0.0)


@pytest.mark.parametrize(
    ("attempts", "best"),
    [
        ([(3.0, True, 5.0), (2.0, True, 5.0), (4.0, True, 5.0)], 1),
        ([(3.0, True, 5.0), (2.0, False, 5.0)], 0),
        ([(3.0, True, np.inf), (2.0, False, 2.0)], 1),
        ([(3.0, True, np.inf), (2.0, False, np.inf)], 0),
        ([(2.0, False, 5.0, False), (3.0, False, 5.0, True)], 1),
        ([(3.0, False, 5.0, False), (2.0, False, 5.0, False)], 1),
    ],
    ids=["least", "solved", "not worse than a start", "no start", "feasible", "least of the failed"],
)
def test_the_best_of_several_attempts(attempts, best):
    several = [made(*one) for one in attempts]
    assert best_solved_start(several) is several[best]


def test_attempts_are_distinct_by_their_objectives_and_come_best_first():
    several = [made(3.0, True, 5.0), made(1.0, False, 5.0), made(2.0, True, 5.0), made(3.0 + 1e-7, True, 5.0)]
    assert distinct(several) == [several[2], several[0], several[1]]


def test_rounds_end_once_slacks_are_what_they_have_to_be_or_go_to_and_fro():
    assert not wall_rounds_done([])
    assert not wall_rounds_done([0.3, 0.4])
    assert not wall_rounds_done([0.3, 0.009])
    assert wall_rounds_done([0.3, 0.004])
    assert not wall_rounds_done([0.3, 0.4, 0.2])
    assert wall_rounds_done([0.3, 0.4, 0.28])


def test_a_solution_has_no_failures(chain, solution):
    assert describe_failures(chain, SolvedStart(solution, solution.x, chain.parameters, True, 1.0, 0.0)) == {}


def test_failures_name_the_worst_limit_of_each_frame(chain):
    x = standing().reshape(4, 8)
    x[1, 0] += 2.0 * 2.5 + 0.25
    x[1:, 6] += 0.8 * 2.5 + 0.125
    x[2:, 0] = x[1, 0]
    found = evaluate_chain_solution(chain, x.ravel(), np.zeros(len(chain.bounds[0])), "Fake", 1)
    said = describe_failures(chain, SolvedStart(found, found.x, chain.parameters, False, np.inf, 0.0))
    assert said == {"2": "speed of alpha_1 exceeded by 0.25 rad; relax it, or give more time"}


def test_a_failure_within_limits_says_how_far_it_is_from_a_solution(chain):
    found = evaluate_chain_solution(chain, standing(), np.zeros(len(chain.bounds[0])), "Fake", 1)
    said = describe_failures(chain, SolvedStart(found, found.x, chain.parameters, True, 1.0, 0.0))
    assert said == {"all": f"Fake, KKT residual {found.kkt:.1e}"}


def test_a_description_is_per_frame_and_fit_for_a_file():
    one = replace(made(8.0, True, 12.0), seconds=0.5).to_meta(4)
    assert one == {
        "start_objective": 3.0,
        "objective": 2.0,
        "solved": True,
        "status": "Fake",
        "iterations": 1,
        "seconds": 0.5,
    }
    assert made(8.0, True, np.inf).to_meta(4)["start_objective"] is None


# Side by side


def test_processes_find_what_one_alone_finds(task, chain):
    """The same code from the same starts: to the last bit."""
    motions = [standing(), standing() + 0.3]
    told = []
    several = solve_starts_in_processes(task, motions, 2, lambda done, total, note: told.append((done, total)))
    for motion, found in zip(motions, several, strict=True):
        alone = tried(chain, CHAIN_SOLVERS["banded"](chain), motion)
        np.testing.assert_array_equal(found.solution.x, alone.solution.x)
        assert found.solution.objective == alone.solution.objective
        assert found.start_objective == alone.start_objective
        assert (found.feasible, found.solution.status) == (alone.feasible, alone.solution.status)
    assert told[-1] == (2, 2)


def test_processes_end_early_when_told_to(task, chain):
    """Those at work in other processes are cut short, and answer with a feasible point."""
    with deferred_interrupt():
        signal.raise_signal(signal.SIGINT)
        several = solve_starts_in_processes(task, [standing()] * 3, 2, None)
    assert several
    assert all(found.solution.status == "Interrupted" for found in several)
    assert all(found.feasible for found in several)


# Random starts


@st.composite
def motions(draw):
    """A robot and a motion of five frames within its limits and order."""
    robot = draw(robots())
    return robot, np.array([draw(configurations(robot)) for _ in range(5)])


@given(motions(), seeds)
def test_random_changes_keep_limits_and_order(drawn, seed):
    robot, motion = drawn
    for changed in itertools.islice(perturb_motion(robot, motion, seed), 3):
        assert changed.shape == motion.shape
        for q in changed:
            robot.check(q)


@pytest.mark.parametrize(
    "limits",
    [
        Limits(beta=[(0, 50), (30, 60), (55, 150)]),
        Limits(theta=(0, 0), alpha=(-1, 1)),
    ],
    ids=["lower limits", "locked"],
)
def test_random_changes_keep_every_robots_limits(limits):
    robot = Robot(table_i_robot().tubes, limits)
    motion = np.tile([0, 0, 0, 30, 45, 70, 0, 0.0], (6, 1))
    robot.check(motion[0])
    broken = set()
    for changed in itertools.islice(perturb_motion(robot, motion, 1), 40):
        for q in changed:
            try:
                robot.check(q)
            except RobotError as error:
                broken.add(str(error))
    assert not broken


def test_random_changes_are_the_same_for_the_same_seed():
    robot, motion = table_i_robot(), np.tile(START, (6, 1))

    def three(seed):
        return np.array(list(itertools.islice(perturb_motion(robot, motion, seed), 3)))

    np.testing.assert_array_equal(three(4), three(4))
    assert np.abs(three(4) - three(5)).max() > 0.1
    first, second, _ = three(4)
    assert np.abs(first - second).max() > 0.1


def test_random_changes_are_smooth():
    """Five half waves over 400 frames of a motion far from all limits: each step is a small part of the whole."""
    robot, motion = table_i_robot().with_limits(theta=(-9, 9)), np.tile([0, 0, 0, 1, 2, 140, 0, 0.0], (400, 1))
    for changed in itertools.islice(perturb_motion(robot, motion, 2), 5):
        moved = (changed - motion)[:, [0, 1, 2, 6, 7]]
        assert (np.abs(np.diff(moved, axis=0)).max(axis=0) < 0.05 * np.ptp(moved, axis=0)).all()
        assert (np.ptp(moved, axis=0) > 0.01).all()


def test_the_motion_itself_is_left_alone():
    motion = np.tile(START, (6, 1))
    before = motion.copy()
    next(perturb_motion(table_i_robot(), motion, 3))
    np.testing.assert_array_equal(motion, before)
