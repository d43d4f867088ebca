"""Motions on the elastic model that a robot makes: stable all along the way, and where its tubes were meant to be."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest

from ctr_nlp import Problem, Robot, Settings, Tube, curve_from_formula, growing, shapes, solve_horizon, tracking
from ctr_nlp.chain import Chain
from ctr_nlp.formulations.horizon import Ends, horizon, with_margins
from ctr_nlp.plan import plan_from_configurations
from ctr_nlp.solvers import CHAIN_SOLVERS, default_chain_solver
from ctr_nlp.solvers.compiled import fastest
from ctr_nlp.steer.attempts import Attempt, attempt
from ctr_nlp.steer.motions import per_frame_motions
from ctr_nlp.steer.realised import SHORT, realised
from problems import named

AT, BETWEEN = 1e-3, SHORT + 1e-3
"""By how much margins at frames and between them may be missed."""
WEIGHT = 1e-5


class Case(NamedTuple):
    """A problem as a chain whose margins are held at frames, and what was found from it."""

    problem: Problem
    chain: Chain
    attempts: list[Attempt]

    def made(self, margin, stop=lambda: False):
        solver = CHAIN_SOLVERS[default_chain_solver()]
        return realised(self.problem.robot, self.chain, solver, self.attempts, margin, stop)


@pytest.fixture(scope="module")
def case():
    """The seed's cosine in so few frames that margins held at frames are missed between them."""
    problem, settings = named("cos", 20), Settings()
    chain = horizon(
        problem.robot, problem.samples, problem.dt, WEIGHT, Ends(), fastest, "elastic", settings.stability_margin
    )
    solve = CHAIN_SOLVERS[default_chain_solver()](chain)
    starts = per_frame_motions(problem, Ends(), settings, model="elastic")
    attempts = [attempt(chain, solve, start.ravel(), None, lambda: False) for start in starts[:3]]
    return Case(problem, chain, attempts)


@pytest.fixture(scope="module")
def plan():
    return solve_horizon(named("line", 12), model="elastic")


def unknowns(chain, one):
    return one.solution.x.reshape(chain.frames, -1)


def moved(case, chain, one):
    """The robot of a case, moved through the configurations of an attempt alone."""
    q = one.solution.q.reshape(chain.frames, -1)[:, : len(case.problem.robot.axes)]
    return tracking.follow(case.problem.robot, q)


def asked(chain):
    """The margins (T,) of a chain's frames: what with_margins changes."""
    (rows,) = np.nonzero((with_margins(chain, np.full(chain.frames, 2.0)).parameters == 2).all(axis=1))
    return chain.parameters[rows[-1]]


@pytest.mark.parametrize(("name", "margin"), [("line", 0.3), ("bronchus", 0.1)])
def test_a_plan_holds_its_margin_at_frames_and_between(name, margin):
    plan = solve_horizon(named(name, 15), model="elastic", settings=Settings(stability_margin=margin))
    assert plan.complete
    assert plan.meta["snaps"] == []
    assert plan.stability.min() >= margin - AT
    assert plan.stability_between.min() >= margin - BETWEEN


def test_a_margin_costs_accuracy(plan):
    """Equally smooth: as far as stability lets it, a robot follows the line."""
    weight = plan.meta["options"]["motion_weight"]
    stiff = solve_horizon(
        named("line", 12), model="elastic", motion_weight=weight, settings=Settings(stability_margin=0.3)
    )
    assert stiff.objective.mean() > plan.objective.mean() * 1.01


def test_what_is_missing_between_frames_is_asked_of_those_beside(case):
    margin = Settings().stability_margin
    before = min(moved(case, case.chain, one).stability_between.min() for one in case.attempts)
    assert before < margin - SHORT
    chain, (best,) = case.made(margin)
    assert moved(case, chain, best).stability_between.min() >= margin - SHORT
    assert (asked(case.chain) == margin).all()
    assert (asked(chain) >= margin).all()
    assert asked(chain).max() > margin
    assert asked(chain).max() < 1


