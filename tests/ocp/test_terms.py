"""Terms and formulations against finite differences and brute-force quadrature."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

from ctr_nlp import Limits, Robot, Settings, Tube, curve_from_formula, shapes, table_i_robot
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp import FORMULATIONS
from ctr_nlp.ocp import curvature as terms
from ctr_nlp.ocp.terms import feasible, motion
from ctr_nlp.paths.target import SIGMA_GRID, Frame

TAPERED = Robot(
    (
        Tube(90, 50, (1 / 200, 1 / 100), 5.7, 4.3),
        Tube(202, 107, (1 / 90, 1 / 50), 3.7, 2.9),
        Tube(390, 150, (1 / 120, 1 / 60), 2.1, 1.0),
    )
)
PUSHED_OUT = Robot(TAPERED.tubes, Limits(beta=[(0, 80), (0, 150), (0, 300)]))
SEED_PUSHED_OUT = Robot(table_i_robot().tubes, Limits(beta=[(0, 80), (0, 150), (0, 300)], carriage_gap=5.0))
ROBOTS = {
    "seed": table_i_robot(),
    "tapered": TAPERED,
    "pushed out": PUSHED_OUT,
    "seed pushed out": SEED_PUSHED_OUT,
    "lone": Robot((Tube(120, 100, 0.01, 2, 1),)),
}
BETAS = {
    "seed": [(20, 60, 120), (50, 107, 150), (35, 35, 101), (0, 50, 50)],
    "tapered": [(20, 60, 120), (50, 107, 150), (35, 35, 101), (0, 50, 50)],
    "pushed out": [(20, 60, 120), (80, 150, 300), (70, 125, 280), (0, 0, 200), (77, 77, 230)],
    "seed pushed out": [(20, 60, 120), (80, 150, 300), (70, 125, 280), (0, 0, 200), (77, 77, 230)],
    "lone": [(20,), (80,), (100,)],
}
STAGES = [
    pytest.param(stage, robot, id=f"{name}-{kind}-{stage.nlp.name}")
    for name, formulation in FORMULATIONS.items()
    for kind, robot in ROBOTS.items()
    for stage in formulation(robot, Settings(), KINEMATIC_MODELS["dominant"])
]


def wavy(sigma):
    """A target curvature over sigma, 1/mm."""
    return 0.012 + 0.006 * np.sin(5 * sigma + 0.4)


def wavy_turning(sigma, length):
    """Its integral over arc length from 0, rad."""
    return length * (0.012 * sigma - 0.006 / 5 * (np.cos(5 * sigma + 0.4) - math.cos(0.4)))


@dataclass(frozen=True)
class Wavy:
    """The curvature of a curve, and nothing else of it."""

    length: float

    def curvature(self, s):
        """At arc lengths (n,), mm."""
        return wavy(s / self.length)


@functools.cache
def frame(length=140.0):
    """A planar target of the wavy curvature."""
    fine = np.linspace(0, 1, 100_001)
    angle = wavy_turning(fine, length)
    steps = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    points = np.vstack([np.zeros(3), np.cumsum((steps[1:] + steps[:-1]) / 2 * length * 1e-5, axis=0)])
    return Frame(points[::1000], steps[::1000], length, None, Wavy(length))


def inside(robot, rng):
    """A q (2d + 2,) strictly within limits and order."""
    d = robot.d
    fractions = np.sort(rng.uniform(0.05, 0.95, d))
    q = np.concatenate([rng.uniform(-3, 3, d), np.zeros(d), rng.uniform(-1, 1, 2)])
    q[d : 2 * d] = np.maximum.accumulate(fractions * robot.upper[d : 2 * d]) + 0.3 * np.arange(d)
    return q


def filled(stage, q, previous, **further):
    values = dict(stage.fill(frame(), q)) | dict(stage.schedule[-1])
    return stage.nlp.pack(values | {"previous": previous[stage.decides], "motion_root": 0.03} | further)


@pytest.mark.parametrize(("stage", "robot"), STAGES)
def test_derivatives_match_finite_differences(stage, robot):
    rng = np.random.default_rng(0)
    nlp, h = stage.nlp, 1e-5
    for term in (*nlp.residuals, *nlp.costs, *nlp.constraints):
        (in_x,) = nlp.expressions.in_x([term.value])
        value = ca.Function("value", [nlp.x, nlp.p], [in_x])
        jacobian = ca.Function("jacobian", [nlp.x, nlp.p], [ca.jacobian(in_x, nlp.x)])
        for _ in range(3):
            q, previous = inside(robot, rng), inside(robot, rng)
            x, p = q[stage.decides], filled(stage, q, previous)
            steps = h * np.eye(len(x))
            found = np.hstack([((value(x + e, p) - value(x - e, p)) / (2 * h)).full() for e in steps])
            exact = jacobian(x, p).full()
            np.testing.assert_allclose(
                exact, found, rtol=1e-5, atol=1e-5 * max(1, abs(exact).max()), err_msg=term.name
            )


@pytest.mark.parametrize(("stage", "robot"), STAGES)
def test_derivatives_are_finite_at_rest_and_where_tubes_are_hidden(stage, robot):
    nlp, d = stage.nlp, robot.d
    gradient = ca.Function(
        "gradient", [nlp.x, nlp.p], [ca.gradient(nlp.objective, nlp.x), ca.jacobian(nlp.g, nlp.x)]
    )
    for beta in (np.full(d, 20.0), np.r_[np.zeros(d - 1), 50.0], robot.upper[d : 2 * d]):
        q = np.concatenate([np.zeros(d), beta, [0, 0]])
        for value in gradient(q[stage.decides], filled(stage, q, q)):
            assert np.isfinite(value.full()).all()


def walked(robot, beta, s):
    """k(s) of eq. (10) by walking the segments, (n,)."""
    k, start = np.zeros_like(s), 0.0
    for tube, end in zip(robot.tubes, beta, strict=True):
        x = end - s
        own = tube.tip_curvature + (tube.root_curvature - tube.tip_curvature) * x / tube.curved_length
        here = (s >= start) & (s < end)
        k[here] = np.where(x <= tube.curved_length, own, 0.0)[here]
        start = end
    return k


def brute_force(robot, beta, kappa):
    """The mean of (k - kappa)^2 over sigma, eq. (11), on 400,000 midpoints; 1/mm^2."""
    sigma = (np.arange(400_000) + 0.5) / 400_000
    return np.mean((walked(robot, beta, sigma * beta[-1]) - kappa(sigma)) ** 2)


def exact_cost(robot, kappa, turning, length):
    beta = ca.SX.sym("beta", robot.d)
    cost = terms.curvature_exact(
        robot.tube_numbers, ca.vertsplit(beta), robot.reach, ca.SX(kappa), ca.SX(turning), ca.SX(length)
    )
    return ca.Function("exact", [beta], [cost.value / terms.curvature_to_shape_scale(robot.reach) ** 2])


def smooth_cost(robot, turning, length, width):
    beta = ca.SX.sym("beta", robot.d)
    cost = terms.curvature(
        robot.tube_numbers, ca.vertsplit(beta), robot.reach, ca.SX(turning), ca.SX(length), ca.SX(width)
    )
    return ca.Function("smooth", [beta], [cost.value / terms.curvature_to_shape_scale(robot.reach) ** 2])


@pytest.mark.parametrize("kind", ROBOTS)
def test_exact_curvature_term_is_the_integral_by_brute_force(kind):
    """Differences between extensions, since the mean of kappa^2 is left out."""
    robot, length = ROBOTS[kind], 140.0
    cost = exact_cost(robot, wavy(SIGMA_GRID), wavy_turning(SIGMA_GRID, length), length)
    found = [float(cost(beta)) for beta in BETAS[kind]]
    truth = [brute_force(robot, beta, wavy) for beta in BETAS[kind]]
    np.testing.assert_allclose(np.diff(found), np.diff(truth), atol=2e-9)


@pytest.mark.parametrize("kind", ROBOTS)
def test_exact_curvature_term_leaves_out_the_mean_of_the_targets_square(kind):
    robot, length = ROBOTS[kind], 140.0
    cost = exact_cost(robot, wavy(SIGMA_GRID), wavy_turning(SIGMA_GRID, length), length)
    beta, sigma = BETAS[kind][0], (np.arange(100_000) + 0.5) / 100_000
    assert float(cost(beta)) + np.mean(wavy(sigma) ** 2) == pytest.approx(brute_force(robot, beta, wavy), abs=2e-9)


@pytest.mark.parametrize("kind", ["seed", "tapered", "pushed out", "seed pushed out"])
def test_smoothed_curvature_term_tends_to_the_exact_one(kind):
    """At extensions whose joints lie between two of its 100 cells, the midpoints see every jump in full."""
    robot, length = ROBOTS[kind], 100.0
    pairs = {"pushed out": [(60, 120, 200), (70, 140, 200)], "seed pushed out": [(60, 120, 200), (70, 140, 200)]}
    betas = pairs.get(kind, [(30, 60, 100), (40, 70, 100)])
    turning = wavy_turning(SIGMA_GRID, length)
    exact = np.ptp([float(exact_cost(robot, wavy(SIGMA_GRID), turning, length)(beta)) for beta in betas])
    gaps = []
    for width in (10.0, 1.0, 0.05):
        cost = smooth_cost(robot, turning, length, width)
        gaps.append(abs(np.ptp([float(cost(beta)) for beta in betas]) - exact) / exact)
    assert gaps[0] > gaps[1]
    assert gaps[2] < 2e-3


@pytest.mark.parametrize("form", ["exact", "smooth"])
def test_curvature_term_does_not_shrink_with_the_robot(form):
    """A tube of one curvature before a straight target is equally wrong at every length."""
    robot = ROBOTS["lone"]
    none = np.zeros(101)
    cost = exact_cost(robot, none, none, 100.0) if form == "exact" else smooth_cost(robot, none, 100.0, 1.0)
    np.testing.assert_allclose([float(cost(beta)) for beta in (5.0, 50.0, 100.0)], 0.01**2, rtol=1e-9)


def test_lever_turns_a_kept_curvature_error_into_its_shape_error(robot):
    """A small curvature error kept along the reach, as a root mean square distance over sigma."""
    k, sigma = 1e-6, np.linspace(0, 1, 10_001)
    aside = k * (sigma * 150) ** 2 / 2
    assert terms.curvature_to_shape_scale(robot.reach) * k == pytest.approx(
        np.sqrt(np.trapezoid(aside**2, sigma)), rel=1e-6
    )


def test_smooth_step_is_odd_about_a_half_and_rises_within_its_width():
    x = np.linspace(-3, 3, 61)
    value = np.array([float(terms.smooth_step(ca.DM(v))) for v in x])
    np.testing.assert_allclose(value + value[::-1], 1, atol=1e-15)
    assert (np.diff(value) > 0).all()
    assert float(terms.smooth_step(ca.DM(1)) - terms.smooth_step(ca.DM(-1))) == pytest.approx(0.96, abs=0.005)


def test_motion_is_lambda_times_the_squared_weighted_step_over_dt_squared(robot):
    x, weight, dt = ca.SX.sym("x", 8), 1e-5, 0.1
    term = motion.motion_residual(x, ca.SX(8, 1), robot.mm_per_unit, ca.SX(math.sqrt(weight) / dt))
    q = np.array([0.1, 0, 0, 2, 0, 0, 0, 0.3])
    value = float(ca.Function("f", [x], [ca.sumsqr(term.value)])(q))
    assert value == pytest.approx(weight / dt**2 * (1 + 4 + 9))


def rotation_value(robot, q, target):
    """The rotation stage's shape term (without motion), mm^2, for a Frame."""
    stage = FORMULATIONS["two-stage"](robot, Settings(), KINEMATIC_MODELS["dominant"])[1]
    p = stage.nlp.pack(dict(stage.fill(target, q)) | {"previous": q[stage.decides], "motion_root": 0.0})
    return float(ca.Function("f", [stage.nlp.x, stage.nlp.p], [stage.nlp.objective])(q[stage.decides], p))


