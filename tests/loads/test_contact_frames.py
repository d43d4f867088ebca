"""Frames on a wall: second derivatives beside differences of first ones, and the wall's law in masks."""

from dataclasses import replace

import numpy as np
import pytest
from distance_walls import BALL, TUBE
from hypothesis import given
from hypothesis import strategies as st
from lumens import bent

from ctr_nlp import Problem, Robot, Settings, Target, Tube
from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import OptionError
from ctr_nlp.loads.contact_equilibria import ContactEquilibria
from ctr_nlp.loads.contact_frames import ContactFrames, FrameMultipliers
from ctr_nlp.loads.contact_plan import harden
from ctr_nlp.loads.contact_rods import ContactStates
from ctr_nlp.loads.winkler_wall import PLANNED_TOE_DEPTH_MM, WinklerWall
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.loads import Load, with_modulus
from ctr_nlp.ocp.compiled_wall import WallDistance
from ctr_nlp.ocp.terms.arrival import find_arrival, with_arrival
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.walls import Walls

CURVED = with_modulus(Robot((Tube(90, 70, 0.006, 1.6, 1.2), Tube(150, 90, 0.006, 1.0, 0.6))), 60_000)
STIFFNESS_N_PER_MM2 = 0.05


@pytest.fixture(scope="module")
def frames() -> ContactFrames:
    """Two frames in which curved tubes press on a bend that they do not fit."""
    lengths = np.array([68.0, 72.0])
    problem = Problem("bend", CURVED, Target((bent(1.6, 85.0),) * 2, tuple(lengths.tolist())))
    wall = WinklerWall(problem.wall, STIFFNESS_N_PER_MM2, PLANNED_TOE_DEPTH_MM)
    equilibria = ContactEquilibria(CURVED, wall, Load(), searched=True)
    load = Load().numbers(2)
    q = np.array([[0.4, -1.6, 42.0, 68.0, 0.02, 0.01], [0.5, -1.5, 45.0, 72.0, 0.03, 0.02]])
    states = equilibria.follow_motion(q, np.stack([load, load]))
    arrival = find_arrival(with_arrival((), Settings(), KINEMATIC_MODELS["elastic"]))
    return ContactFrames(problem, equilibria, np.full(2, 0.9), arrival, states)


def multipliers_of(frames, seed=0):
    """Multipliers of all constraints, and those of the motors."""
    rng = np.random.default_rng(seed)
    motors, force = rng.normal(size=(2, 6)), rng.uniform(0, 20, size=(2, len(frames.states[0].pushes)))
    motors[:, 1:] = 0.0
    return FrameMultipliers(motors, np.array([-3.0, 2.0]), force)


def slope_of(frames, multipliers):
    """Slope (T, n) of the Lagrangian at the present equilibria, and its Hessian (T, n, n)."""
    found = frames.derivatives(multipliers)
    slope = found.cost_by + multipliers.margin[:, None] * found.margin_by
    slope += np.einsum("tk,tkn->tn", multipliers.force, found.force_by)
    return slope + np.einsum("tm,tmn->tn", multipliers.q, found.q_by), found.hessian


def test_second_differences_are_the_curvature_along_equilibria(frames):
    multipliers = multipliers_of(frames)
    y = frames.y.copy()
    _, hessian = slope_of(frames, multipliers)
    assert frames.values(y).force.max() > 0.01
    assert (frames.values(y).margin < 0.9 + 0.3).all()
    for column in range(y.shape[1]):
        step = np.zeros(y.shape[1])
        step[column] = 1e-4
        both = []
        for way in (1, -1):
            moved = replace(frames, states=list(frames.states))
            assert moved.move_to(y + way * step)
            both.append(slope_of(moved, multipliers)[0])
        expected = (both[0] - both[1]) / 2e-4
        size = abs(hessian).max(axis=(1, 2))[:, None]
        np.testing.assert_array_less(abs(hessian[:, column] - expected) / size, 2e-3)


def test_values_at_other_unknowns_are_those_of_equilibria_there(frames):
    y = frames.y + np.array([0.01, -0.02, 0.1, 0.1, 0.001, 0.0])
    found = frames.values(y)
    moved = replace(frames, states=list(frames.states))
    assert moved.move_to(y)
    for state, q, force in zip(moved.states, found.q, found.force, strict=True):
        np.testing.assert_array_equal(state.q, q)
        again, done = frames.equilibria.follow(state, state.q, state.load)
        assert done == 1
        np.testing.assert_allclose(again.angles, state.angles, atol=1e-6)
        assert frames.equilibria.force_mismatch(state) < 1e-4
        assert frames.equilibria.forces(ContactStates.stack([again])).at_places[0] == pytest.approx(
            force, abs=1e-5
        )
    assert frames.values(frames.y + 10.0) is None