def test_moved_through_q_alone_the_robot_is_where_it_was_planned(case):
    chain, (best,) = case.made(Settings().stability_margin)
    robot, planned = case.problem.robot, unknowns(chain, best)
    found = moved(case, chain, best)
    np.testing.assert_allclose(tracking.shapes(robot, found.x), tracking.shapes(robot, planned), atol=1e-3)
    assert found.snaps == ()


def test_a_motion_of_no_margin_is_taken_as_it_is_where_the_robot_makes_it(case):
    chain, kept = case.made(None)
    assert chain is case.chain
    assert any(kept[0] is one for one in case.attempts)


def test_what_fails_is_left_alone(case):
    failed = [one._replace(solution=one.solution) if hasattr(one, "_replace") else one for one in ()]
    chain, kept = Case(case.problem, case.chain, failed).made(0.1)
    assert chain is case.chain
    assert kept == []


def test_no_margin_is_accepted_and_frames_that_are_not_reached_are_named():
    plan = solve_horizon(named("line", 12), model="elastic", settings=Settings(stability_margin=None))
    lost = {str(frame + 1) for frame in np.flatnonzero(~plan.success)}
    assert set(plan.meta["failures"]) == lost
    assert all("elsewhere" in why for why in plan.meta["failures"].values())


def test_frames_after_a_snap_name_it():
    """Two tubes turned against each other until they snap, and planned to be where they were before."""
    robot = Robot((Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)))
    problem = Problem("turned", robot, growing(curve_from_formula(lambda u: (0, 0, u), 0.0, 80.0), 21))
    q = np.zeros((21, 6))
    q[:, 0], q[:, 2:4] = np.linspace(0, 2 * np.pi, 21), (60.0, 80.0)
    found = tracking.follow(robot, q)
    (snap,) = found.snaps
    planned = found.x.copy()
    planned[snap.frame - 1 :, 0] = planned[snap.frame - 2, 0]
    nothing = np.zeros(21)
    plan = plan_from_configurations(
        problem,
        q,
        {"model": "elastic", "failures": {}},
        success=np.ones(21, dtype=bool),
        solve_time=nothing,
        objective=nothing,
        kkt=nothing,
        planned=planned,
    )
    np.testing.assert_array_equal(plan.success, np.arange(1, 22) < snap.frame)
    for why in plan.meta["failures"].values():
        assert why == f"the robot would be elsewhere: it snaps in frame {snap.frame}"


def test_a_plan_of_the_elastic_model_on_the_dominant_one(plan):
    other = plan.on("dominant")
    np.testing.assert_array_equal(other.q, plan.q)
    np.testing.assert_allclose(other.shape, shapes(plan.robot, plan.q), atol=1e-9)
    assert np.isnan([other.stability, other.stability_between]).all()
    assert other.meta["evaluated"] == "dominant"
    assert other.meta["model"] == "elastic"


def test_a_plan_of_the_dominant_model_on_the_elastic_one():
    dominant = solve_horizon(named("arc", 6))
    other = dominant.on("elastic")
    found = tracking.follow(dominant.robot, dominant.q)
    np.testing.assert_array_equal(other.q, dominant.q)
    np.testing.assert_allclose(other.shape, tracking.shapes(dominant.robot, found.x), atol=1e-9)
    np.testing.assert_allclose(other.stability_between, found.stability_between)
    assert np.abs(other.shape - dominant.shape).max() > 0.1
    assert other.meta["evaluated"] == "elastic"


def test_there_and_back_is_the_same_plan(plan):
    again = plan.on("dominant").on("elastic")
    np.testing.assert_allclose(again.shape, plan.shape, atol=1e-9)
    np.testing.assert_allclose(again.stability, plan.stability, atol=1e-9)
