"""The wall as a smooth cost: what it costs is what is claimed, and its derivatives are those of that."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from frames import elastic_shapes
from lumens import wandering
from truth import TWO

from ctr_nlp import Problem, Settings, curve_from_points, growing
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.ocp.shared.scenarios import shared_motion
from ctr_nlp.ocp.terms.lumen import WALL_SAMPLES_PER_TUBE, arc_lengths, contact_penalty
from ctr_nlp.ocp.terms.smooth_contact import CONTACT_SMOOTHING_MM
from ctr_nlp.ocp.wall import PLANNED_CONTACT_FRACTION, make_wall
from ctr_nlp.paths.lumen import Lumen, tube_outer_radii
from ctr_nlp.solvers.scenarios.condensed import Condensed

FRAMES, CLEARANCE, WEIGHT = 3, 0.2, 7.0
OFFSETS = np.array([[0.0, 0.0], [0.2, -0.1]])


def _robots():
    strong = replace(TWO.tubes[0], curvature=(0.012, 0.03)), TWO.tubes[1]
    return TWO, replace(TWO, tubes=strong)


@pytest.fixture(scope="module")
def lumen():
    """A wandering one that is wide enough for tubes that are hardly out."""
    narrow, s = wandering(1, bend=1 / 60, length=90.0), np.linspace(0, 90, 91)
    return curve_from_points(narrow.point(s), narrow.radius(s) + 3)


@pytest.fixture(scope="module")
def motions(lumen):
    """Free of the wall, and within it."""
    problem = Problem("wandering", TWO, growing(lumen.part(0, 70.0), FRAMES), lumen=lumen)
    settings = Settings(clearance=CLEARANCE, contact_weight=WEIGHT)
    wall = make_wall(TWO, Lumen.from_curve(lumen), KINEMATIC_MODELS["elastic"], settings, subsamples=1)
    scenarios = Scenarios(np.array([robot.numbers for robot in _robots()]), OFFSETS, np.ones(2))
    at = TWO, problem.target_frames, problem.dt, 1e-6, EndConfigurations(), KINEMATIC_MODELS["elastic"], scenarios
    return [shared_motion(*at, wall=each) for each in (None, wall)]


@pytest.fixture(scope="module")
def point():
    """A motion that leaves the lumen, and tips of both robots."""
    rng = np.random.default_rng(2)
    beta = np.array([[6.0, 12.0], [30.0, 45.0], [40.0, 70.0]])
    q = np.column_stack([rng.uniform(-1, 1, (FRAMES, 2)), beta, rng.uniform(-0.1, 0.1, (FRAMES, 2))])
    return q, rng.uniform(-1, 1, (FRAMES, 2, 2))


def test_contact_costs_a_smooth_maximum_of_the_depths_at_all_places(motions, point, lumen):
    q, phi = point
    found = [Condensed(motion) for motion in motions]
    assert found[1].update_local_parameters(q, phi)
    cost = found[1].by_robot(q, phi) - found[0].by_robot(q, phi)
    around, depths = Lumen.from_curve(lumen), np.empty((FRAMES, 2, 2 * WALL_SAMPLES_PER_TUBE))
    for k, robot in enumerate(_robots()):
        x = np.concatenate([phi[:, k], q[:, 2:]], axis=1)
        sigma = np.hstack(arc_lengths([q[:, 2:3], q[:, 3:4]])) / q[:, 3:4]
        near = around.project(elastic_shapes(robot, x, sigma))
        room = near.radius - np.repeat(tube_outer_radii(robot), WALL_SAMPLES_PER_TUBE) - CLEARANCE
        depths[:, k] = near.distance - room
    assert depths.max() > 1.0  # something touches
    assert depths.max(axis=2).min() < 0.0  # something else does not
    deepest = CONTACT_SMOOTHING_MM * np.log1p(np.exp(depths / CONTACT_SMOOTHING_MM).sum(axis=2))
    allowed = CLEARANCE + PLANNED_CONTACT_FRACTION * Settings().contact_allowed
    wanted = np.array(ca.DM(contact_penalty(ca.DM(deepest), WEIGHT, allowed)))
    np.testing.assert_allclose(cost, wanted, rtol=0.02, atol=0.1)
    assert (cost >= WEIGHT * np.maximum(depths.max(axis=2), 0) - 0.1).all()


def test_what_surrounds_robots_is_looked_at_once_where_it_stays(motions, point):
    free, within = (Condensed(motion) for motion in motions)
    q, phi = point
    assert not free.update_local_parameters(q, phi)
    assert within.update_local_parameters(q, phi)
    before = within.by_robot(q, phi)
    assert not within.update_local_parameters(q, phi)
    np.testing.assert_array_equal(within.by_robot(q, phi), before)
    far = q + np.array([0, 0, 5.0, 9.0, 0.1, 0])
    kept = within.by_robot(far, phi)
    assert not within.update_local_parameters(far, phi, relative_tolerance=1e3)
    np.testing.assert_array_equal(within.by_robot(far, phi), kept)


def test_derivatives_match_finite_differences(motions, point):
    """Of the whole frame's program near a wall, over all its unknowns."""
    condensed, motion = Condensed(motions[1]), motions[1]
    q, phi = point
    condensed.update_local_parameters(q, phi)
    frames, count, _, d = motion.sizes
    none = np.zeros((frames, count, d)), np.zeros(motion.row_bounds[0].shape)
    about = condensed.expand(q, phi, *none)
    rng, h = np.random.default_rng(3), 1e-5
    way = rng.normal(size=(frames, count, 2 * d + 2))
    way[..., d:] = way[:, :1, d:]  # extensions and tilts belong to all robots
    sides = []
    for sign in (-h, h):
        dq = np.concatenate([np.zeros((frames, d)), way[:, 0, d:]], axis=1)
        here = q + sign * dq, phi + sign * way[..., :d]
        sides.append((condensed.by_robot(*here), condensed.expand(*here, *none).gradient))
    slopes = (about.gradient * way).sum(axis=2) / motion.weights
    np.testing.assert_allclose((sides[1][0] - sides[0][0]) / (2 * h), slopes, rtol=1e-4, atol=1e-4)
    turned = (about.hessian @ way[..., None])[..., 0]
    expected = (sides[1][1] - sides[0][1]) / (2 * h)
    np.testing.assert_allclose(expected, turned, atol=1e-4 * abs(turned).max())


