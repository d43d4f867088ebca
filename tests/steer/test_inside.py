"""What the wall may cost: the promise on e3 holds for whole runs, or no clearance is kept."""

from dataclasses import replace

import numpy as np
import pytest
from lumens import straight

from ctr_nlp import Problem, Settings, growing, solve_horizon, solve_per_frame, summary, table_i_robot
from ctr_nlp.formulations.wall import Wall
from ctr_nlp.models import MODELS
from ctr_nlp.plan.account import remarks
from ctr_nlp.steer.inside import LIGHTEST, NEAR, ROUNDING, TRIES, Outcome, affordable, needed
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.starts import search
from ctr_nlp.target.lumen import Lumen

ROBOT = table_i_robot()
WALL = Wall(ROBOT, Lumen.around(straight(4.0)), MODELS["dominant"], 30.0, 0.05)
BOTH = pytest.mark.parametrize("solve", [solve_horizon, solve_per_frame])
NO_WALL = Settings(contact_weight=0.0)


# The weight of contact


def power(exponent, whole, flat=np.inf):
    """Errors that grow with a power of the weight until contact has gone, and by so much with the whole one."""

    def judge(wall, weight):
        held = min(weight, flat)
        return held, whole * (held / min(WALL.weight, flat)) ** exponent

    return judge


def weights(judge, cost, stop=lambda tried: False):
    """The weight that is kept, None for none, and those that are tried."""
    tried = []

    def solve(wall):
        tried.append(wall.weight)
        return wall.weight

    kept = affordable(WALL, solve, judge, cost, lambda: stop(tried))
    return None if kept is None else kept[1], tried


def test_the_whole_weight_is_taken_where_errors_grow_by_little_enough():
    assert weights(power(1.0, 0.1), 0.1) == (30.0, [30.0])


@pytest.mark.parametrize("exponent", [0.5, 0.8, 1.0, 1.5])
@pytest.mark.parametrize("whole", [0.11, 0.7, 1.5])
@pytest.mark.parametrize("flat", [10.0, np.inf])
def test_else_one_at_which_errors_grow_by_nearly_all_that_they_may(exponent, whole, flat):
    judge = power(exponent, whole, flat)
    found, tried = weights(judge, 0.1)
    assert NEAR * 0.1 <= judge(WALL, found)[1] <= 0.1
    assert len(tried) <= 5


def test_a_weight_without_which_contact_has_gone_is_not_tried():
    """From 2 mm^2 a mm on, errors are the same."""
    assert max(weights(power(0.7, 0.2, 2.0), 0.1)[1][1:]) < 2.0


def test_errors_that_hardly_grow_any_more_are_followed_down_to_where_they_do():
    """As on a synthetic airway, where powers alone kept a weight that costs a fifth of what it may."""
    weight, grown = [0.03, 0.71, 1.55, 2.5, 5.4, 30.0], [0.0, 0.021, 0.072, 0.112, 0.124, 0.132]

    def judge(wall, found):
        return found, float(np.interp(found, weight, grown))

    assert 0.075 <= judge(WALL, weights(judge, 0.1)[0])[1] <= 0.1


def test_where_errors_jump_the_largest_of_few_weights_at_which_they_may_is_kept():
    found, tried = weights(lambda wall, weight: (weight, 0.01 if weight < 1.0 else 0.5), 0.1)
    assert len(tried) == TRIES + 1
    assert found == max(weight for weight in tried if weight < 1.0) > 0.5


@pytest.mark.parametrize("grown", [np.nan, 9.0])
def test_where_not_even_the_lightest_will_do_there_is_none(grown):
    found, tried = weights(lambda wall, weight: (weight, grown), 0.1)
    assert found is None
    assert min(tried) >= 30.0 * LIGHTEST


def test_where_nothing_is_solved_with_the_whole_weight_the_lightest_is_next():
    found, tried = weights(lambda wall, weight: (weight, 0.002 * weight if weight < 20 else np.nan), 1e3)
    assert tried[1] == pytest.approx(30.0 * LIGHTEST)
    assert 10 < found < 20


