"""Corners of the tolerances that a robust motion would lose, kept by guards."""

from __future__ import annotations

import numpy as np
from truth import TWO

from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.scenarios import ConstraintScenarios
from ctr_nlp.ocp.shared.scenarios import (
    CONSTRAINT_SCENARIO_MARGIN_FRACTION,
    CONSTRAINT_SCENARIO_TIP_LIMIT_RAD,
    SCENARIO_TIP_LIMIT_RAD,
    shared_motion,
)
from ctr_nlp.problems import named_problem
from ctr_nlp.robust import constraint_scenarios
from ctr_nlp.robust.constraint_scenarios import (
    CONSTRAINT_SCENARIO_SCALE_STEP,
    CONSTRAINT_SCENARIO_START_SCALE,
    FrameVertices,
)
from ctr_nlp.robust.rounds import Round
from ctr_nlp.robust.search import RobustSearch, StartResult
from ctr_nlp.robust.tolerance_scenarios import scenarios_from_tolerances
from ctr_nlp.robust.tolerance_vertices import MAX_VERTEX_SCALE, ToleranceVertices
from ctr_nlp.robust.trials import FailedSamples
from ctr_nlp.solvers.scenarios import SharedSolution

ELASTIC = KINEMATIC_MODELS["elastic"]
OWN = np.arange(2)
"""The unknowns that two tubes' tips are."""


class _Bearing(ToleranceVertices):
    """Corners of which each bears a part of its difference that is known."""

    def _first_failure_frames(self, chosen, q, part):
        return np.where(np.ravel(part) > q[chosen], 1, 0)


def test_which_corners_are_lost_and_which_part_they_bear():
    parts = np.linspace(0.2, 1.6, 64)
    found = _Bearing.of(TWO, ELASTIC)
    np.testing.assert_array_equal(found.find_failing_vertices(parts), parts < 1.0)
    borne = found.find_failure_scales(parts)
    np.testing.assert_allclose(
        borne[parts < MAX_VERTEX_SCALE], parts[parts < MAX_VERTEX_SCALE], atol=MAX_VERTEX_SCALE / 2**5
    )
    assert np.isinf(borne[parts >= MAX_VERTEX_SCALE]).all()
    assert found.allowed_failures == 1


def test_guards_keep_less_margin_and_may_be_further_apart():
    problem = named_problem("cos", frames=2)
    scenarios = scenarios_from_tolerances(problem.robot)
    numbers = np.stack([scenarios.numbers[1:3], scenarios.numbers[3:5]])
    others = ConstraintScenarios(
        numbers, np.stack([scenarios.offsets[1:3], scenarios.offsets[3:5]]), np.zeros((2, 2, 3))
    )
    at = problem.robot, problem.target_frames, problem.dt, 1e-6, EndConfigurations(), ELASTIC
    motion = shared_motion(*at, scenarios, margins=np.full(2, 0.1), constraint_scenarios=others)
    parameters = motion.parameters.reshape(2, 15, -1)
    margins = parameters[..., motion.frame.parameter_slice("margin")][..., 0]
    np.testing.assert_allclose(
        margins, np.tile(np.r_[np.full(13, 0.1), np.full(2, CONSTRAINT_SCENARIO_MARGIN_FRACTION * 0.1)], (2, 1))
    )
    tubes = parameters[..., motion.frame.parameter_slice("tubes")].reshape(2, 15, 8, -1).swapaxes(2, 3)
    np.testing.assert_allclose(tubes, np.concatenate([np.tile(scenarios.numbers, (2, 1, 1, 1)), numbers], axis=1))
    np.testing.assert_allclose(motion.offsets[1, 13:], scenarios.offsets[3:5])
    np.testing.assert_allclose(motion.weights, np.r_[0.0, np.full(12, 1 / 12), 0.0, 0.0])
    np.testing.assert_allclose(
        motion.max_tip_differences,
        np.r_[np.full(13, SCENARIO_TIP_LIMIT_RAD), np.full(2, CONSTRAINT_SCENARIO_TIP_LIMIT_RAD)],
    )
    sums, own = motion.by_robot(np.ones(motion.row_bounds[0].shape)), len(motion.own_rows)
    np.testing.assert_allclose(sums, np.tile(np.r_[own, np.full(14, own + 2)], (2, 1)))


def test_a_frame_keeps_the_guards_that_cost_something_there():
    """Frame 0 needs corners 7 and 9 of three, frame 1 none of them, but has as many."""
    placed = FrameVertices(np.tile([7, 8, 9], (2, 1)), np.arange(6.0).reshape(2, 3, 1))
    burdens = np.array([[5.0, 1.0, 0.0, 2.0], [5.0, 0.0, 0.0, 1e-9]])
    phi = np.concatenate([np.zeros((2, 1, 1)), placed.tips], axis=1)
    kept = placed.keep_active(
        SharedSolution(np.zeros(2), phi, 1.0, 0.0, 0.0, 0.0, "solved", 1, OWN, constraint_multipliers=burdens)
    )
    assert kept.corners[0].tolist() == [9, 7]
    np.testing.assert_allclose(kept.tips[0, :, 0], [2.0, 0.0])
    assert kept.corners.shape == (2, 2)


def test_guards_join_until_few_corners_are_lost(monkeypatch):
    """Those that bear least are given up; the others are lost as long as they are no guards; one needs more."""
    asked, parts = [], np.r_[0.5, 0.9, 0.95, 1.03, np.full(60, 2.0)]
    robots, base = _Bearing.of(TWO, ELASTIC), scenarios_from_tolerances(TWO)
    count = len(base)

    def solved(search, tried, scenarios, barrier):
        asked.append(search.guards)
        bears = np.r_[0.5, 1.2, 0.98 if len(asked) == 1 else 1.2, 1.2, np.full(60, 2.0)]
        size = search.guards.offsets.shape[1]
        burdens = np.r_[np.zeros(count), np.ones(size)][None]
        phi = np.zeros((1, count + size, 2))
        return StartResult(
            "a motion",
            1,
            SharedSolution(bears, phi, 1.01, 0.0, 0.0, 0.0, "solved", 1, OWN, constraint_multipliers=burdens),
        )

    monkeypatch.setattr(constraint_scenarios, "solve_with_scenarios", solved)
    known = SharedSolution(parts, np.zeros((1, count, 2)), 1.0, 0.0, 0.0, 0.0, "solved", 1, OWN)
    few = FailedSamples(base.numbers[:0], base.offsets[:0], base.forces[:0], np.zeros(0, dtype=int), 500, True)
    held = Round(
        RobustSearch(None, ELASTIC, EndConfigurations(), (), 1.0, None),
        StartResult("a motion", 1, known),
        base,
        few,
    )
    (kept,) = constraint_scenarios.plan_with_constraint_scenarios(
        held, base, robots, lambda q, number, draft: few, 3
    )
    assert kept.corners == 1
    assert kept.search.guards is asked[-1]
    np.testing.assert_allclose(
        asked[0].numbers[0], robots.with_part(np.array([1, 2, 3]), CONSTRAINT_SCENARIO_START_SCALE).numbers
    )
    assert len(asked) == 2
    again = robots.with_part(
        np.array([2]), CONSTRAINT_SCENARIO_START_SCALE + CONSTRAINT_SCENARIO_SCALE_STEP
    ).numbers[0]
    assert any(np.allclose(own, again) for own in asked[1].numbers[0])
    assert (
        constraint_scenarios.plan_with_constraint_scenarios(
            held._replace(lost=few._replace(few=False)), base, robots, None, 3
        )
        == []
    )
