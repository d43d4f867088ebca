"""Plans within a wall hold the motion that is free of it, and fall back to that where more frames fail."""

from dataclasses import replace

import numpy as np
import pytest
from lumens import straight

from ctr_nlp import Problem, Settings, growing, solve_horizon, solve_per_frame, summary, table_i_robot
from ctr_nlp.plan.summary_text import remarks
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.planning.starts import search

ROBOT = table_i_robot()
BOTH = pytest.mark.parametrize("solve", [solve_horizon, solve_per_frame])
NO_WALL = Settings(contact_weight=0.0)


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
    plan = solve(problem, model="dominant").evaluate_on("elastic")
    assert plan.meta["e3_free"] == pytest.approx(summary(free[solve].evaluate_on("elastic"))["e3"])


def test_frames_that_are_lost_within_the_wall_lose_the_wall(problem, free, monkeypatch):
    solved = NlpFrames.run

    def run(self, frames, before):
        for frame, (result, seconds) in zip(frames, solved(self, frames, before), strict=True):
            lost = self.active_wall is not None and frame == 3
            yield replace(result, success=result.success and not lost), seconds

    monkeypatch.setattr(NlpFrames, "run", run)
    plan = solve_per_frame(problem, model="dominant")
    assert plan.complete
    assert plan.meta["contact_weight"] is None
    assert "this motion ignores the wall" in " ".join(remarks(plan, summary(plan)))
    np.testing.assert_array_equal(plan.q, free[solve_per_frame].q)


def test_a_horizon_that_is_not_solved_within_the_wall_loses_the_wall(problem, free, monkeypatch):
    tried = search.solve_from_motion

    def attempt(chain, *others):
        one = tried(chain, *others)
        failed = replace(one.solution, success=False)
        return one if chain.local_parameters is None else replace(one, solution=failed)

    monkeypatch.setattr(search, "solve_from_motion", attempt)
    plan = solve_horizon(problem, model="dominant")
    assert plan.complete
    assert plan.meta["contact_weight"] is None
    np.testing.assert_array_equal(plan.q, free[solve_horizon].q)