@pytest.mark.parametrize("solved", range(4))
def test_an_interruption_leaves_only_what_will_do(solved):
    """Ctrl-C comes after so many."""
    judge = power(0.7, 5.0)
    found, tried = weights(judge, 0.1, lambda tried: len(tried) >= solved)
    assert found is None or judge(WALL, found)[1] <= 0.1
    assert len(tried) == max(solved, 1)


def test_the_weight_that_is_needed_is_what_clearance_pulls_with_where_nothing_touches():
    assert needed(WALL, np.array([-30.0, -28.0, -25.5])) == 4.5
    assert needed(WALL, np.array([-30.0, 0.0])) == WALL.weight


@pytest.mark.parametrize(
    ("failed", "e2", "expected"),
    [
        (0, [1.1, 1.1], 0.1),
        (0, [9.0, 9.0], 8.0),
        (1, [1.0, 1.0], np.nan),
        (0, [0.5, np.nan], -0.5),
        (0, [np.nan, np.nan], np.nan),
    ],
)
def test_growth_is_that_of_e3_where_no_more_frames_fail(failed, e2, expected):
    """e3 is compared over the frames whose shape is known; what rounding may be does not count."""
    grown = Outcome(failed, np.array(e2)).growth(Outcome(0, np.array([1.0, 1.0])))
    assert grown == pytest.approx(expected - ROUNDING, nan_ok=True)


def test_a_motion_without_errors_may_grow_by_no_more_than_rounding():
    free = Outcome(0, np.zeros(2))
    assert Outcome(0, np.full(2, 0.9 * ROUNDING)).growth(free) <= 0.0
    assert Outcome(0, np.full(2, 1.1 * ROUNDING)).growth(free) > 0.1


# Plans


@pytest.fixture(scope="module")
def problem():
    """Tubes that are bent, in a straight lumen just wide enough."""
    return Problem("straight", ROBOT, growing(straight(4.0), 8), lumen=straight(4.0))


@pytest.fixture(scope="module")
def free(problem):
    return {
        solve: solve(problem, model="dominant", settings=NO_WALL) for solve in (solve_horizon, solve_per_frame)
    }


@BOTH
def test_a_plan_holds_the_motion_that_there_is_without_the_wall(solve, problem, free, tmp_path):
    plan = solve(problem, model="dominant")
    np.testing.assert_array_equal(plan.free, free[solve].q)
    assert plan.meta["e3_free"] == summary(plan)["e3_free"] == summary(free[solve])["e3"]
    assert free[solve].free is None
    plan.save(tmp_path / "plan.npz")
    np.testing.assert_array_equal(plan.load(tmp_path / "plan.npz").free, plan.free)
    np.testing.assert_array_equal(plan.reversed().free, plan.free[::-1])


@BOTH
def test_on_another_model_e3_is_compared_with_the_free_motion_on_that_model(solve, problem, free):
    plan = solve(problem, model="dominant").on("elastic")
    assert plan.meta["e3_free"] == pytest.approx(summary(free[solve].on("elastic"))["e3"])


def test_frames_that_are_lost_within_the_wall_lose_the_wall(problem, free, monkeypatch):
    solved = NlpFrames.run

    def run(self, frames, before):
        for frame, (result, seconds) in zip(frames, solved(self, frames, before), strict=True):
            lost = self.near is not None and frame == 3
            yield replace(result, success=result.success and not lost), seconds

    monkeypatch.setattr(NlpFrames, "run", run)
    plan = solve_per_frame(problem, model="dominant", settings=Settings(clearance_cost=np.inf))
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
    plan = solve_horizon(problem, model="dominant", settings=Settings(clearance_cost=np.inf))
    assert plan.complete
    assert plan.meta["contact_weight"] is None
    np.testing.assert_array_equal(plan.q, free[solve_horizon].q)
