"""Robots within a wall that gives: against a boundary-value problem of a planar rod, and what holds of forces."""

from __future__ import annotations

import numpy as np
import pytest
from contact_truth import compressed
from loaded_plans import TWO
from scipy.integrate import solve_bvp

from ctr_nlp import Load, Robot, Tube
from ctr_nlp.loads.contact_equilibria import CONTACT_FORCE_TOLERANCE_N
from ctr_nlp.loads.wall_contact import Foundation
from ctr_nlp.loads.winkler_wall import TOE_DEPTH_MM
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID

NITINOL, RADIUS = with_modulus(TWO, 60_000), 4.0
FRAMES = 5


def straight(radius=RADIUS):
    """Along the base's direction."""
    s = np.linspace(-5.0, 120.0, 251)
    return Lumen(np.column_stack([0 * s, 0 * s, s, np.full_like(s, radius)]))


def aligned(count=FRAMES):
    """Tubes that bend in one plane, pushed out further and further."""
    q = np.zeros((count, 6))
    q[:, 2], q[:, 3] = np.linspace(15, 60, count), np.linspace(30, 85, count)
    return q


def touched(stiffness, lumen=None, load=None, q=None):
    foundation = Foundation(NITINOL, lumen or straight(), stiffness, load or Load())
    return foundation.follow_motion(aligned() if q is None else q)


def rod(robot, beta, lumen_radius, stiffness):
    """The planar rod of aligned tubes in a straight lumen, by collocation: x and z (2, 101) at uniform sigma, and
    the sum of the wall's forces, N.

    Up to the end of the outer tube and from there on, side by side over [0, 1]: y = (x, z, angle, internal force
    along x and z, moment), x' = sin(angle), moment = EI (angle' - curvature).
    """
    stiff, bent = (
        np.array([getattr(tube, name) for tube in robot.tubes]) for name in ("bending_stiffness", "tip_curvature")
    )
    lengths = np.array([beta[0], beta[1] - beta[0]])
    parts = [(stiff.sum(), stiff @ bent / stiff.sum(), 2.0), (stiff[1], bent[1], 1.3)]

    def push(x, radius):
        over = radius - lumen_radius
        return -stiffness * np.sign(x) * (compressed(over + abs(x)) - compressed(over - abs(x)))

    def slopes(t, y):
        found = []
        for k, (stiffness_here, curvature, radius) in enumerate(parts):
            x, _, angle, force_x, force_z, moment = y[6 * k : 6 * k + 6]
            turning = force_z * np.sin(angle) - force_x * np.cos(angle)
            here = (
                np.sin(angle),
                np.cos(angle),
                curvature + moment / stiffness_here,
                -push(x, radius),
                0 * t,
                turning,
            )
            found += [lengths[k] * each for each in here]
        return np.vstack(found)

    def ends(a, b):
        return np.concatenate([a[:3], b[:6] - a[6:], b[9:]])

    start = np.zeros((12, 200))
    start[1] = np.linspace(0, beta[0], 200)
    start[7] = np.linspace(*beta, 200)
    solved = solve_bvp(slopes, ends, np.linspace(0, 1, 200), start, tol=1e-5, max_nodes=50_000)
    assert solved.success, solved.message
    t = np.linspace(0, 1, 2000)
    y = solved.sol(t)
    force = sum(lengths[k] * np.trapezoid(abs(push(y[6 * k], parts[k][2])), t) for k in range(2))
    s = np.concatenate([t * beta[0], beta[0] + t[1:] * lengths[1]])
    both = np.concatenate([y[:2], y[6:8, 1:]], axis=1)
    return np.array([np.interp(SIGMA_GRID * beta[1], s, row) for row in both]), float(force)


@pytest.mark.parametrize("stiffness", [0.01, 0.1])
def test_it_is_the_rod_on_a_foundation(stiffness):
    found = touched(stiffness)
    for j, beta in enumerate(aligned()[:, 2:4]):
        expected, force = rod(NITINOL, beta, RADIUS, stiffness)
        np.testing.assert_allclose(found.shape[j][:, [0, 2]].T, expected, atol=0.01)
        np.testing.assert_allclose(found.shape[j][:, 1], 0, atol=1e-6)
        assert found.force[j].sum() == pytest.approx(force, rel=0.01, abs=1e-4)
    assert found.force[-1].sum() > 0.05


