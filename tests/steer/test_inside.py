"""What the wall may cost: the promise on e3 holds for whole runs, or no clearance is kept."""

from dataclasses import replace

import numpy as np
import pytest
from lumens import straight

from ctr_nlp import Problem, Settings, growing, solve_horizon, solve_per_frame, summary, table_i_robot
from ctr_nlp.formulations.wall import Wall
from ctr_nlp.models import MODELS
from ctr_nlp.plan.account import remarks
from ctr_nlp.steer.inside import BISECTIONS, LIGHTEST, Outcome, affordable
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.starts import search
from ctr_nlp.target.lumen import Lumen

ROBOT = table_i_robot()
WALL = Wall(ROBOT, Lumen.around(straight(4.0)), MODELS["dominant"], 30.0, 0.05)
BOTH = pytest.mark.parametrize("solve", [solve_horizon, solve_per_frame])
NO_WALL = Settings(contact_weight=0.0)


def never():
    return False


# The weight of contact


def test_the_whole_weight_is_taken_where_it_will_do():
    assert affordable(WALL, lambda wall: wall.weight, lambda weight: True, never) == (WALL, 30.0)


@pytest.mark.parametrize("most", [0.05, 1.0, 29.0])
def test_else_the_largest_weight_that_will_do_is_bisected_for(most):
    wall, found = affordable(WALL, lambda wall: wall.weight, lambda weight: weight <= most, never)
    assert wall.weight == found <= most
    assert found * LIGHTEST ** (-1 / 2**BISECTIONS) > most


def test_where_not_even_the_lightest_will_do_there_is_none():
    tried = []
    assert affordable(WALL, lambda wall: tried.append(wall.weight), lambda _: False, never) is None
    assert tried == [30.0, pytest.approx(30.0 * LIGHTEST)]


@pytest.mark.parametrize("solved", range(4))
def test_an_interruption_leaves_only_what_will_do(solved):
    """Weights of up to 1 will do; Ctrl-C comes after so many."""
    tried = []

    def solve(wall):
        tried.append(wall.weight)
        return wall.weight

    found = affordable(WALL, solve, lambda weight: weight <= 1.0, lambda: len(tried) >= solved)
    assert found is None if solved < 2 else found[1] <= 1.0
    assert len(tried) == max(solved, 1)


@pytest.mark.parametrize(
    ("failed", "e2", "cost", "expected"),
    [
        (0, [1.1, 1.1], 0.1, True),
        (0, [1.2, 1.1], 0.1, False),
        (0, [9.0, 9.0], np.inf, True),
        (1, [1.0, 1.0], np.inf, False),
        (0, [0.5, np.nan], 0.1, True),
        (0, [1.5, np.nan], 0.1, False),
        (0, [np.nan, np.nan], 0.1, False),
    ],
)
def test_a_motion_will_do_where_no_more_frames_fail_and_e3_is_as_promised(failed, e2, cost, expected):
    """e3 is compared over the frames whose shape is known."""
    free = Outcome(0, np.array([1.0, 1.0]))
    assert Outcome(failed, np.array(e2)).affords(free, cost) == expected


# Plans


@pytest.fixture(scope="module")
def problem():
    """Tubes that are bent, in a straight lumen just wide enough."""
    return Problem("straight", ROBOT, growing(straight(4.0), 8), lumen=straight(4.0))


@pytest.fixture(scope="module")
def free(problem):
    return {solve: solve(problem, settings=NO_WALL) for solve in (solve_horizon, solve_per_frame)}


@BOTH
def test_a_plan_holds_the_motion_that_there_is_without_the_wall(solve, problem, free, tmp_path):
    plan = solve(problem)
    np.testing.assert_array_equal(plan.free, free[solve].q)
    assert plan.meta["e3_free"] == summary(plan)["e3_free"] == summary(free[solve])["e3"]
    assert free[solve].free is None
    plan.save(tmp_path / "plan.npz")
    np.testing.assert_array_equal(plan.load(tmp_path / "plan.npz").free, plan.free)
    np.testing.assert_array_equal(plan.reversed().free, plan.free[::-1])


@BOTH
def test_on_another_model_e3_is_compared_with_the_free_motion_on_that_model(solve, problem, free):
    plan = solve(problem).on("elastic")
    assert plan.meta["e3_free"] == pytest.approx(summary(free[solve].on("elastic"))["e3"])


def test_frames_that_are_lost_within_the_wall_lose_the_wall(problem, free, monkeypatch):
    solved = NlpFrames.run

    def run(self, frames, before):
        for frame, (result, seconds) in zip(frames, solved(self, frames, before), strict=True):
            lost = self.near is not None and frame == 3
            yield replace(result, success=result.success and not lost), seconds

    monkeypatch.setattr(NlpFrames, "run", run)
    plan = solve_per_frame(problem, settings=Settings(clearance_cost=np.inf))
    assert plan.complete
    assert plan.meta["contact_weight"] is None
    assert "this is the motion without the wall" in " ".join(remarks(plan, summary(plan)))
    np.testing.assert_array_equal(plan.q, free[solve_per_frame].q)


def test_a_horizon_that_is_not_solved_within_the_wall_loses_the_wall(problem, free, monkeypatch):
    tried = search.attempt

    def attempt(chain, *others):
        one = tried(chain, *others)
        failed = replace(one.solution, success=False)
        return one if chain.surroundings is None else replace(one, solution=failed)

    monkeypatch.setattr(search, "attempt", attempt)
    plan = solve_horizon(problem, settings=Settings(clearance_cost=np.inf))
    assert plan.complete
    assert plan.meta["contact_weight"] is None
    np.testing.assert_array_equal(plan.q, free[solve_horizon].q)
