"""Plans within a wall hold the motion that is free of it, and fall back to that where more frames fail."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from lumens import straight

from ctr_nlp import (
    Problem,
    Settings,
    curve_from_points,
    growing,
    solve_horizon,
    solve_per_frame,
    summary,
    table_i_robot,
)
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.wall import make_wall
from ctr_nlp.plan.summary_text import remarks
from ctr_nlp.planning.horizon import horizon
from ctr_nlp.planning.horizon.horizon import _rank_by_checks
from ctr_nlp.planning.motions import motions_within_wall
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.planning.starts import search
from ctr_nlp.solvers.frame.adapter import KKT_TOLERANCE
from ctr_nlp.solvers.motion.banded import BandedSolver

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

    def attempt(chain, *others, **options):
        one = tried(chain, *others, **options)
        failed = replace(one.solution, success=False)
        return one if chain.local_parameters is None else replace(one, solution=failed)

    monkeypatch.setattr(search, "solve_from_motion", attempt)
    plan = solve_horizon(problem, model="dominant")
    assert plan.complete
    assert plan.meta["contact_weight"] is None
    np.testing.assert_array_equal(plan.q, free[solve_horizon].q)


def _within_arc(radius, frames=6):
    """Table I's robot in a lumen along an arc, which its tubes follow well."""
    angle = np.linspace(0, 1.2, 61)
    arc = 100 * np.stack([1 - np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    lumen = curve_from_points(arc, np.full(len(arc), radius))
    return Problem("arc", ROBOT, growing(lumen, frames), lumen=lumen)


def test_a_wall_is_approached_roughly_on_a_draft_and_then_solved_exactly(monkeypatch):
    problem = _within_arc(3.0, frames=50)
    solve = BandedSolver.__call__
    told = list[tuple[int, float, float | None]]()

    def record(self, x0, watch, barrier=0.0, multipliers=None, tolerance=None):
        chain = self.chain
        if chain.local_parameters is not None:
            weight = chain.parameters[chain.frame.parameter_slice("contact_weight")].max()
            told.append((chain.frames, float(weight), tolerance))
        return solve(self, x0, watch, barrier, multipliers, tolerance)

    monkeypatch.setattr(BandedSolver, "__call__", record)
    plan = solve_horizon(problem, model="dominant")
    assert plan.complete
    rough = KKT_TOLERANCE / 2
    assert [key for key, _ in itertools.groupby(told)] == [
        (25, 3.0, rough),
        (25, 30.0, rough),
        (50, 30.0, rough),
        (50, 30.0, None),
    ]
    assert plan.kkt.max() < rough


def test_motions_from_the_last_frame_keep_within_the_wall_and_arrive():
    problem = _within_arc(6.0)
    model, settings = KINEMATIC_MODELS["elastic"], Settings()
    found = motions_within_wall(problem, settings, model, (), lambda: False)
    assert found
    wall = make_wall(ROBOT, problem.wall, model, settings)
    for x in found:
        assert x.shape == (6, 2 * ROBOT.d + 2)
        assert wall.local_parameters(x)[1].max() <= settings.clearance + settings.contact_allowed
        tip = model.points(ROBOT, x[-1:], np.ones(1))[0, -1]
        assert np.linalg.norm(tip - problem.target_frames[-1].points[-1]) <= settings.arrival_tolerance


def test_no_motion_begins_in_a_last_frame_that_touches_too_much():
    # The tubes are wider than the lumen: every last frame presses into the wall.
    problem = _within_arc(0.3)
    assert motions_within_wall(problem, Settings(), KINEMATIC_MODELS["elastic"], (), lambda: False) == []


def test_other_motions_are_tried_only_where_a_plan_in_a_wall_fails(monkeypatch):
    tried = list[Problem]()

    def motions(problem, *rest):
        tried.append(problem)
        return []

    monkeypatch.setattr(horizon, "motions_within_wall", motions)
    wide = solve_horizon(_within_arc(6.0), model="elastic")
    assert wide.verdicts.within_wall.word == "yes"
    assert tried == []
    narrow = solve_horizon(_within_arc(0.3), model="elastic")
    assert narrow.verdicts.within_wall.word == "no"
    assert len(tried) == 1


def test_the_motion_that_fails_fewest_checks_is_kept(monkeypatch):
    problem = _within_arc(6.0)
    good = solve_horizon(problem, model="elastic")
    made = horizon.Horizon._plan
    calls = list[int]()

    def plan(self, *arguments):
        calls.append(1)
        found = made(self, *arguments)
        # The first plan counts as not solved.
        return replace(found, success=np.zeros(problem.frames, dtype=bool)) if len(calls) == 1 else found

    monkeypatch.setattr(horizon.Horizon, "_plan", plan)
    kept = solve_horizon(problem, model="elastic")
    assert kept.verdicts.solved.word == "yes"
    assert len(calls) >= 2
    assert len(kept.meta["starts"]) > len(good.meta["starts"])


def test_of_plans_that_fail_the_nearest_counts_and_not_the_one_that_touches_least():
    plan = solve_horizon(_within_arc(6.0), model="elastic")
    wrong = replace(plan, shape=plan.shape + 30.0)

    def touching(depth, plan):
        return replace(plan, clearance_between=np.full_like(plan.clearance_between, -depth))

    ranks = [_rank_by_checks(each) for each in (plan, touching(0.7, plan), touching(3.0, plan), wrong)]
    assert ranks == sorted(ranks)
    # Both fail three checks: the second is 30 mm away everywhere, and only touches less.
    far, near = touching(0.6, wrong), touching(6.0, replace(plan, shape=plan.shape + 4.0))
    assert _rank_by_checks(near)[0] == _rank_by_checks(far)[0]
    assert _rank_by_checks(near) < _rank_by_checks(far)


@pytest.mark.parametrize(("depth", "aims"), [(0.6, [0.3, 0.1]), (1.2, [])])
def test_a_plan_that_presses_a_little_too_deep_is_solved_again_with_less_contact(monkeypatch, depth, aims):
    """Twice the excess of 0.1 mm is taken off the 0.5 mm that planning allows, and once more where it stays."""
    problem = _within_arc(6.0)
    made = horizon.Horizon._plan
    solve = search.Search.solve_from_motions
    aimed = list[float]()

    def plan(self, *arguments):
        found = made(self, *arguments)
        return replace(found, clearance=np.full_like(found.clearance, -depth))

    def solve_from_motions(self, motions, wall=None, **options):
        if wall is not None and wall.contact_allowed < 0.5:
            aimed.append(wall.contact_allowed)
        return solve(self, motions, wall, **options)

    monkeypatch.setattr(horizon, "motions_within_wall", lambda *_: [])
    monkeypatch.setattr(horizon.Horizon, "_plan", plan)
    monkeypatch.setattr(search.Search, "solve_from_motions", solve_from_motions)
    solve_horizon(problem, model="elastic")
    assert aimed == pytest.approx(aims)