def test_forces_are_what_depths_say_and_press_towards_the_path():
    found = touched(0.05)
    assert found.missed.max() <= CONTACT_FORCE_TOLERANCE_N
    busy = found.force > 1e-3
    assert busy.any()
    # Before its surface the wall presses with a tenth of what its toe is deep.
    soft = 0.1 * 0.05 * TOE_DEPTH_MM * found.length
    assert (found.force <= soft)[found.depth == 0].all()
    middles = np.stack(
        [
            np.interp(row / beta, SIGMA_GRID, shape[:, 0])
            for row, beta, shape in zip(found.along, aligned()[:, 3], found.shape, strict=True)
        ]
    )
    assert (np.sign(found.towards[..., 0])[busy] == -np.sign(middles)[busy]).all()
    np.testing.assert_allclose(found.length.sum(axis=1), aligned()[:, 3])


def test_the_stiffer_the_wall_the_less_deep_and_the_larger_the_force():
    soft, firm = touched(0.01), touched(3.0)
    assert firm.depth.max() < 0.15 * soft.depth.max()
    assert firm.force.sum(axis=1).max() > soft.force.sum(axis=1).max()


def test_in_a_wide_lumen_nothing_touches():
    q = aligned()
    q[:, 0] = 0.5
    found = touched(0.05, straight(60.0), q=q)
    assert not found.force.any()
    x = KINEMATIC_MODELS["elastic"].follow(NITINOL, q).x
    np.testing.assert_allclose(found.shape, KINEMATIC_MODELS["elastic"].points(NITINOL, x, SIGMA_GRID), atol=2e-3)


def test_a_lumen_that_is_too_narrow_presses_a_centred_robot_nowhere():
    """Its wall gives on all sides alike."""
    robot = with_modulus(
        Robot(tuple(Tube(t.length, t.curved_length, 1e-7, t.outer_diameter, t.inner_diameter) for t in TWO.tubes)),
        60_000,
    )
    found = Foundation(robot, straight(1.0), 0.05, Load()).follow_motion(aligned())
    assert found.force.sum(axis=1).max() < 1e-3
    assert found.narrow.all()
    np.testing.assert_allclose(found.depth.max(axis=1), [1.0] * FRAMES, atol=0.02)


def test_a_load_at_the_tip_presses_it_into_the_wall():
    """Beside the load the wall's forces hold the robot up."""
    without, pulled = touched(0.05), touched(0.05, load=Load(force=(0.2, 0.0, 0.0)))
    assert pulled.force[-1].sum() > without.force[-1].sum() + 0.05


def test_a_robot_that_snaps_under_the_wall_is_not_known_from_there_on():
    q = np.zeros((12, 6))
    q[:6, 2], q[:6, 3], q[6:, 2], q[6:, 3] = np.linspace(5, 60, 6), np.linspace(10, 80, 6), 60.0, 80.0
    q[6:, 0] = np.linspace(0, 6.0, 6)
    long = with_modulus(Robot((Tube(390, 70, 0.01, 4.0, 3.2), Tube(550, 90, 0.01, 2.6, 1.6))), 60_000)
    found = Foundation(long, straight(), 0.05, Load()).follow_motion(q)
    unknown = np.isnan(found.missed)
    assert not unknown[:6].any()
    assert unknown[-1]
    assert (np.diff(unknown.astype(int)) >= 0).all()
    assert np.isnan(found.force[unknown]).all()


def test_a_robot_that_leaves_the_wall_is_pushed_no_longer():
    """As it is drawn back at once to where it touches nothing."""
    q = aligned()[[-1, 0]]
    q[1, 2:4] = 4.0, 10.0
    found = touched(0.1, q=q)
    assert found.force[0].sum() > CONTACT_FORCE_TOLERANCE_N
    np.testing.assert_array_equal(found.force[1], 0.0)
    np.testing.assert_allclose(found.shape[1], touched(0.1, q=q[1:]).shape[0], atol=1e-6)
