"""Corners of the tolerances that a robust motion would lose, kept by guards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import TWO

from ctr_nlp import Tolerances
from ctr_nlp.formulations.horizon import Ends
from ctr_nlp.formulations.shared.scenarios import APART, EASED, FURTHEST, shared_motion
from ctr_nlp.models import MODELS
from ctr_nlp.problems import named
from ctr_nlp.robot.draws import corners
from ctr_nlp.solvers.scenarios import SharedSolution
from ctr_nlp.steer.robust import guards
from ctr_nlp.steer.robust.corners import MOST, NEAR, Corners, corners_within
from ctr_nlp.steer.robust.rounds import Round
from ctr_nlp.steer.robust.search import RobustSearch, Tried
from ctr_nlp.steer.robust.tolerated import scenarios_of
from ctr_nlp.steer.robust.trials import Lost

ELASTIC = MODELS["elastic"]


def _sorted(robots):
    rows = np.concatenate([robots.numbers.reshape(len(robots), -1), robots.offsets], axis=1)
    return rows[np.lexsort(rows.round(12).T)]


def test_corners_are_those_of_the_band():
    np.testing.assert_allclose(_sorted(corners_within(TWO)), _sorted(corners(TWO)), rtol=1e-12)


def test_of_more_corners_so_many_are_taken_and_each_is_one():
    robot = replace(TWO, tolerances=Tolerances(torsional_ratio=0.02, curved_length=0.5))
    found = corners_within(robot)
    assert len(found) == MOST
    np.testing.assert_allclose(abs(found.parts[..., 4]), 0.02)


class _Bearing(Corners):
    """Corners of which each bears a part of its difference that is known."""

    def _lost(self, chosen, q, part):
        return np.where(np.ravel(part) > q[chosen], 1, 0)


def test_which_corners_are_lost_and_which_part_they_bear():
    parts = np.linspace(0.2, 1.6, 64)
    found = _Bearing.of(TWO, ELASTIC)
    np.testing.assert_array_equal(found.lost(parts), parts < 1.0)
    borne = found.borne(parts)
    np.testing.assert_allclose(borne[parts < NEAR], parts[parts < NEAR], atol=NEAR / 2**5)
    assert np.isinf(borne[parts >= NEAR]).all()
    assert found.allowed == 1


def test_guards_keep_less_margin_and_may_be_further_apart():
    problem = named("cos", frames=2)
    scenarios = scenarios_of(problem.robot)
    more = scenarios.guarded(scenarios.numbers[1:3], scenarios.offsets[1:3])
    assert more.guards == 2
    assert more.weights[-2:].tolist() == [0.0, 0.0]
    at = problem.robot, problem.samples, problem.dt, 1e-6, Ends(), ELASTIC
    motion = shared_motion(*at, more, margins=np.full(2, 0.1))
    margins = motion.parameters.reshape(2, len(more), -1)[..., motion.frame.place("margin")][..., 0]
    np.testing.assert_allclose(margins, np.tile(np.r_[np.full(13, 0.1), np.full(2, EASED * 0.1)], (2, 1)))
    np.testing.assert_allclose(motion.apart, np.r_[np.full(13, APART), np.full(2, FURTHEST)])
    sums = motion.by_scenario(np.ones(len(motion.row_bounds[0][0])))
    np.testing.assert_allclose(sums, np.r_[len(motion.own_rows), np.full(14, len(motion.own_rows) + 2)])
    assert more.first(13).guards == 0


def test_guards_join_until_few_corners_are_lost(monkeypatch):
    """Those that bear least are given up; the others are lost as long as they are no guards; idle ones leave."""
    d, asked = 2, []
    parts = np.r_[0.5, 0.9, 0.95, 1.03, np.full(60, 2.0)]
    robots = _Bearing.of(TWO, ELASTIC)
    base = scenarios_of(TWO)
    count = len(base)

    def solved(search, tried, scenarios):
        asked.append(scenarios)
        burdens = np.r_[np.zeros(count), np.ones(scenarios.guards - 1), 0.0]
        bears = parts.copy()
        bears[1:3] = 1.2
        phi = np.zeros((1, len(scenarios), d))
        found = SharedSolution(bears, phi, 1.01, 0.0, 0.0, 0.0, "solved", 1, burdens=burdens)
        return Tried("a motion", 1, found)

    monkeypatch.setattr(guards, "solved_again", solved)
    known = SharedSolution(parts, np.zeros((1, count, d)), 1.0, 0.0, 0.0, 0.0, "solved", 1)
    few = Lost(base.numbers[:0], base.offsets[:0], np.zeros(0, dtype=int), 500, True)
    search = RobustSearch(None, ELASTIC, Ends(), (), 1.0, None)
    held = Round(search, Tried("a motion", 1, known), base, few)
    (kept,) = guards.guarded(held, count, robots, lambda q, number, draft: few, 3)
    assert asked[0].guards == 3
    np.testing.assert_allclose(asked[0].numbers[count:], robots.guards(np.array([1, 2, 3]))[0])
    assert (kept.corners, kept.scenarios.guards, kept.tried.solution.phi.shape[1]) == (1, 2, count + 2)
    assert guards.guarded(held._replace(lost=few._replace(few=False)), count, robots, None, 3) == []