def test_lighter_programs_find_the_same(lumen):
    """Robots that the wall is far from go without it, and those that do not count without any objective."""
    wide = curve_from_points(lumen.point(np.linspace(0, 90, 91)), np.full(91, 12.0))
    problem = Problem("wandering", TWO, growing(wide.part(0, 70.0), FRAMES), lumen=wide)
    wall = make_wall(TWO, Lumen.from_curve(wide), KINEMATIC_MODELS["elastic"], Settings(), subsamples=1)
    numbers = np.array([robot.numbers for robot in (*_robots(), TWO)])
    scenarios = Scenarios(numbers, np.zeros((3, 2)), np.array([1.0, 2.0, 0.0]))
    at = TWO, problem.target_frames, problem.dt, 1e-6, EndConfigurations(), KINEMATIC_MODELS["elastic"], scenarios
    motion = shared_motion(*at, margins=np.full(FRAMES, 0.1), wall=wall)
    assert motion.without_wall is not None
    assert motion.without_objective is not None
    beta = np.array([[6.0, 12.0], [30.0, 45.0], [40.0, 70.0]])
    q = np.column_stack([np.zeros((FRAMES, 2)), beta, np.tile([0.0, 0.2], (FRAMES, 1))])
    phi = np.random.default_rng(4).uniform(-0.5, 0.5, (FRAMES, 3, 2))
    lighter, whole = Condensed(motion), Condensed(replace(motion, without_wall=None, without_objective=None))
    for each in (lighter, whole):
        each.update_local_parameters(q, phi)
    rng = np.random.default_rng(5)
    pulls = rng.normal(size=(FRAMES, 3, 2)), rng.normal(size=motion.row_bounds[0].shape)
    found, wanted = (each.expand(q, phi, *pulls) for each in (lighter, whole))
    assert found.at.objective == pytest.approx(wanted.at.objective, abs=0.02)
    for name in ("gradient", "hessian", "own", "jacobian", "unknowns_jacobian", "repair"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-3, atol=0.05, err_msg=name)
