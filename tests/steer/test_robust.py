"""Plans that scenarios share: rounds, what is told, and what is not called a solution."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from frames import elastic_shapes, follow
from truth import TWO

from ctr_nlp import Problem, growing
from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.horizon import Ends
from ctr_nlp.models import MODELS
from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.solvers.scenarios import SharedSolver
from ctr_nlp.steer.robust import Lost, solve_robust
from ctr_nlp.steer.robust.search import RobustSearch, Start
from ctr_nlp.target.curve import curve_from_formula
from ctr_nlp.target.target import SIGMA

FRAMES = 30
OFFSETS = np.array([[0.1, -0.1], [-0.1, 0.1]])


@pytest.fixture(scope="module")
def problem():
    """A bend in space that two tubes cannot follow exactly, in more frames than a draft has."""
    curve = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    return Problem("bend", TWO, growing(curve, FRAMES))


def _scenarios(offsets=OFFSETS):
    count = len(offsets) + 1
    return Scenarios(np.repeat(TWO.numbers[None], count, 0), np.vstack([np.zeros(2), offsets]), np.ones(count))


class _Draws:
    """Loses one robot in the first rounds, and notes what it was asked."""

    def __init__(self, rounds):
        self.rounds, self.asked = rounds, []

    def __call__(self, q, number):
        self.asked.append((q.shape, number))
        count = 1 if len(self.asked) <= self.rounds else 0
        return Lost(np.repeat(TWO.numbers[None], count, 0), np.full((count, 2), 0.15))


@pytest.fixture(scope="module")
def found(problem):
    draws = _Draws(2)
    return solve_robust(problem, _scenarios(), lost=draws, margins=(0.3, 0.5), rounds=3), draws


def test_robots_that_are_lost_join_until_none_is(found):
    plan, draws = found
    assert plan.success.all()
    assert [shape for shape, _ in draws.asked] == [(FRAMES, 6)] * len(draws.asked)
    numbers = [number for _, number in draws.asked]
    assert numbers == list(range(len(numbers)))
    told = plan.meta["rounds"]
    assert [one["lost"] for one in told] == [1] * 2 + [0] * (len(told) - 2)
    assert told[-1]["scenarios"] == 5
    assert told[-1]["frames"] == FRAMES
    assert plan.meta["lost"] == 0
    assert plan.meta["formulation"] == "scenarios"


def test_the_objective_is_the_mean_over_the_robots_and_the_motion(problem, found):
    """Integration apart, which programs do in half as many steps as robots are followed with."""
    plan, _ = found
    offsets = np.vstack([np.zeros(2), OFFSETS, [[0.15, 0.15]] * 2])
    weights = np.array([1, 1, 1, 0.2, 0.2]) / 3.4
    squares = np.zeros(FRAMES)
    for offset, weight in zip(offsets, weights, strict=True):
        shape = elastic_shapes(TWO, follow(TWO, plan.q + np.pad(offset, (0, 4))).x, SIGMA)
        squares += weight * np.trapezoid(((shape - plan.target) ** 2).sum(-1)[:, ::5], dx=0.05, axis=1)
    moved = ((np.diff(plan.q, axis=0) * TWO.mm_per_unit) ** 2).sum(axis=1) / plan.dt**2
    squares[1:] += plan.options["motion_weight"] * moved
    np.testing.assert_allclose(plan.objective, squares, rtol=5e-3, atol=1e-3)


def test_a_robust_plan_is_better_on_its_robots_than_a_nominal_one(problem, found):
    plan, _ = found
    nominal = solve_robust(problem, _scenarios(OFFSETS[:0]), lost=_Draws(0), margins=(0.3,))
    assert nominal.success.all()

    def mean(q):
        errors = [
            ((elastic_shapes(TWO, follow(TWO, q + np.pad(o, (0, 4))).x, SIGMA) - plan.target) ** 2).sum(-1).mean()
            for o in OFFSETS
        ]
        return np.mean(errors)

    assert mean(plan.q) <= mean(nominal.q) * (1 + 1e-6)


def test_scenarios_that_no_motion_keeps_leave_a_plan_without_solved_frames(problem):
    """Motors that may be off by anything: some robot's tips are far from those of the nominal one, when out."""
    out = replace(problem, robot=TWO.with_limits(beta=[(40, 60), (50, 110)]))
    scenarios = _scenarios(np.array([[2.1, 0.0], [-2.1, 0.0], [np.pi, 0.0]]))
    plan = solve_robust(out, scenarios, lost=_Draws(0), margins=(0.5,))
    assert not plan.success.any()
    assert plan.meta["failures"] == {"all": "no motion was found that all scenarios share"}


def test_scenarios_grow_from_the_nominal_robot_where_a_start_fails(problem, found, monkeypatch):
    plan, _ = found
    search = RobustSearch(problem, MODELS["elastic"], Ends(), (), plan.options["motion_weight"], 0.1)
    solve, solved = SharedSolver.__call__, []

    def failing(self, *args):
        solved.append(solve(self, *args))
        return replace(solved[-1], kkt=1.0) if len(solved) in (1, 3) else solved[-1]

    monkeypatch.setattr(SharedSolver, "__call__", failing)
    start = Start("a plan", follow(TWO, plan.q).x)
    tried = search.solve(start, _scenarios())
    assert tried.shared
    assert tried.grown == 1.0
    assert len(solved) == 5  # whole, half, whole, three quarters, and whole again


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"scenarios": 3}, "scenarios"), ({"margin": 1.5}, "margin"), ({"model": "dominant"}, "model of scenarios")],
)
def test_what_cannot_be_planned_is_refused(problem, arguments, message):
    with pytest.raises(OptionError, match=message):
        solve_robust(problem, **({"scenarios": _scenarios(), "margins": (0.3,)} | arguments))
