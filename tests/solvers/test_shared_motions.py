"""Motions that scenarios share: what is minimised and kept is what is claimed, and derivatives are those of it."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from frames import configuration, elastic_shapes, follow
from truth import TWO, Shot

from ctr_nlp import Problem, growing
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.ocp.shared.scenarios import shared_motion
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.solvers.scenarios import SharedSolver, interior_point
from ctr_nlp.solvers.scenarios.bordered import solve_bordered_system as solved_by
from ctr_nlp.solvers.scenarios.condensed import Condensed
from ctr_nlp.solvers.scenarios.twists import TwistSteps

pytestmark = pytest.mark.interpreted

FRAMES, WEIGHT, MARGIN = 4, 1e-4, 0.3
OFFSETS = np.array([[0.0, 0.0], [0.1, -0.05], [-0.15, 0.1]])
SHARES = np.array([0.5, 1.0, 2.0])


def _robots():
    """The robot, one of stronger curvatures, and one of other stiffnesses."""
    outer, inner = TWO.tubes
    strong = replace(outer, curvature=(0.011, 0.027)), replace(inner, curvature=0.022)
    stiff = replace(outer, youngs_modulus=1.2), replace(inner, youngs_modulus=0.8)
    return [TWO, replace(TWO, tubes=strong), replace(TWO, tubes=stiff)]


def _scenarios():
    return Scenarios(np.array([robot.numbers for robot in _robots()]), OFFSETS, SHARES)


@pytest.fixture(scope="module")
def problem():
    """A bend in space that two tubes cannot follow exactly."""
    curve = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    return Problem("bend", TWO, growing(curve, FRAMES), duration=4.0)


@pytest.fixture(scope="module")
def motion(problem):
    at = problem.target_frames, problem.dt, WEIGHT, EndConfigurations(), KINEMATIC_MODELS["elastic"], _scenarios()
    return shared_motion(TWO, *at, fastest_functions, np.full(FRAMES, MARGIN))


@pytest.fixture(scope="module")
def q(problem):
    """A motion whose tubes are turned against each other."""
    beta = np.array(problem.target.lengths)
    alpha = np.linspace([1.0, 0.2], [2.2, -0.3], FRAMES)
    return np.column_stack([alpha, 0.55 * beta, beta, np.full(FRAMES, 0.1), np.full(FRAMES, -0.05)])


def _settled(q):
    """Tips of all scenarios in equilibrium, (T, S, 2)."""
    moved = [follow(robot, q + np.pad(offset, (0, 4))).x for robot, offset in zip(_robots(), OFFSETS, strict=True)]
    return np.stack([x[:, :2] for x in moved], axis=1)


@pytest.fixture(scope="module")
def solved(motion, q):
    found = SharedSolver(motion)(q, np.repeat(_settled(q)[:, :1], 3, axis=1))
    assert found.success, found
    return found


def test_values_are_those_of_robots_followed_one_by_one(problem, motion, q):
    values = Condensed(motion).value(q, _settled(q))
    np.testing.assert_allclose(values.equation_residuals, 0, atol=5e-4)  # programs integrate in half as many steps
    errors = [_squares(problem, robot, q, offset) for robot, offset in zip(_robots(), OFFSETS, strict=True)]
    moved = WEIGHT * ((np.diff(q, axis=0) * TWO.mm_per_unit) ** 2).sum() / problem.dt**2
    expected = SHARES @ np.sum(errors, axis=1) / SHARES.sum() + moved
    assert values.objective == pytest.approx(expected, rel=1e-3)


def _squares(problem, robot, q, offset):
    """Mean square errors (T,) over every fifth sample of a robot that is moved with its motors' offsets."""
    x = follow(robot, q + np.pad(offset, (0, 4))).x
    target = np.array([frame.points for frame in problem.target_frames])
    squares = ((elastic_shapes(robot, x, SIGMA_GRID) - target) ** 2).sum(axis=-1)[:, ::5]
    return np.trapezoid(squares, dx=0.05, axis=1)


def repaired(condensed, motion, q, phi):
    """Tips at which all equations hold, by Newton's method."""
    none = np.zeros(phi.shape), np.zeros(motion.row_bounds[0].shape)
    for _ in range(8):
        phi = phi + condensed.expand(q, phi, *none).repair[..., motion.own]
    return phi


def test_derivatives_with_tips_eliminated_are_those_of_robots_in_equilibrium(motion, q):
    condensed = Condensed(motion)
    check_derivatives(condensed, motion, q, repaired(condensed, motion, q, _settled(q)))


