"""Equilibria on a wall that gives: against textbooks, collocation from base to tip, and differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from contact_truth import Bend, Cylinder, solve_contact
from loaded_plans import TWO

from ctr_nlp import Load, Robot, Tube, table_i_robot
from ctr_nlp.loads.contact_equilibria import CONTACT_FORCE_TOLERANCE_N, ContactEquilibria
from ctr_nlp.loads.contact_neighbours import ContactNeighbours
from ctr_nlp.loads.contact_rods import ContactState, ContactStates
from ctr_nlp.loads.winkler_wall import TOE_DEPTH_MM, WinklerWall
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.loaded.equilibria import States
from ctr_nlp.models.loaded.stability import margins
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID

RIGID_N_PER_MM2 = 1e3
NITINOL = with_modulus(TWO, 60_000)
ROD = with_modulus(Robot((Tube(200, 150, 0.0, 1.5, 1.0),)), 60_000)


def lumen_along(point, direction, radius, length=200.0):
    s = np.linspace(-20.0, length, 441)
    points = np.asarray(point) + s[:, None] * np.asarray(direction) / np.linalg.norm(direction)
    return Lumen(np.column_stack([points, np.full(len(s), radius)]))


def placed(robot, wall, stiffness, q, load=None, toe=TOE_DEPTH_MM):
    load = load or Load()
    equilibria = ContactEquilibria(robot, WinklerWall(wall, stiffness, toe), load)
    state = equilibria.place(np.asarray(q, dtype=float), load.numbers(robot.d))
    assert state is not None
    return equilibria, state


def random_scene(seed):
    """A robot of one to three tubes in a straight or bent lumen that it touches, and both descriptions of the
    wall."""
    rng = np.random.default_rng(seed)
    d = int(rng.integers(1, 4))
    outer = np.array([2.4, 1.6, 1.0])[-d:] * rng.uniform(0.9, 1.1)
    tubes = tuple(
        Tube(300.0, 140.0, float(rng.uniform(0.004, 0.014)), float(each), float(each - 0.45)) for each in outer
    )
    robot = with_modulus(Robot(tubes), 60_000)
    beta = np.sort(rng.uniform(25, 110, d))
    beta = beta + 8 * np.arange(d)
    q = np.concatenate([rng.uniform(-1.0, 1.0, d), beta, rng.uniform(-0.1, 0.1, 2)])
    stiffness = float(10 ** rng.uniform(-2, 0))
    radius = float(rng.uniform(2.5, 6.0))
    s = np.linspace(-10.0, 160.0, 681)
    if rng.random() < 0.5:
        direction = np.array([*rng.uniform(-0.15, 0.15, 2), 1.0])
        points = s[:, None] * direction / np.linalg.norm(direction)
        wall = Cylinder(np.zeros(3), direction, radius, stiffness)
    else:
        bend, towards = float(rng.uniform(60, 150)), float(rng.uniform(0, 2 * np.pi))
        x = np.array([np.cos(towards), np.sin(towards), 0.0])
        z = np.array([0.0, 0.0, 1.0])
        points = bend * ((1 - np.cos(s / bend))[:, None] * x + np.sin(s / bend)[:, None] * z)
        wall = Bend(bend, towards, radius, stiffness)
    return robot, q, wall, Lumen(np.column_stack([points, np.full(len(s), radius)])), stiffness


def check_scene(scene):
    """Compare with collocation: shape within 0.01 mm, total force within 1 %.

    A robot may have several equilibria on the wall. Collocation begins at the shape and the tubes' angles that the
    library found: that it stays there shows that this is one of them, not that there is no other.
    """
    robot, q, wall, lumen, stiffness = scene
    equilibria, state = placed(robot, lumen, stiffness, q)
    length = q[2 * robot.d - 1]

    def start(s):
        points = equilibria.shape(state, s / length)
        tangents = np.gradient(points, s, axis=0)
        return points, tangents / np.linalg.norm(tangents, axis=1, keepdims=True)

    points, force = solve_contact(robot, q, wall, start, (state.angles, state.axes))
    apart = np.linalg.norm(equilibria.shape(state, SIGMA_GRID) - points(SIGMA_GRID * length), axis=1)
    assert apart.max() < 0.01
    # Of forces too small to matter, 1 % is less than what the pushes are solved to.
    assert equilibria.forces(ContactStates.stack([state])).force.sum() == pytest.approx(
        force, rel=0.01, abs=CONTACT_FORCE_TOLERANCE_N
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_random_scenes_are_those_of_collocation(seed):
    check_scene(random_scene(seed))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 200))
def test_two_hundred_random_scenes_are_those_of_collocation(seed):
    check_scene(random_scene(seed))


@pytest.mark.parametrize("overlap", [0.2, 1.0])
def test_cantilever_on_a_rigid_plane_has_the_textbook_force(overlap):
    """Its tip alone touches: F = 3 E I delta / L^3 (Gere and Goodno, Mechanics of Materials, appendix on
    beams)."""
    length, plane, wide = 100.0, 3.0, 1e5
    # A lumen so wide is a plane. The rod leans towards it, so that its tip is first to touch.
    wall = lumen_along([plane + ROD.tubes[0].outer_diameter / 2 - wide, 0.0, 0.0], [0.0, 0.0, 1.0], wide)
    lean = np.arcsin((plane + overlap) / length)
    equilibria, state = placed(ROD, wall, RIGID_N_PER_MM2, [0.0, length, 0.0, lean], toe=1e-3)
    (found,) = ContactNeighbours(equilibria).slopes(ContactStates.stack([state]), np.ones(1))
    assert found.points[0, 0] == pytest.approx(plane, abs=0.005)
    expected = 3 * ROD.tubes[0].bending_stiffness * overlap / length**3
    assert found.force.sum() == pytest.approx(expected, rel=0.01)


def test_slopes_are_those_of_equilibria_nearby():
    """Over the coordinates of the tip, and, by the chain rule, over the configuration."""
    q = np.array([0.2, 0.5, 45.0, 70.0, 0.02, 0.1])
    equilibria, state = placed(NITINOL, lumen_along([0, 0, 0], [0, 0.05, 1.0], 4.0), 0.032, q)
    (found,) = ContactNeighbours(equilibria).slopes(ContactStates.stack([state]), SIGMA_GRID)
    assert found.force.sum() > 0.1
    over_q = np.linalg.inv(found.q_by)
    for column in range(len(q)):
        step = np.zeros(len(q))
        step[column] = 1e-4
        both = []
        for way in (1, -1):
            there, done = equilibria.follow(state, q + way * step, state.load)
            assert done == 1
            both += ContactNeighbours(equilibria).slopes(ContactStates.stack([there]), SIGMA_GRID)
        ahead, behind = both
        for name, least in (("points", 1.0), ("force", 0.01), ("force_at_places", 0.01)):
            slope = (getattr(ahead, name) - getattr(behind, name)) / 2e-4
            by = getattr(found, f"{name}_by") @ over_q[:, column]
            np.testing.assert_allclose(by, slope, atol=1e-3 * max(least, abs(slope).max()))


def test_slopes_of_margins_are_those_of_equilibria_nearby():
    robot = with_modulus(Robot((Tube(90, 70, 0.006, 1.6, 1.2), Tube(150, 90, 0.006, 1.0, 0.6))), 60_000)
    q = np.array([0.65, -2.17, 44.6, 72.0, 0.04, -0.03])
    equilibria, state = placed(robot, lumen_along([0, 0, 0], [0, 0, 1.0], 3.0), 0.032, q)
    assert equilibria.forces(ContactStates.stack([state])).force.sum() > 0.01
    here, nearby = ContactStates.stack([state]), ContactNeighbours(equilibria)
    at = equilibria.margins(here) - 0.05
    slopes = nearby.slopes(here, SIGMA_GRID)
    (found,) = nearby.margin_slopes(here, slopes, at)
    assert abs(found).max() > 0.01
    for column in range(len(q)):
        step = np.zeros(len(q))
        step[column] = 1e-3
        both = nearby.predict(here, slopes, np.stack([step, -step])[None])
        near = nearby.settle(both, slopes * 2)
        assert None not in near
        ahead, behind = equilibria.smooth_margins(ContactStates.stack(near), np.repeat(at, 2))
        assert found[column] == pytest.approx((ahead - behind) / 2e-3, abs=1e-3 * max(0.1, abs(found).max()))


def test_smooth_margins_are_exact_where_they_are_tested():
    """Above that they are less than the margin, and close to it while other eigenvalues are far."""
    robot = with_modulus(Robot((Tube(90, 70, 0.006, 1.6, 1.2), Tube(150, 90, 0.006, 1.0, 0.6))), 60_000)
    q = np.array([0.65, -2.17, 44.6, 72.0, 0.04, -0.03])
    equilibria, state = placed(robot, lumen_along([0, 0, 0], [0, 0, 1.0], 3.0), 0.032, q)
    margin = equilibria.margins(ContactStates.stack([state]))
    at = margin + np.array([-0.1, -0.01, -1e-6, 0.005])
    found = equilibria.known_margins(ContactStates.stack([state] * 4), at)
    assert found[2] == pytest.approx(margin[0], abs=1e-6)
    assert (found[:2] < margin).all()
    assert (found[:2] > at[:2]).all()
    np.testing.assert_allclose(found, np.repeat(margin, 4), atol=0.002)
    alone, rod = placed(ROD, lumen_along([0, 0, 0], [0, 0, 1.0], 9.0), 0.032, [0.0, 100.0, 0.0, 0.0])
    assert alone.known_margins(ContactStates.stack([rod]), np.array([0.1])) == [1.0]
    curled = with_modulus(Robot(tuple(replace(tube, curvature=0.06) for tube in robot.tubes)), 60_000)
    held, aligned = placed(curled, lumen_along([0, 0, 0], [0, 0, 1.0], 8.0), 0.3, [0.5, 0.5, 44.6, 72.0, 0, 0])
    assert held.margins(ContactStates.stack([aligned])) > 0.9
    assert (held.known_margins(ContactStates.stack([aligned] * 3), np.array([0.0, 0.1, 0.5])) > 0.9).all()


def test_smooth_margins_have_no_corner_where_eigenvalues_cross():
    """Of three tubes either turn against each other may be the one that snaps."""
    robot = with_modulus(table_i_robot(), 60_000)
    q = np.array([0.0, 3.2, 1.9, 47.0, 59.0, 88.7, -0.04, -0.09])
    equilibria, state = placed(robot, lumen_along([0, 0, 0], [0, 0, 1.0], 60.0), 0.032, q)
    here, nearby = ContactStates.stack([state]), ContactNeighbours(equilibria)

    def neighbours(steps):
        slopes = nearby.slopes(here, SIGMA_GRID)
        return nearby.predict(here, slopes, steps[None]), slopes

    for left in range(30, 0, -1):
        step = np.zeros((1, 8))
        step[0, :2] = (np.array([-2.196, 1.581]) - nearby.coordinates(here)[0, :2]) / left
        (reached,) = nearby.settle(*neighbours(step))
        here = ContactStates.stack([reached])
    steps = np.zeros((401, 8))
    steps[:, 0] = np.linspace(-0.05, 0.05, 401)
    near, _ = neighbours(steps)
    margins = equilibria.margins(near)
    smooth = equilibria.known_margins(near, np.full(401, margins.min() - 1e-3))
    assert (smooth < margins).all()
    corner, bend = (abs(np.diff(each, 2)).max() for each in (margins, smooth))
    assert corner > 5e-5
    assert bend < 0.1 * corner
    beyond = np.sort(margins)[[100, 300]].mean()
    kept = equilibria.known_margins(near, np.full(401, beyond))
    assert (kept[margins > beyond] > beyond).all()
    assert not (kept[margins < beyond] >= beyond).any()


def test_the_wall_gets_stiff_around_its_surface():
    """Beyond half of the toe it is a straight foundation; nowhere is it softer than that."""
    radius, stiffness, toe = 4.0, 0.05, 0.4
    wall = WinklerWall(lumen_along([0, 0, 0], [0, 0, 1.0], radius), stiffness, toe)
    depth = np.array([-0.2, -0.1, 0.0, 0.1, 0.2, 0.7])
    points = np.column_stack([radius - 1.0 + depth, 0 * depth, 0 * depth + 50.0])
    push = wall.push(points, np.ones(6))
    expected = [0.0, 0.4 * (0.25**3 - 0.25**4 / 2), 0.4 * (0.5**3 - 0.5**4 / 2)]
    np.testing.assert_allclose(
        -push.push[[0, 1, 2, 4, 5], 0], stiffness * np.array([*expected, 0.2, 0.7]), atol=1e-9
    )
    assert (-push.push[:, 0] >= stiffness * depth - 1e-12).all()
    np.testing.assert_allclose(-push.slope[[0, 4, 5], 0, 0], [0, stiffness, stiffness], atol=1e-9)


def column_on_a_foundation(length, force, stiffness, count=100):
    """Least eigenvalue mu of (B - P G + k M) x = mu B x of a cantilever, by cubic finite elements."""
    h = length / count
    parts = {
        "B": np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]])
        * ROD.tubes[0].bending_stiffness
        / h**3,
        "G": np.array([[36, 3, -36, 3], [3, 4, -3, -1], [-36, -3, 36, -3], [3, -1, -3, 4]]) * force / (30 * h),
        "M": np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]])
        * stiffness
        * h
        / 420,
    }
    scale = np.array([1, h, 1, h])
    whole = {name: np.zeros((2 * count + 2, 2 * count + 2)) for name in parts}
    for k in range(count):
        here = slice(2 * k, 2 * k + 4)
        for name, matrix in parts.items():
            whole[name][here, here] += scale[:, None] * matrix * scale
    bending, moved, founded = (matrix[2:, 2:] for matrix in whole.values())
    return scipy.linalg.eigh(bending - moved + founded, bending, eigvals_only=True)[0]


@pytest.mark.parametrize(("force", "stiffness"), [(1.0, 0.002), (6.0, 0.002), (12.0, 0.01), (12.0, 0.002)])
def test_margin_to_buckling_is_that_of_a_column_on_a_foundation(force, stiffness):
    """A rod in a lumen that is too narrow has the wall on both sides, wherever it bends to."""
    load = Load(force=(0.0, 0.0, -force))
    # Beside the axis by so little that the rod stays straight, but the wall has a direction.
    wall = lumen_along([1e-7, 0.0, 0.0], [0.0, 0.0, 1.0], 0.5)
    # With so short a toe the wall is straight at this depth, as the textbook's foundation is.
    equilibria = ContactEquilibria(ROD, WinklerWall(wall, stiffness / 2, toe=0.1), load)
    q = np.array([0.0, 100.0, 0.0, 0.0])
    straight = ContactState(
        q, load.numbers(1), np.zeros(1), np.eye(3), np.zeros((equilibria.kind.pieces, 2, 3)), 1.0
    )
    expected = column_on_a_foundation(100.0, force, stiffness)
    assert equilibria.margins(ContactStates.stack([straight]), bending=True)[0] == pytest.approx(
        expected, abs=1e-4
    )


def test_margin_vanishes_where_the_robot_snaps_on_the_wall():
    """As dead loads, the same forces would have snapped it long before."""
    long = with_modulus(Robot((Tube(390, 70, 0.01, 4.0, 3.2), Tube(550, 90, 0.01, 2.6, 1.6))), 60_000)
    q = np.array([0.0, 0.0, 60.0, 80.0, 0.0, 0.0])
    equilibria, state = placed(long, lumen_along([0, 0, 0], [0, 0, 1.0], 4.0), 0.05, q)
    q[0] = 6.0
    last, done = equilibria.follow(state, q, state.load)
    assert 0 < done < 1
    assert equilibria.margins(ContactStates.stack([state, last]))[0] > 0.9
    assert equilibria.margins(ContactStates.stack([last]))[0] == pytest.approx(0, abs=0.01)
    row = np.concatenate([last.load, last.pushes.ravel()])
    dead = States.unknown_states(long.numbers[None], last.q[None], row[None])
    dead = dead._replace(angles=last.angles[None], axes=last.axes[None])
    assert margins(equilibria.equilibria, dead)[0] < -0.1


def test_margin_far_from_the_wall_is_that_of_the_elastic_model():
    q = np.array([0.65, -2.17, 44.6, 72.0, 0.04, -0.03])
    robot = with_modulus(Robot((Tube(90, 70, 0.006, 1.6, 1.2), Tube(150, 90, 0.006, 1.0, 0.6))), 60_000)
    equilibria, state = placed(robot, lumen_along([0, 0, 0], [0, 0, 1.0], 60.0), 0.032, q)
    expected = KINEMATIC_MODELS["elastic"].follow(robot, q[None]).stability[0]
    assert expected < 0.99
    assert equilibria.margins(ContactStates.stack([state]))[0] == pytest.approx(expected, abs=1e-4)
