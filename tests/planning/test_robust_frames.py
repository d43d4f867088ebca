"""Robust plans frame by frame: limits, tips carried along, what is minimised, and robots that are lost."""

from __future__ import annotations

import signal
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from frames import elastic_shapes, follow
from truth import TWO

from ctr_nlp import Problem, Settings, growing
from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.joint import tip_step_limits
from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.robust import per_frame, solve_robust_per_frame
from ctr_nlp.robust.frames import ScenarioFrames
from ctr_nlp.robust.trials import FailedSamples

FRAMES = 8
OFFSETS = np.array([[0.1, -0.1], [-0.1, 0.1]])


@pytest.fixture(scope="module")
def problem():
    """A bend in space that two tubes cannot follow exactly."""
    curve = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    return Problem("bend", TWO, growing(curve, FRAMES), duration=8.0)


@pytest.fixture(scope="module")
def scenarios():
    offsets = np.vstack([np.zeros(2), OFFSETS])
    return Scenarios(np.repeat(TWO.numbers[None], 3, 0), offsets, np.r_[0.0, 1.0, 1.0])


class _Losing:
    """Trials on which one robot is lost in the first ones."""

    def __init__(self, rounds):
        self.rounds, self.asked = rounds, 0

    def __call__(self, q, number):
        self.asked += 1
        count = int(self.asked <= self.rounds)
        numbers, offsets = np.repeat(TWO.numbers[None], count, 0), np.full((count, 2), 0.15)
        return FailedSamples(numbers, offsets, np.zeros((count, 3)), np.full(count, 3), 50, not count)

    def certify_plan(self, plan, number):
        return replace(plan, meta=plan.meta | {"certificate": {"held": self.asked > self.rounds}})


def _planned(problem, scenarios, losing=0, **options):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(per_frame, "Trials", lambda *given: _Losing(losing))
        return solve_robust_per_frame(problem, scenarios, **options)


@pytest.fixture(scope="module")
def plan(problem, scenarios):
    return _planned(problem, scenarios)


def test_all_frames_keep_their_limits_and_are_where_they_are_planned_to_be(problem, plan):
    assert plan.success.all()
    assert plan.meta["formulation"] == "robust-joint"
    assert plan.verdicts.within_limits.word == plan.verdicts.stable.word == "yes"
    assert (abs(np.diff(plan.q, axis=0)) <= TWO.speed * problem.dt + 1e-6).all()
    tips = [follow(TWO, plan.q + np.pad(offset, (0, 4))).x[:, :2] for offset in OFFSETS]
    assert (abs(np.diff(tips, axis=1)) <= tip_step_limits(TWO, problem.dt)).all()


def test_the_objective_is_the_mean_over_the_robots_and_the_step(problem, plan):
    """In the order in which frames were solved; the robot described does not count here."""
    squares = np.zeros(FRAMES)
    for offset in OFFSETS:
        shape = elastic_shapes(TWO, follow(TWO, plan.q + np.pad(offset, (0, 4))).x, SIGMA_GRID)
        squares += np.trapezoid(((shape - plan.target) ** 2).sum(-1)[:, ::5], dx=0.05, axis=1) / 2
    order = slice(None) if plan.options["direction"] == "forward" else slice(None, None, -1)
    moved = ((np.diff(plan.q[order], axis=0) * TWO.mm_per_unit) ** 2).sum(axis=1) / problem.dt**2
    squares[order][1:] += Settings().motion_weight * moved
    np.testing.assert_allclose(plan.objective, squares, rtol=5e-3, atol=1e-3)


def test_robots_that_are_lost_join_and_the_run_is_repeated(problem, scenarios, plan):
    again = _planned(problem, scenarios, 1)
    assert again.success.all()
    assert [(one["scenarios"], one["lost"]) for one in again.meta["rounds"]] == [(3, 1), (4, 0)]
    assert again.meta["certificate"] == {"held": True}
    margins = KINEMATIC_MODELS["elastic"].follow(TWO, again.q + np.pad(np.full(2, 0.225), (0, 4))).stability
    assert margins.min() > 0.1 - 2e-3
    assert np.mean(again.objective) >= np.mean(plan.objective) * (1 - 0.05)


def test_a_motion_begins_where_the_robot_stands(problem, scenarios, plan):
    start = plan.q[0] + np.r_[0.05, -0.05, 0, 0, 0, 0]
    moved = _planned(problem, scenarios, start=start)
    assert moved.success.all()
    assert (abs(moved.q[0] - start) <= TWO.speed * problem.dt + 1e-6).all()
    assert moved.options["direction"] == "forward"


def test_a_repeated_run_ends_where_a_frame_fails(problem, scenarios):
    settings = Settings()
    frames = ScenarioFrames.of(problem, scenarios, KINEMATIC_MODELS["elastic"], settings, (), (0.3,))
    (first, *_) = frames.search(FRAMES - 1)
    failed = replace(first, success=False)
    answer = replace(frames, known=dict.fromkeys(range(FRAMES), first)).step(FRAMES - 2, failed)
    assert not answer.success
    assert answer.status == "a frame before it was not solved"
    assert frames.step(FRAMES - 2, failed).success


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"rounds": -1}, OptionError, "rounds"),
        ({"most_lost": 1.0}, OptionError, "most_lost is 1.0; it must be more than 0 and less than 1"),
        ({"model": "rigid"}, OptionError, "model of scenarios"),
        ({"direction": "sideways"}, OptionError, "direction"),
        ({"start": [0.0]}, RobotError, "start"),
    ],
)
def test_what_cannot_be_planned_is_refused(problem, arguments, error, message):
    with pytest.raises(error, match=message):
        solve_robust_per_frame(problem, **arguments)


def test_an_interrupted_search_gives_no_certificate(problem, scenarios, monkeypatch):
    """Ctrl-C at the first frame that is told of."""

    def told(done, count, note):
        signal.raise_signal(signal.SIGINT)

    stopped = _planned(problem, scenarios, progress=told)
    assert stopped.meta["interrupted"]
    assert "certificate" not in stopped.meta
    assert not stopped.complete
