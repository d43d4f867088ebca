"""Plans that scenarios share: rounds, what is told, and what is not called a solution."""

from __future__ import annotations

import signal
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from frames import elastic_shapes, follow
from truth import TWO

from ctr_nlp import Problem, Settings, growing, solve_horizon, summary
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.summary_text import remarks
from ctr_nlp.robust import plan, rounds, solve_robust
from ctr_nlp.robust.rounds import Round, raise_margins_near_failures, relax_scenarios
from ctr_nlp.robust.search import InitialMotion, RobustSearch
from ctr_nlp.robust.trials import FailedSamples
from ctr_nlp.solvers.scenarios import SharedSolver

FRAMES = 50
OFFSETS = np.array([[0.1, -0.1], [-0.1, 0.1]])


@pytest.fixture(scope="module")
def problem():
    """A bend in space that two tubes cannot follow exactly, in more frames than a draft has."""
    curve = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    return Problem("bend", TWO, growing(curve, FRAMES))


def _scenarios(offsets=OFFSETS):
    count = len(offsets) + 1
    return Scenarios(np.repeat(TWO.numbers[None], count, 0), np.vstack([np.zeros(2), offsets]), np.ones(count))


class _Losing:
    """Trials on which one robot is lost in the first ones; they note what they were asked."""

    def __init__(self, rounds):
        self.rounds, self.asked = rounds, []

    def __call__(self, q, number, draft):
        self.asked.append((q.shape, number, draft))
        count = 1 if len(self.asked) <= self.rounds else 0
        numbers, offsets = np.repeat(TWO.numbers[None], count, 0), np.full((count, 2), 0.15)
        return FailedSamples(numbers, offsets, np.zeros((count, 3)), np.full(count, 3), 500, not count)

    def certify_plan(self, plan, number):
        held = len(self.asked) > self.rounds
        return replace(plan, meta=plan.meta | {"certificate": {"held": held, "number": number}})


def _planned(problem, scenarios, losing=0, **options):
    """The plan on which so many robots are lost, one a trial, and what was asked of the trials."""
    trials = _Losing(losing)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "Trials", lambda *given: trials)
        return solve_robust(problem, scenarios, **options), trials.asked


def _search(problem, weight=1e-6):
    return RobustSearch(
        problem, KINEMATIC_MODELS["elastic"], EndConfigurations(), (), weight, np.full(FRAMES, 0.1)
    )


@pytest.fixture(scope="module")
def found(problem):
    settings = Settings(arrival_weight=0.0)
    return _planned(problem, _scenarios(), 2, margins=(0.3, 0.5), rounds=3, settings=settings)


def test_robots_that_are_lost_join_until_few_are(found):
    robust, asked = found
    assert robust.success.all()
    assert [shape for shape, _, _ in asked] == [(FRAMES, 6)] * len(asked)
    assert [number for _, number, _ in asked] == list(range(len(asked)))
    assert [draft for _, _, draft in asked] == [True] * 3 + [False] * (len(asked) - 3)
    told = robust.meta["rounds"]
    assert [one["lost"] for one in told] == [1, 1] + [0] * (len(told) - 2)
    assert [one["scenarios"] for one in told[:3]] == [3, 4, 5]
    assert told[-1]["frames"] == FRAMES
    assert robust.meta["certificate"] == {"held": True, "number": len(told)}
    assert robust.meta["formulation"] == "robust-horizon"


def test_the_objective_is_the_mean_over_the_robots_and_the_motion(found):
    """Those that were lost do not count. Programs integrate in half as many steps as robots are followed with."""
    robust, _ = found
    squares = np.zeros(FRAMES)
    for offset in np.vstack([np.zeros(2), OFFSETS]):
        shape = elastic_shapes(TWO, follow(TWO, robust.q + np.pad(offset, (0, 4))).x, SIGMA_GRID)
        squares += np.trapezoid(((shape - robust.target) ** 2).sum(-1)[:, ::5], dx=0.05, axis=1) / 3
    moved = ((np.diff(robust.q, axis=0) * TWO.mm_per_unit) ** 2).sum(axis=1) / robust.dt**2
    squares[1:] += robust.options["motion_weight"] * moved
    np.testing.assert_allclose(robust.objective, squares, rtol=5e-3, atol=1e-3)