def check_derivatives(condensed, motion, q, phi):
    """Of the objective, of rows and of the Lagrangian, at q where tips phi solve all equations."""
    rng, tubes = np.random.default_rng(1), motion.d
    rows, way = rng.normal(size=motion.row_bounds[0].shape), rng.normal(size=q.shape) * 1e-4

    def lagrangian(part):
        """The gradient over q of objectives and rows, where the equations hold, and these rows."""
        here = q + part * way
        tips = repaired(condensed, motion, here, phi)
        about = condensed.expand(here, tips, np.zeros(phi.shape), rows)
        about = condensed.expand(here, tips, about.multipliers(rows, np.zeros((len(q), tubes - 1))), rows)
        pulled = (about.jacobian.swapaxes(1, 2) @ rows[..., None])[..., 0]
        values = about.at.rows[q.size : q.size + rows.size].reshape(rows.shape)
        value = condensed.by_frame(here, tips).sum() - _links(motion, here)
        return about, about.over_q(about.gradient) + pulled, values, value

    about, _, _, _ = lagrangian(0)
    (_, after, rows_after, f_after), (_, before, rows_before, f_before) = lagrangian(1), lagrangian(-1)
    hessian, bent = about.quadratic(0.0)
    np.testing.assert_allclose(bent, 0, atol=1e-6)
    slope = (about.over_q(about.gradient) * way).sum()
    assert (f_after - f_before) / 2 == pytest.approx(slope, rel=1e-4)
    changed = (about.jacobian @ way[..., None])[..., 0]
    np.testing.assert_allclose((rows_after - rows_before) / 2, changed, atol=1e-7)
    turned = (hessian @ way[..., None])[..., 0]
    np.testing.assert_allclose((after - before) / 2, turned, atol=1e-3 * abs(turned).max())


def _links(motion, q):
    values = motion.linking @ q.ravel() + motion.of_links("offset")
    return motion.of_links("weight") @ values**2


def test_all_robots_of_a_solution_are_in_equilibrium_and_keep_their_margins(solved):
    for k, (robot, offset) in enumerate(zip(_robots(), OFFSETS, strict=True)):
        x = np.concatenate([solved.phi[:, k], solved.q[:, 2:]], axis=1)
        alpha = configuration(robot, x)[:, :2]
        np.testing.assert_allclose(alpha, solved.q[:, :2] + offset, atol=5e-4)
        assert KINEMATIC_MODELS["elastic"].margins(robot, x).min() > MARGIN - 0.002
    tips = solved.phi[:, 1:, 0] - solved.phi[:, :1, 0]
    assert abs(tips).max() <= 0.7


def test_robots_that_are_shot_at_the_solution_have_its_tips_and_shapes(solved):
    for k, (robot, offset) in enumerate(zip(_robots(), OFFSETS, strict=True)):
        shot = Shot(robot, solved.q[-1] + np.pad(offset, (0, 4)))
        x = np.concatenate([solved.phi[-1, k], solved.q[-1, 2:]])
        np.testing.assert_allclose(shot.x, x, atol=2e-3)
        assert shot.margin() > MARGIN - 0.005
        np.testing.assert_allclose(
            elastic_shapes(robot, x[None], SIGMA_GRID)[0], shot.points(SIGMA_GRID), atol=0.05
        )


def test_a_solution_keeps_limits_and_cannot_be_bettered_nearby(problem, motion, q, solved):
    robot = problem.robot
    assert (solved.q >= robot.lower).all()
    assert (solved.q <= robot.upper).all()
    assert (abs(np.diff(solved.q, axis=0)) <= robot.speed * problem.dt + 1e-6).all()
    assert solved.objective < Condensed(motion).value(q, _settled(q)).objective
    again = SharedSolver(motion)(solved.q, np.repeat(solved.phi[:, :1], 3, axis=1), 1e-2)
    assert again.success
    assert again.objective == pytest.approx(solved.objective, rel=1e-4)


def test_given_ends_are_kept(problem, q):
    ends = EndConfigurations(start=q[0], end=q[-1])
    at = problem.target_frames, problem.dt, WEIGHT, ends, KINEMATIC_MODELS["elastic"], _scenarios()
    motion = shared_motion(TWO, *at, fastest_functions, np.full(FRAMES, MARGIN))
    found = SharedSolver(motion)(q, _settled(q))
    assert found.success
    np.testing.assert_array_equal(found.q[-1], q[-1])
    assert (abs(found.q[0] - q[0]) <= TWO.speed * problem.dt + 1e-6).all()


def test_a_point_that_is_no_solution_is_not_called_one(motion, q):
    found = SharedSolver(motion)(q, np.repeat(_settled(q)[:, :1], 3, axis=1), max_iterations=2)
    assert not found.success
    assert found.status == "Maximum_Iterations_Exceeded"


def test_of_points_that_steps_go_to_and_fro_between_the_best_is_returned(motion, q, monkeypatch):
    """Where second derivatives jump, objectives agree and residuals do not: a step more would lose a solution."""
    advance = interior_point._InteriorPointSolve.advance

    def disturbed(run):
        """Make a step; at the last barrier, end it with multipliers far from stationary."""
        why = advance(run)
        if run._barrier == run._last and len(run._objectives) > interior_point.STALL_ITERATIONS - 1:
            run.point = replace(run.point, at_upper=run.point.at_upper + 1.0)
        return why

    # No residual is small enough, so that the solve ends once the objective no longer falls.
    monkeypatch.setattr(interior_point, "SHARED_RESIDUAL_PER_BARRIER", 0.0)
    monkeypatch.setattr(interior_point, "SHARED_MIN_RESIDUAL_TOLERANCE", 0.0)
    monkeypatch.setattr(interior_point._InteriorPointSolve, "advance", disturbed)
    found = SharedSolver(motion)(q, np.repeat(_settled(q)[:, :1], 3, axis=1))
    assert found.status == "Solved_To_Acceptable_Level"
    assert found.success, found
    assert found.kkt < 1e-4