def test_a_wall_is_hardened_around_the_shape(frames):
    """Tips keep their angles, and the motors bear what the wall presses more."""
    problem = frames.problem
    soft = ContactStates.stack(frames.states)
    hard = ContactStates.stack(harden(problem, soft, STIFFNESS_N_PER_MM2, 4 * STIFFNESS_N_PER_MM2))
    wall = WinklerWall(problem.wall, 4 * STIFFNESS_N_PER_MM2, PLANNED_TOE_DEPTH_MM)
    equilibria = ContactEquilibria(CURVED, wall, Load(), searched=True)
    forces = [
        of.forces(states).force.sum(axis=1) for of, states in ((frames.equilibria, soft), (equilibria, hard))
    ]
    assert (forces[1] > forces[0]).all()
    for states in (soft, hard):
        np.testing.assert_allclose(np.diff(states.angles, axis=1), np.diff(soft.angles, axis=1), atol=1e-6)
    for k in range(2):
        assert equilibria.force_mismatch(hard.row(k)) < 1e-4
    assert abs(hard.q - soft.q)[:, 0].max() > 1e-3
    with pytest.raises(OptionError, match="softer"):
        harden(problem, soft._replace(q=soft.q * np.nan), STIFFNESS_N_PER_MM2, 2 * STIFFNESS_N_PER_MM2)


LUMEN = Lumen(np.column_stack([np.zeros((141, 2)), np.arange(141.0), np.full(141, 5.0)]))


@pytest.mark.parametrize(
    "walls",
    [LUMEN, Walls(None, (TUBE,)), Walls(None, (TUBE, BALL)), Walls(LUMEN, (BALL,))],
    ids=["path", "body", "two bodies", "path and body"],
)
@given(st.integers(0, 10**6))
def test_slopes_of_pushes_are_exact(walls, seed):
    """Of paths and of fields: with others Newton's method does not converge, nor do searches."""
    rng = np.random.default_rng(seed)
    wall = WinklerWall(walls, STIFFNESS_N_PER_MM2, PLANNED_TOE_DEPTH_MM)
    points = np.column_stack([rng.uniform(-5, 5, size=(40, 2)), rng.uniform(10, 60, 40)])
    radius = np.full(40, 0.7)
    found = wall.push(points, radius)
    for k in range(3):
        step = 1e-5 * np.eye(3)[k]
        ahead, behind = (wall.push(points + way * step, radius).push for way in (1, -1))
        np.testing.assert_allclose(found.slope[:, :, k], (ahead - behind) / 2e-5, atol=2e-4)


def test_every_wall_presses_for_itself():
    """A lumen and a body in it: their pushes add up, and the deepest of both is told."""
    walls = [WinklerWall(each, 0.1) for each in (LUMEN, Walls(None, (BALL,)), Walls(LUMEN, (BALL,)))]
    points = np.array([[1.0, 1.0, 46.5], [4.8, 0.0, 30.0], [0.0, 4.7, 46.5]])
    lumen, ball, both = (wall.push(points, np.full(3, 0.7)) for wall in walls)
    np.testing.assert_allclose(both.push, lumen.push + ball.push)
    np.testing.assert_allclose(both.slope, lumen.slope + ball.slope)
    np.testing.assert_allclose(both.beyond, np.maximum(lumen.beyond, ball.beyond))
    assert (abs(both.push).max(axis=1) > 0).all()
    assert walls[0].is_narrower(points[:1], np.array([5.1])).tolist() == [True]
    assert walls[0].is_narrower(points[:1], np.array([4.9])).tolist() == [False]


def test_bodies_are_the_same_without_a_compiler(monkeypatch):
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-8, 8, size=(4, 5, 2)).reshape(-1, 2), rng.uniform(0, 100, 20)])
    distance = WallDistance(Walls(LUMEN, (TUBE, BALL)))
    compiled = distance.evaluate_bodies(points.reshape(4, 5, 3))
    assert len(compiled) == 2
    monkeypatch.setattr(cache, "unavailable_reason", lambda: "no compiler")
    for one, other in zip(compiled, distance.evaluate_bodies(points.reshape(4, 5, 3)), strict=True):
        for found, expected in zip(one, other, strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-9)
    assert WallDistance(LUMEN).evaluate_bodies(points) == []
