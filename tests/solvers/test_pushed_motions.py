"""Motions that robots share which bear forces of their own: tips under a load are unknowns with their axes."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from loaded_plans import TWO
from test_shared_motions import check_derivatives, repaired

from ctr_nlp import Load, Loaded, Problem, curve_from_formula, growing
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS, model_with_tip_forces
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.models.protocol import subdivide_motion
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.ocp.shared.scenarios import shared_motion
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.solvers.scenarios import SharedSolver
from ctr_nlp.solvers.scenarios.condensed import Condensed

pytestmark = pytest.mark.interpreted
FRAMES, MARGIN, STEPS = 3, 0.1, 8
NITINOL = with_modulus(TWO, 60_000)
OFFSETS = np.array([[0.0, 0.0], [0.08, -0.05], [0.0, 0.0], [-0.04, 0.06]])
FORCES = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, -0.4, 0.2], [0.1, 0.1, -0.3]])


@pytest.fixture(scope="module")
def problem():
    """A bend in space that two tubes cannot follow exactly."""
    curve = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 75.0)
    return Problem("bend", NITINOL, growing(curve, FRAMES), duration=4.0)


def _scenarios(forces=FORCES):
    numbers = np.repeat(NITINOL.numbers[None], len(forces), axis=0)
    numbers[1, :, :2] *= 1.05
    return Scenarios(numbers, OFFSETS[: len(forces)], np.array([1.0, 1.0, 1.0, 0.0])[: len(forces)], forces)


def _motion(problem, scenarios, load):
    at = problem.target_frames, problem.dt, 1e-4, EndConfigurations(), Loaded(load), scenarios
    return shared_motion(NITINOL, *at, fastest_functions, np.full(FRAMES, MARGIN))


@pytest.fixture(scope="module", params=[Load(), Load(force=(0.0, 0.1, -0.2))], ids=["no load", "a load"])
def load(request):
    """What all robots bear beside their own forces."""
    return request.param


@pytest.fixture(scope="module")
def motion(problem, load):
    return _motion(problem, _scenarios(), load)


@pytest.fixture(scope="module")
def q(problem):
    beta = np.array(problem.target.lengths)
    alpha = np.linspace([1.0, 0.2], [2.0, -0.2], FRAMES)
    return np.column_stack([alpha, 0.55 * beta, beta, np.full(FRAMES, 0.1), np.full(FRAMES, -0.05)])


def _standing(scenarios, load, q):
    """The unknowns (S, T, 6) of robots that are followed one by one, and their margins (S, T)."""
    way = subdivide_motion(q, STEPS)
    places = np.repeat(way.q[None], len(scenarios), axis=0)
    places[..., :2] += scenarios.offsets[:, None]
    model = model_with_tip_forces(Loaded(load), scenarios.forces)
    found = model.follow_batch(NITINOL.structure, scenarios.numbers, way, places)
    return np.array([each.x for each in found]), np.array([each.stability for each in found])


def test_a_tip_under_a_load_has_its_axes_as_unknowns_beside_the_tilt(motion):
    np.testing.assert_array_equal(motion.own, [0, 1, 4, 5])
    np.testing.assert_array_equal(motion.shared_entries, [2, 3, 6, 7])


def test_robots_in_equilibrium_miss_nothing(motion, q, load):
    x, _ = _standing(_scenarios(), load, q)
    values = Condensed(motion).value(q, x.swapaxes(0, 1)[..., motion.own])
    np.testing.assert_allclose(values.equation_residuals, 0, atol=1e-3)  # programs integrate in fewer steps


def test_whole_turns_of_all_tubes_are_not_missed(motion, q, load):
    """The angles of motors are found but for these."""
    x, _ = _standing(_scenarios(), load, q)
    tips = x.swapaxes(0, 1)[..., motion.own]
    condensed, turned = Condensed(motion), tips.copy()
    turned[:, 1, 1] += 2 * np.pi
    expected = condensed.value(q, tips).equation_residuals
    np.testing.assert_allclose(condensed.value(q, turned).equation_residuals, expected, atol=1e-9)


def test_derivatives_with_tips_eliminated_are_those_of_robots_in_equilibrium(motion, q, load):
    condensed, (x, _) = Condensed(motion), _standing(_scenarios(), load, q)
    check_derivatives(condensed, motion, q, repaired(condensed, motion, q, x.swapaxes(0, 1)[..., motion.own]))


def test_what_is_found_is_where_robots_come_to_under_their_forces(motion, q, load):
    """Followed one by one, by another solver; all keep their margin."""
    tips = _standing(_scenarios(), load, q)[0][:1].swapaxes(0, 1)[..., motion.own]
    found = SharedSolver(motion)(q, np.repeat(tips, len(FORCES), axis=1))
    assert found.success, found
    x, margins = _standing(_scenarios(), load, found.q)
    apart = x.swapaxes(0, 1)[..., motion.own] - found.phi
    apart[..., 1] -= 2 * np.pi * np.round(apart[..., 1] / (2 * np.pi))
    np.testing.assert_allclose(apart, 0, atol=2e-3)
    assert margins.min() > MARGIN - 2e-3
    np.testing.assert_allclose(found.x[:, 2:4], found.q[:, 2:4])
    np.testing.assert_allclose(found.x[:, motion.own], found.phi[:, 0])


def test_without_forces_it_is_what_is_found_without_loads(problem, q):
    """Two sets of unknowns for the same motion."""
    scenarios = _scenarios(np.zeros((3, 3)))
    loaded = _motion(problem, scenarios, Load())
    at = problem.target_frames, problem.dt, 1e-4, EndConfigurations(), KINEMATIC_MODELS["elastic"], scenarios
    plain = shared_motion(NITINOL, *at, fastest_functions, np.full(FRAMES, MARGIN))
    expected = SharedSolver(plain)(
        q, KINEMATIC_MODELS["elastic"].follow(NITINOL, q).x[:, None, :2].repeat(3, axis=1)
    )
    assert expected.success
    x, _ = _standing(scenarios, Load(), expected.q)
    found = SharedSolver(loaded)(expected.q, x.swapaxes(0, 1)[..., loaded.own], 1e-3)
    assert found.success
    assert found.objective == pytest.approx(expected.objective, rel=2e-3)
    np.testing.assert_allclose(found.q, expected.q, atol=0.05)


def test_forces_need_a_model_that_knows_them(problem):
    at = problem.target_frames, problem.dt, 1e-4, EndConfigurations(), KINEMATIC_MODELS["elastic"]
    with pytest.raises(OptionError, match="scenarios have tip forces, which the elastic model without a load"):
        shared_motion(NITINOL, *at, _scenarios())


def test_forces_shrink_with_what_robots_differ_by_and_join_with_others():
    scenarios = _scenarios()
    np.testing.assert_allclose(scenarios.shrink_differences(0.5).forces, FORCES / 2)
    np.testing.assert_allclose(scenarios.shrink_differences(0.5, 2).forces, [*FORCES[:2], *FORCES[2:] / 2])
    joined = scenarios.append_robots(scenarios.numbers[1:2], scenarios.offsets[1:2], FORCES[2:3])
    np.testing.assert_allclose(joined.forces, [*FORCES, FORCES[2]])
    assert joined.weights[-1] == 0
    with pytest.raises(OptionError, match="forces of scenarios"):
        replace(scenarios, forces=np.ones((2, 3)))