def test_tips_of_scenarios_on_a_model_without_twist_turn_with_their_motors(problem, q):
    scenarios = _scenarios()
    at = problem.target_frames, problem.dt, WEIGHT, EndConfigurations(), KINEMATIC_MODELS["dominant"], scenarios
    motion = shared_motion(TWO, *at, fastest_functions, np.full(FRAMES, MARGIN))
    found = SharedSolver(motion)(q, np.repeat(q[:, None, :2], 3, axis=1))
    assert found.success
    np.testing.assert_allclose(found.phi, found.q[:, None, :2] + scenarios.offsets, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": np.zeros(3)}, "all are 0"),
        ({"weights": np.array([1.0, -1.0, 1.0])}, ">= 0"),
        ({"offsets": np.zeros((2, 2))}, "offsets of scenarios have shape"),
        ({"numbers": np.full((3, 2, 8), np.nan)}, "numbers of scenarios"),
    ],
)
def test_scenarios_that_cannot_be_are_refused(change, message):
    with pytest.raises(OptionError, match=message):
        replace(_scenarios(), **change)


STEP = 0.01
"""A limit of twists' changes, rad, that the motion without it does not keep."""


@pytest.fixture(scope="module")
def limited(motion):
    """The same with a limit on the way to every frame but the second."""
    return replace(motion, twist_steps=np.array([np.inf, np.inf, STEP, STEP]))


def _twists(q, tips):
    """Of the first robot, (T,): what its outer tip is turned against the inner one, less its motor's angle."""
    return tips[:, 0] - q[:, 0]


def test_twists_change_by_no_more_than_is_asked_for(limited, q, solved):
    assert abs(np.diff(_twists(solved.q, solved.phi[:, 0])))[1:].max() > 2 * STEP
    found = SharedSolver(limited)(q, np.repeat(_settled(q)[:, :1], 3, axis=1))
    assert found.success, found
    changes = abs(np.diff(_twists(found.q, follow(TWO, found.q).x)))
    assert changes[1:].max() == pytest.approx(STEP, rel=0.05)  # programs integrate in half as many steps
    assert found.objective > solved.objective


def test_derivatives_of_twists_are_those_of_robots_in_equilibrium(limited, q):
    condensed, way = Condensed(limited), np.random.default_rng(2).normal(size=q.shape) * 1e-4
    phi, none = repaired(condensed, limited, q, _settled(q)), np.zeros(limited.row_bounds[0].shape)
    twists, about = condensed.twists, condensed.expand(q, phi, np.zeros(phi.shape), none)
    after, before = (twists.values(at, repaired(condensed, limited, at, phi)) for at in (q + way, q - way))
    np.testing.assert_allclose((after - before) / 2, twists.multiply_jacobian(about.twists, way), atol=1e-7)


def test_squares_of_twists_are_those_of_the_whole_jacobian(limited):
    """Over q of all frames, and two unknowns in common."""
    rng, (frames, _, n, d) = np.random.default_rng(3), limited.sizes
    twists, slopes = TwistSteps(limited), rng.normal(size=(frames, d - 1, n + 2))
    rows, sigma = rng.normal(size=2), rng.uniform(1.0, 2.0, 2)
    jacobian = np.array([_gathered(twists.multiply_transposed_jacobian(slopes, row), n) for row in np.eye(2)])
    step = rng.normal(size=frames * n + 2)
    seen = np.concatenate(
        [step[: frames * n].reshape(frames, n), np.tile(step[frames * n :], (frames, 1))], axis=1
    )
    np.testing.assert_allclose(twists.multiply_jacobian(slopes, seen), jacobian @ step)
    np.testing.assert_allclose(_gathered(twists.multiply_transposed_jacobian(slopes, rows), n), rows @ jacobian)
    blocks, band = np.zeros((frames, n + 2, n + 2)), np.zeros((2 * n, frames * n))
    twists.square(slopes, sigma, blocks, band)
    found = solved_by(band, blocks, np.eye(2), np.ones(step.size), step, np.ones(step.size, dtype=bool))
    whole = jacobian.T @ (sigma[:, None] * jacobian) + np.diag(np.r_[np.ones(frames * n), 2.0, 2.0])
    np.testing.assert_allclose(found, np.linalg.solve(whole, step), rtol=1e-9)


def _gathered(of_frames, n):
    """Slopes (T, n + P) of what frames add to a sum, as one."""
    return np.append(of_frames[:, :n].ravel(), of_frames[:, n:].sum(axis=0))