def joint_value(robot, q, target):
    (stage,) = FORMULATIONS["joint"](robot, Settings(), KINEMATIC_MODELS["dominant"])
    p = stage.nlp.pack(dict(stage.fill(target, q)) | {"previous": q, "motion_root": 0.0})
    return float(ca.Function("f", [stage.nlp.x, stage.nlp.p], [stage.nlp.objective])(q, p))


def mean_square(robot, q, target):
    """Mean over sigma of |C - target|^2 on 20,001 samples, mm^2."""
    sigma = np.linspace(0, 1, 20_001)
    distance = shapes(robot, q[None], sigma)[0] - target.at(sigma)
    return np.trapezoid((distance**2).sum(axis=1), sigma)


@pytest.mark.parametrize("beta", [(20, 60, 120), (35, 35, 100), (0, 0, 140), (0, 100, 100)])
def test_simpson_is_exact_where_the_distance_grows_linearly(beta):
    straight = Robot(tuple(Tube(150, 150, 0.0, 6 - i, 5.5 - i) for i in range(3)))
    length = 140.0
    direction = np.array([0.6, 0, 0.8])
    curve = curve_from_formula(lambda u: (0.6 * u, 0, 0.8 * u), 0, length)
    target = Frame(np.outer(SIGMA_GRID * length, direction), np.tile(direction, (101, 1)), length, None, curve)
    q = np.array([0, 0, 0, *beta, 0, 0], dtype=float)
    tip = np.linalg.norm(beta[-1] * np.array([0, 0, 1]) - length * direction)
    assert rotation_value(straight, q, target) == pytest.approx(tip**2 / 3, rel=1e-10)


