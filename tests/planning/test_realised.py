"""Motions on the elastic model that a robot makes: stable all along the way, and where its tubes are to be."""

from __future__ import annotations

import functools
from dataclasses import replace

import frames as tracking
import numpy as np
import pytest
from frames import horizon

from ctr_nlp import Problem, Robot, Settings, Tube, curve_from_formula, growing, shapes, solve_horizon
from ctr_nlp.models import Snap
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.plan.plan import plan_from_configurations
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.planning.multistart import solve_from_motion
from ctr_nlp.planning.stability_refinement import (
    BRANCH_LOSS_MARGIN_INCREASE,
    MAX_MARGIN_SHORTFALL,
    find_margin_shortfall,
    select_realisable_starts,
)
from ctr_nlp.solvers import CHAIN_SOLVERS

ROBOT = Robot((Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)))
SIMULATOR = Simulator(ROBOT, "elastic")
FRAMES = 8
WEIGHT = 1e-5
AT = 1e-3
"""By how much margins of frames may be missed."""


pytestmark = pytest.mark.interpreted


def straight(frames=FRAMES):
    """Along a line, for which curved tubes must be turned against each other as far as is stable."""
    return Problem("straight", ROBOT, growing(curve_from_formula(lambda u: (0, 0, u), 0.0, 80.0), frames))


def opposed(frames=FRAMES, angle=2.5):
    """Configurations to start from."""
    q = np.zeros((frames, 6))
    q[:, 0], q[:, 2:4] = angle, np.outer(np.arange(1, frames + 1) / frames, [60.0, 80.0])
    return q


@functools.cache
def planned(margin):
    settings = Settings(stability_margin=margin)
    return solve_horizon(straight(), model="elastic", initial=[opposed()], motion_weight=WEIGHT, settings=settings)


@functools.cache
def found(margin=0.1):
    """The chain with its margin held at frames and what was found from it; then what realised makes of these."""
    problem = straight()
    chain = horizon(
        ROBOT, problem.target_frames, problem.dt, WEIGHT, EndConfigurations(), model="elastic", margin=margin
    )
    start = tracking.follow(ROBOT, opposed()).x
    one = solve_from_motion(chain, CHAIN_SOLVERS["ipopt"], start.ravel(), None, lambda: False)
    return (
        chain,
        one,
        *select_realisable_starts(SIMULATOR, chain, CHAIN_SOLVERS["ipopt"], [one], margin, lambda: False),
    )


class Counted(Simulator):
    """Counts the motions that it is asked for."""

    calls = 0

    def __call__(self, q):
        self.calls += 1
        return super().__call__(q)


def moved(one):
    """The robot moved through the configurations of an attempt alone."""
    return tracking.follow(ROBOT, one.solution.q.reshape(FRAMES, -1)[:, : len(ROBOT.axes)])


def asked(chain, one):
    """The margins (T,) of frames that an attempt holds."""
    return one.parameters[chain.frame.parameter_slice("margin")][0]


@pytest.mark.parametrize("margin", [0.1, 0.3])
def test_a_plan_holds_its_margin_at_frames_and_between(margin):
    plan = planned(margin)
    assert plan.complete
    assert plan.meta["snaps"] == []
    assert plan.stability.min() >= margin - AT
    assert plan.stability_between.min() >= margin - MAX_MARGIN_SHORTFALL - AT


def test_a_larger_margin_costs_accuracy():
    assert planned(0.3).objective.mean() > planned(0.1).objective.mean() * 1.1


def test_what_is_missing_between_frames_is_asked_of_those_beside():
    chain, one, best = found()
    missing = moved(one).stability_between < 0.1 - MAX_MARGIN_SHORTFALL
    assert missing.any()
    assert (asked(chain, one) == 0.1).all()
    raised = asked(chain, best) > 0.1
    assert raised[missing].all()
    assert (asked(chain, best) >= 0.1).all()
    assert not raised.all()
    assert moved(best).stability_between.min() >= 0.1 - MAX_MARGIN_SHORTFALL


def test_moved_through_q_alone_the_robot_is_where_it_was_meant_to_be():
    *_, best = found()
    meant = tracking.elastic_shapes(ROBOT, best.solution.x.reshape(FRAMES, -1))
    np.testing.assert_allclose(tracking.elastic_shapes(ROBOT, moved(best).x), meant, atol=0.02)
    assert moved(best).snaps == ()