def test_robots_that_joined_differ_less_while_that_helps_and_few_are_lost(problem, found, monkeypatch):
    monkeypatch.setattr(rounds, "MIN_RELAXATION_GAIN", -1.0)
    robust, _ = found
    search = RobustSearch(
        problem,
        KINEMATIC_MODELS["elastic"],
        EndConfigurations(),
        (),
        robust.options["motion_weight"],
        np.full(FRAMES, 0.1),
    )
    joined = _scenarios().append_robots(TWO.numbers[None], np.array([[0.3, -0.3]]), np.zeros((1, 3)))
    tried = search.solve(InitialMotion("a plan", follow(TWO, robust.q).x), joined)
    held = Round(search, tried, joined, _Losing(0)(robust.q, 0, False))
    nearer = relax_scenarios(held, 3, _Losing(0), 1)
    np.testing.assert_allclose([one.scenarios.offsets[3, 0] for one in nearer], [0.24, 0.192])
    for one in nearer:
        np.testing.assert_array_equal(one.scenarios.offsets[:3], joined.offsets[:3])
    assert nearer[1].tried.solution.objective <= tried.solution.objective * (1 + 1e-6)
    assert len(relax_scenarios(held, 3, _Losing(1), 1)) == 1
    assert relax_scenarios(held._replace(scenarios=_scenarios()), 3, _Losing(0), 1) == []


@pytest.mark.parametrize(
    ("picked", "frames", "raised"), [(None, [4, 9], [3, 4, 8, 9]), (None, [1], [1]), ([1, 4, 7], [4, 5], [2, 5])]
)
def test_frames_beside_those_where_robots_are_lost_get_more_margin(picked, frames, raised):
    found = raise_margins_near_failures(
        np.full(FRAMES, 0.1), np.array(frames), None if picked is None else np.array(picked)
    )
    expected = np.full(FRAMES, 0.1)
    expected[np.array(raised) - 1] = 0.2
    np.testing.assert_allclose(found, expected)


def test_a_robust_plan_is_better_on_its_robots_than_a_nominal_one(problem, found):
    robust, _ = found
    nominal, _ = _planned(problem, _scenarios(OFFSETS[:0]), margins=(0.3,))
    assert nominal.success.all()

    def mean(q):
        errors = [
            ((elastic_shapes(TWO, follow(TWO, q + np.pad(o, (0, 4))).x, SIGMA_GRID) - robust.target) ** 2)
            .sum(-1)
            .mean()
            for o in OFFSETS
        ]
        return np.mean(errors)

    assert mean(robust.q) <= mean(nominal.q) * (1 + 1e-6)


def test_scenarios_that_no_motion_keeps_leave_the_plan_of_the_nominal_robot(problem):
    """Motors that may be off by anything: some robot's tips are far from those of the nominal one, when out."""
    out = replace(problem, robot=TWO.with_limits(beta=[(40, 60), (50, 110)]))
    scenarios = _scenarios(np.array([[2.1, 0.0], [-2.1, 0.0], [np.pi, 0.0]]))
    first = []
    robust, _ = _planned(out, scenarios, margins=(0.5,), nominal=first.append)
    assert robust.success.all()
    np.testing.assert_array_equal(robust.q, first[0].q)
    assert robust.meta["formulation"] == "horizon"
    assert "certificate" not in robust.meta
    told = remarks(robust, summary(robust))
    assert told[-1].startswith(
        "no motion was found that all robots within the tolerances share: this is the plan for"
    )


def test_the_nominal_plan_is_told_before_the_others_are_planned_for(problem):
    first = []
    robust, asked = _planned(problem, _scenarios(), nominal=first.append, initial=())
    (nominal,) = first
    assert nominal.success.all()
    assert nominal.meta["formulation"] == "horizon"
    assert robust.meta["starts"][0]["start"] == "the nominal plan"
    assert robust.meta["formulation"] == "robust-horizon"
    assert asked


def test_scenarios_grow_from_the_nominal_robot_where_a_start_fails(problem, found, monkeypatch):
    robust, _ = found
    search = RobustSearch(
        problem,
        KINEMATIC_MODELS["elastic"],
        EndConfigurations(),
        (),
        robust.options["motion_weight"],
        np.full(FRAMES, 0.1),
    )
    solve, solved = SharedSolver.__call__, []

    def failing(self, *args, **options):
        solved.append(solve(self, *args, **options))
        return replace(solved[-1], status="failed") if len(solved) in (1, 3) else solved[-1]

    monkeypatch.setattr(SharedSolver, "__call__", failing)
    start = InitialMotion("a plan", follow(TWO, robust.q).x)
    tried = search.solve(start, _scenarios(), search.draft_frames)
    assert tried.is_shared
    assert tried.grown == 1.0
    assert len(solved) == 5  # whole, half, whole, three quarters, and whole again