@pytest.mark.parametrize("beta", [(20, 60, 120), (50, 107, 150), (35, 35, 100), (10, 60, 60)])
def test_simpson_samples_stand_for_the_whole_shape(robot, beta):
    q = np.array([0.4, -0.6, 1.1, *beta, 0.2, -0.3], dtype=float)
    assert rotation_value(robot, q, frame()) == pytest.approx(mean_square(robot, q, frame()), rel=0.02)


def test_joint_samples_stand_for_the_whole_shape(robot):
    q = np.array([0.4, -0.6, 1.1, 30, 80, 135, 0.2, -0.3])
    assert joint_value(robot, q, frame()) == pytest.approx(mean_square(robot, q, frame()), rel=0.01)


def test_order_bounds_growth_by_the_room_between_carriages():
    """Carriage i stands at beta_i - L_i; the seed's lengths differ by 112 and 188 mm."""
    beta = ca.SX.sym("beta", 3)
    constraints = feasible.order(SEED_PUSHED_OUT.tube_numbers, ca.vertsplit(beta), ca.SX(5))
    values = [ca.Function("f", [beta], [each.value])([10, 30, 70]).full().ravel() for each in constraints]
    np.testing.assert_allclose(values, [[20, 40], [112 - 5 - 20, 188 - 5 - 40]])
    for each in constraints:
        assert (each.lower.tolist(), each.upper.tolist()) == ([0, 0], [np.inf, np.inf])


def test_a_carriage_gap_given_as_text_is_the_same_constraint():
    """Robot files may write any limit as text, as infinite ones are; tube 2 is 112 mm longer than tube 1."""
    robot = Robot(table_i_robot().tubes, Limits(carriage_gap="5"))
    (stage,) = FORMULATIONS["joint"](robot, Settings(), KINEMATIC_MODELS["dominant"])
    assert stage.fill(frame(), np.zeros(8))["gap"] == 5