def test_a_motion_that_needs_nothing_is_left_as_it_is():
    chain, _, best = found()
    (same,) = select_realisable_starts(SIMULATOR, chain, CHAIN_SOLVERS["ipopt"], [best], 0.1, lambda: False)
    assert same is best


def test_what_cannot_become_better_than_a_motion_that_is_made_is_not_followed_again():
    """The second attempt is the first one again, whose objective grows as its margins are raised."""
    chain, one, best = found()
    worse = replace(one, solution=replace(one.solution, objective=one.solution.objective + 1e-3))
    assert one.solution.objective + 1e-3 < best.solution.objective
    simulator = Counted(ROBOT, "elastic")
    alone = select_realisable_starts(simulator, chain, CHAIN_SOLVERS["ipopt"], [one], 0.1, lambda: False)
    followed = simulator.calls
    both = select_realisable_starts(simulator, chain, CHAIN_SOLVERS["ipopt"], [one, worse], 0.1, lambda: False)
    assert simulator.calls == 3 * followed - 1  # the last change of the second attempt is as bad as the best
    assert both[0].solution.objective == alone[0].solution.objective


def test_a_robot_that_snaps_nobody_knows_where_is_given_more_of_a_margin_there():
    moved = SIMULATOR(np.repeat(opposed()[-1:], FRAMES, axis=0))
    x, between, snap = moved.x.copy(), np.full(FRAMES, 0.2), Snap(6, (1,), None)
    x[5:], between[5:] = np.nan, [0.0, np.nan, np.nan]
    lost = moved._replace(x=x, stability_between=between, snaps=(snap,))
    by_frame, elsewhere = find_margin_shortfall(lost, moved.x, 0.1, ROBOT.d)
    assert elsewhere
    np.testing.assert_allclose(by_frame, [0, 0, 0, 0, 0, 0.1 + BRANCH_LOSS_MARGIN_INCREASE, 0, 0])


def test_without_a_margin_frames_that_the_robot_does_not_reach_are_named():
    plan = planned(None)
    assert set(plan.meta["failures"]) == {str(j + 1) for j in np.flatnonzero(~plan.success)}
    assert all("elsewhere" in why for why in plan.meta["failures"].values())


def test_frames_after_a_snap_name_it():
    problem, q = straight(21), opposed(21)
    q[:, 0], q[:, 2:4] = np.linspace(0, 2 * np.pi, 21), (60.0, 80.0)
    there = tracking.follow(ROBOT, q)
    (snap,) = there.snaps
    meant = there.x.copy()
    meant[snap.frame - 1 :, 0] = meant[snap.frame - 2, 0]
    plan = plan_from_configurations(
        problem,
        q,
        {"model": "elastic", "failures": {}},
        success=np.ones(21, dtype=bool),
        solve_time=np.zeros(21),
        objective=np.zeros(21),
        kkt=np.zeros(21),
        planned=meant,
    )
    np.testing.assert_array_equal(plan.success, np.arange(1, 22) < snap.frame)
    assert set(plan.meta["failures"].values()) == {f"the robot would be elsewhere: it snaps in frame {snap.frame}"}


def test_a_plan_of_the_elastic_model_on_the_dominant_one():
    plan = planned(0.1)
    other = plan.evaluate_on("dominant")
    np.testing.assert_array_equal(other.q, plan.q)
    np.testing.assert_allclose(other.shape, shapes(ROBOT, plan.q), atol=1e-9)
    assert np.isnan([other.stability, other.stability_between]).all()
    assert (other.meta["model"], other.meta["evaluated"]) == ("elastic", "dominant")
    np.testing.assert_allclose(other.evaluate_on("elastic").shape, plan.shape, atol=1e-9)


def test_a_plan_of_the_dominant_model_on_the_elastic_one():
    plan = solve_horizon(straight(), model="dominant", initial=[opposed()], motion_weight=WEIGHT)
    other, there = plan.evaluate_on("elastic"), tracking.follow(ROBOT, plan.q)
    np.testing.assert_array_equal(other.q, plan.q)
    np.testing.assert_allclose(other.shape, tracking.elastic_shapes(ROBOT, there.x), atol=1e-9)
    np.testing.assert_array_equal(other.stability_between, there.stability_between)
    assert np.abs(other.shape - plan.shape).max() > 0.1
    assert (other.meta["model"], other.meta["evaluated"]) == ("dominant", "elastic")