def test_over_all_frames_scenarios_do_not_grow(problem, found, monkeypatch):
    robust, _ = found
    solve, solved = SharedSolver.__call__, []

    def failing(self, *args, **options):
        solved.append(solve(self, *args, **options))
        return replace(solved[-1], kkt=1.0)

    monkeypatch.setattr(SharedSolver, "__call__", failing)
    search = _search(problem, robust.options["motion_weight"])
    tried = search.solve(InitialMotion("a plan", follow(TWO, robust.q).x), _scenarios())
    assert not tried.is_shared
    assert len(solved) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenarios": 3}, "scenarios"),
        ({"most_lost": 0.0}, "most_lost is 0.0; it must be more than 0"),
        ({"rounds": -1}, "rounds"),
        ({"model": "rigid"}, "model of scenarios"),
    ],
)
def test_what_cannot_be_planned_is_refused(problem, arguments, message):
    with pytest.raises(OptionError, match=message):
        solve_robust(problem, **({"scenarios": _scenarios(), "margins": (0.3,)} | arguments))


def test_an_interrupted_search_gives_no_certificate(problem):
    def told(done, count, note):
        if note.startswith("one motion for all robots"):
            signal.raise_signal(signal.SIGINT)

    first = []
    stopped, _ = _planned(problem, _scenarios(), margins=(0.3,), progress=told, nominal=first.append)
    assert stopped.meta["interrupted"]
    assert "certificate" not in stopped.meta
    assert "not_shared" not in stopped.meta
    np.testing.assert_array_equal(stopped.q, first[0].q)


def test_a_given_motion_is_started_from_alone_where_few_robots_are_lost(problem):
    known, _ = _planned(problem, _scenarios(), margins=(0.3,), motion_weight=1e-6)
    again, _ = _planned(problem, _scenarios(), initial=[known.q], margins=(0.3,), motion_weight=1e-6)
    assert [start["start"] for start in again.meta["starts"]] == ["motion 1"]
    assert again.success.all()
    np.testing.assert_allclose(again.objective.sum(), known.objective.sum(), rtol=5e-3)  # where solves end


def test_other_motions_are_started_from_where_robots_are_lost_on_what_comes_of_a_given_one(problem):
    known, _ = _planned(problem, _scenarios(), margins=(0.3,))
    again, asked = _planned(problem, _scenarios(), 2, initial=[known.q], margins=(0.3,), rounds=0)
    assert [start["start"] for start in again.meta["starts"]] == ["motion 1", "margin 0.3"]
    assert again.success.all()
    assert again.meta["certificate"]["held"]
    numbers = [number for _, number, _ in asked]
    assert numbers == sorted(set(numbers)), "every motion is tried on robots of its own"


def test_a_given_motion_of_another_size_is_refused(problem):
    with pytest.raises(OptionError, match="a motion of initial"):
        solve_robust(problem, _scenarios(), initial=[np.zeros((3, 6))])


def test_a_robust_plan_on_the_dominant_model_is_better_for_its_scenarios_than_the_plain_one(problem):
    """No tube can snap there: what is planned for is the mean error alone."""
    more_curved = replace(TWO, tubes=(replace(TWO.tubes[0], curvature=(0.013, 0.0325)), TWO.tubes[1]))
    numbers = np.array([TWO.numbers, more_curved.numbers])
    scenarios = Scenarios(numbers, np.zeros((2, 2)), np.array([0.0, 1.0]))
    found = solve_robust(problem, scenarios, model="dominant")
    assert found.success.all()
    assert found.meta["certificate"]["held"]
    plain = solve_horizon(problem, model="dominant", settings=Settings(contact_weight=0.0))
    shapes = [KINEMATIC_MODELS["dominant"].points(more_curved, plan.q, SIGMA_GRID) for plan in (plain, found)]
    errors = [np.linalg.norm(shape - plain.target, axis=-1).mean() for shape in shapes]
    assert errors[1] < 0.8 * errors[0]
