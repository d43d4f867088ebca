"""The judge itself, beside reference shapes and closed forms."""

import json

import numpy as np
import pytest
from scipy.optimize import brentq

from ctr_nlp.check.checker import NO, NOT_COVERED, YES, _judge_limits, examine_motion
from ctr_nlp.check.motions import CONVERGED_RATE, Follower, find_ways, move_nominal
from ctr_nlp.check.plan_file import PlanFile
from ctr_nlp.check.shapes import RobotShape, compute_body
from ctr_nlp.check.stability import compute_stability_margins
from ctr_nlp.check.tubes import integrate, read_tubes
from ctr_nlp.check.walls import LumenWall, measure_clearance

TIP_RAD = 150 * CONVERGED_RATE
"""To which angles at the tips are known: the last correction of rates at the base, over a tube's length."""
TUBE = {
    "length": 150.0,
    "curved_length": 50.0,
    "curvature": 0.01,
    "outer_diameter": 3.0,
    "inner_diameter": 2.0,
    "poisson_ratio": 0.3,
    "youngs_modulus": 1.0,
    "pre_torsion": 0.0,
}


def pair_of_tubes(curvature):
    """A robot of two tubes of one length and curvature: their relative angle obeys a pendulum's equation."""
    return {"tubes": [TUBE | {"curvature": curvature}, TUBE | {"curvature": curvature, "inner_diameter": 1.0}]}


def pendulum_constant(tubes):
    """c of theta'' = c sin theta, theta the angle between two tubes, 1/mm^2."""
    pull = tubes.bending * tubes.root
    return float((1 / tubes.torsional).sum() * pull.prod() / tubes.bending.sum())


def turning(frames, last, beta):
    """Configurations (frames, 6) of two tubes, of which the outer one turns from 0 to last rad."""
    q = np.zeros((frames, 6))
    q[:, 0] = np.linspace(0, last, frames)
    q[:, 2:4] = beta
    return q


def test_shapes_and_margins_agree_with_reference(shared_data):
    data = json.loads((shared_data / "elastic_reference.json").read_text())
    assert len(data["configurations"]) == 28
    for number, case in enumerate(data["configurations"]):
        numbers = data["robots"][case["robot"]]
        names = ("length", "curved", "curvature", "od", "id")
        keys = ("length", "curved_length", "curvature", "outer_diameter", "inner_diameter")
        robot = [
            TUBE | dict(zip(keys, row, strict=True)) for row in zip(*(numbers[n] for n in names), strict=True)
        ]
        alpha, beta, theta, rates = (
            np.array(case[key])[:, None] for key in ("alpha_rad", "beta_mm", "theta_rad", "uz0_per_mm")
        )
        twist = integrate(read_tubes({"tubes": robot}), alpha, beta, rates)
        body = compute_body(twist, theta)
        points = np.array(case["points_mm"])
        away = np.linalg.norm(body.interpolate(np.linspace(0, 1, len(points))) - points, axis=-1)
        assert away.max() < 1e-3
        assert compute_stability_margins(twist)[0] == pytest.approx(case["stability_margin"], abs=2e-4)
        assert np.linalg.det(twist.sensitivity[0]) == pytest.approx(case["stability_det"], rel=5e-3)
        if "opposed" not in case.get("kind", "") and number % 3 == 0:
            _, moved, _ = move_nominal(twist.tubes, np.concatenate([alpha, beta, theta])[:, 0][None], substeps=2)
            np.testing.assert_allclose(moved[0, -1], rates[:, 0], atol=1e-7)


def test_tip_angle_is_the_angle_at_a_tubes_own_tip():
    tubes = read_tubes(pair_of_tubes(0.01))
    twist = integrate(tubes, np.array([[1.0], [0.0]]), np.array([[20.0], [45.0]]), np.array([[0.01], [-0.005]]))
    at_tip = int(np.flatnonzero(twist.s[:, 0] == 20.0)[0])
    np.testing.assert_allclose(twist.tip_angles[:, 0], [twist.psi[at_tip, 0, 0], twist.psi[-1, 1, 0]], atol=1e-12)


def test_differences_of_samples_change_their_tubes():
    nominal = read_tubes(pair_of_tubes(0.01))
    parts = np.zeros((1, 2, 5))
    parts[0, 1] = 0.1, 0.2, 0.3, 4.0, 0.5
    tubes = read_tubes(pair_of_tubes(0.01), parts)
    changes = {"root": 1.1, "tip": 1.1, "bending": 1.2, "torsional": 1.2 / 1.3, "curved": 54 / 50, "length": 1.0}
    for name, factor in changes.items():
        assert getattr(tubes, name)[1, 0] == pytest.approx(factor * getattr(nominal, name)[1, 0])
        assert getattr(tubes, name)[0, 0] == getattr(nominal, name)[0, 0]
    assert tubes.zero[:, 0].tolist() == [0.0, 0.5]


@pytest.mark.parametrize("spacing", [0.5, 2.0])
def test_places_along_a_robot_are_no_further_apart_than_asked(spacing):
    tubes = read_tubes(pair_of_tubes(0.01))
    body = compute_body(
        integrate(tubes, np.zeros((2, 1)), np.full((2, 1), 50.0), np.zeros((2, 1))), np.zeros((2, 1))
    )
    points, radius = body.find_places(spacing)
    away = np.linalg.norm(np.diff(points[0], axis=0), axis=1)
    assert spacing / 2 < away.max() <= spacing  # the steps are divided evenly
    assert radius.shape == points.shape[:2]


def test_aligned_tubes_are_a_circle():
    tubes = read_tubes({"tubes": [TUBE, TUBE | {"curvature": 0.02, "outer_diameter": 1.8, "inner_diameter": 1.0}]})
    angle, beta = 0.7, np.full((2, 1), 50.0)
    twist = integrate(tubes, np.full((2, 1), angle), beta, np.zeros((2, 1)))
    np.testing.assert_allclose(twist.rate[-1], 0, atol=1e-15)
    s = np.linspace(0, 50, 11)
    points = compute_body(twist, np.zeros((2, 1))).interpolate(s / 50)[0]
    k = float((tubes.bending * tubes.root).sum() / tubes.bending.sum())
    away = (1 - np.cos(k * s)) / k
    wanted = np.stack([away * np.cos(angle), away * np.sin(angle), np.sin(k * s) / k], axis=-1)
    np.testing.assert_allclose(points, wanted, atol=1e-4)


def test_lone_helix_is_a_helix():
    k, torsion = 0.015, 0.02
    robot = {"tubes": [TUBE | {"curvature": k, "pre_torsion": torsion}]}
    beta = np.full((1, 1), 50.0)
    body = compute_body(integrate(read_tubes(robot), np.zeros((1, 1)), beta, np.zeros((1, 1))), np.zeros((2, 1)))
    w = np.hypot(k, torsion)
    # The chord of a helix of curvature k and torsion tau after arc length s, from Frenet's formulas.
    turn = w * 50.0
    chord = np.sqrt((2 * k / w**2 * np.sin(turn / 2)) ** 2 + (torsion / w * 50.0) ** 2)
    assert np.linalg.norm(body.points[-1, 0]) == pytest.approx(chord, abs=1e-4)


@pytest.mark.parametrize("curvature", [0.005, 0.01, 0.02, 0.03])
def test_margin_of_opposed_pair_has_closed_form(curvature):
    """Untwisted opposed tubes: with c / (1 - mu) for c, sqrt(c) R tan(sqrt(c) L) = 1, R the transmissions."""
    tubes = read_tubes(pair_of_tubes(curvature))
    reach, curved = 100.0, 50.0
    twist = integrate(tubes, np.array([[np.pi], [0.0]]), np.full((2, 1), 50.0), np.zeros((2, 1)))
    root = brentq(lambda x: x * reach * np.tan(x * curved) - 1, 1e-6, np.pi / 2 / curved - 1e-9)
    wanted = 1 - pendulum_constant(tubes) / root**2
    assert compute_stability_margins(twist)[0] == pytest.approx(wanted, abs=1e-5)


@pytest.mark.hazard("snap")
def test_turning_a_tube_snaps_where_opposed_pair_is_unstable():
    snaps = {}
    for curvature in (0.005, 0.015):
        tubes = read_tubes(pair_of_tubes(curvature))
        opposed = integrate(tubes, np.array([[np.pi], [0.0]]), np.full((2, 1), 50.0), np.zeros((2, 1)))
        q = turning(40, 2 * np.pi, 50.0)
        _, rates, frames = move_nominal(tubes, q, substeps=4)
        stable = bool(compute_stability_margins(opposed)[0] > 0)
        snaps[stable] = len(frames)
        # A robot has shapes up to the snap, and none from there on.
        known = np.isfinite(rates).all(axis=(1, 2))
        assert known.tolist() == [stable or k < frames[0] - 1 for k in range(40)]
        if stable:
            # After a whole turn the tubes are aligned again.
            last = integrate(tubes, q[-1:, :2].T, q[-1:, 2:4].T, rates[-1, -1][:, None])
            assert last.tip_angles[:, 0] @ [1, -1] == pytest.approx(2 * np.pi, abs=TIP_RAD)
    assert snaps == {True: 0, False: 1}


def move(follower, q):
    """Angles of the tips (T, d, n) of robots that are moved through q."""
    return np.array([follower.angles.copy() for _ in follower.move(find_ways(q, len(follower.snapped)))])


def nominal_tips(tubes, q):
    """Angles of the tips (T, d) of one robot that is moved through q."""
    _, rates, _ = move_nominal(tubes, q)
    found = integrate(tubes.repeat(len(q)), q[:, :2].T, q[:, 2:4].T, rates[:, -1].T, sensitivities=False)
    return found.tip_angles.T


def test_samples_move_as_the_nominal_robot():
    robot = pair_of_tubes(0.01)
    q = turning(12, 2.0, 40.0)
    follower = Follower(read_tubes(robot, np.zeros((3, 2, 5))))
    found = move(follower, q)
    assert not follower.snapped.any()
    wanted = nominal_tips(read_tubes(robot), q)
    np.testing.assert_allclose(found, wanted[..., None] + np.zeros(3), atol=TIP_RAD)


def test_long_steps_are_cut_until_newton_leads_on():
    """Tubes that turn by more than a radian from frame to frame reach the same place, and do not snap."""
    tubes = read_tubes(pair_of_tubes(0.005))
    few, many = (move(Follower(tubes), turning(frames, 2.5, 40.0)) for frames in (3, 61))
    assert np.isfinite(few).all()
    np.testing.assert_allclose(few[-1], many[-1], atol=TIP_RAD)


def test_samples_of_a_robot_that_snaps_are_not_compared_with_it():
    q = turning(40, 2 * np.pi, 50.0)
    arrays = {"alpha": q[:, :2], "beta": q[:, 2:4], "theta": q[:, 4:], "time": np.arange(1.0, 41.0)}
    arrays |= {"success": np.ones(40, dtype=bool), "kkt": np.zeros(40), "target": np.zeros((40, 101, 3))}
    arrays |= {"target_direction": np.tile([0.0, 0, 1], (40, 1))}
    arrays |= {"draws_parts": np.zeros((2, 2, 5)), "draws_lags": np.zeros((2, 2))}
    tolerances = {"tip_force": 0.0, "distribution": "uniform", "covariance": None}
    robot = pair_of_tubes(0.015) | {"limits": {}, "tolerances": tolerances}
    found = examine_motion(PlanFile(arrays, {"robot": robot, "model": "elastic", "problem": {}}, None, ""), 2)
    assert found.findings["holds"].word == NOT_COVERED
    assert "which snaps" in found.findings["holds"].why
    assert found.samples == {}


def test_play_is_an_offset_while_motors_turn_one_way():
    robot, lag = pair_of_tubes(0.01), 0.1
    parts = np.zeros((2, 2, 5))
    parts[1, 0, 4] = -lag
    lags = np.array([[lag, 0.0], [0.0, 0.0]])
    follower = Follower(read_tubes(robot, parts), 0.0, lags)
    found = move(follower, turning(12, 2.0, 40.0))
    np.testing.assert_allclose(found[-1][:, 0], found[-1][:, 1], atol=TIP_RAD)
    assert abs(found[0][0, 0] - found[0][0, 1]) > lag / 2  # at first the play is not taken up


def test_robots_begin_aligned_with_the_innermost_tube():
    tubes = read_tubes(pair_of_tubes(0.01))
    q = turning(2, 1.0, 40.0) + np.array([0.0, 0.4, 0, 0, 0, 0])
    follower = Follower(tubes, 0.4)
    last = move(follower, q)[-1]
    np.testing.assert_allclose(last[:, 0], nominal_tips(tubes, q)[-1], atol=TIP_RAD)
    assert follower.tube[:, 0] == pytest.approx([1.0, 0.4])


def cylinder(radius, spacing=0.5):
    z = np.arange(0, 100 + spacing, spacing)
    return np.stack([0 * z, 0 * z, z, radius + 0 * z], axis=-1)


def test_clearance_in_a_cylinder():
    rng = np.random.default_rng(0)
    points = rng.uniform([-4, -4, 0], [4, 4, 100], (500, 3))
    left = LumenWall(cylinder(5.0)).left(points)
    np.testing.assert_allclose(left, 5.0 - np.hypot(points[:, 0], points[:, 1]), atol=1e-9)


def test_clearance_in_a_cone_and_a_torus():
    cone = cylinder(5.0)
    cone[:, 3] = 5 - 0.02 * cone[:, 2]
    points = np.array([[1.0, 2.0, 30.0], [0.0, 0.0, 71.3]])
    wanted = 5 - 0.02 * points[:, 2] - np.hypot(points[:, 0], points[:, 1])
    np.testing.assert_allclose(LumenWall(cone).left(points), wanted, atol=1e-9)
    angle = np.arange(0, 1.5, 0.01)
    ring = np.stack([50 * np.cos(angle) - 50, 0 * angle, 50 * np.sin(angle), 4 + 0 * angle], axis=-1)
    at = np.array([0.3, 0.7, 1.2])
    points = np.stack([52 * np.cos(at) - 50, np.full(3, 1.5), 52 * np.sin(at)], axis=-1)
    np.testing.assert_allclose(LumenWall(ring).left(points), 4 - np.hypot(2, 1.5), atol=5e-3)


def deepest_contact(body):
    """Contact with a cylinder of radius 4 mm, at places a millimetre apart."""
    return -measure_clearance([LumenWall(cylinder(4.0))], *body.find_places(1.0)).min()


@pytest.mark.hazard("contact with the wall")
def test_deepest_contact_sees_the_end_of_the_wider_tube():
    """A straight body leaves the axis of a cylinder; it is wide up to 40 mm, and thin from there to its tip."""
    slope = 0.05
    s = np.array([[0.0], [40.0], [90.0]])
    direction = np.array([slope, 0.0, np.sqrt(1 - slope**2)])
    body = RobotShape(s, s[..., None] * direction, np.tile(direction, (3, 1, 1)), np.array([[2.5], [0.5]]))
    wide, thin = slope * 40 + 2.5, slope * 90 + 0.5
    assert deepest_contact(body) == pytest.approx(max(wide, thin) - 4.0, abs=1e-9)
    thick_first = RobotShape(body.s, body.points, body.tangents, np.array([[3.9], [0.5]]))
    assert deepest_contact(thick_first) == pytest.approx(slope * 40 + 3.9 - 4.0, abs=1e-9)


def judge_limits(robot, q, dt=0.1):
    """The verdict on limits of a motion of two tubes whose frames are dt seconds apart."""
    arrays = {"alpha": q[:, :2], "beta": q[:, 2:4], "theta": q[:, 4:], "time": dt * np.arange(1, len(q) + 1)}
    return _judge_limits(PlanFile(arrays, {"robot": robot}, None, ""))


@pytest.mark.hazard("limit exceeded")
def test_limits_are_seen_to_be_exceeded():
    limits = {"alpha": [["-inf", "inf"]], "beta": None, "theta": [-3.0, 3.0], "carriage_gap": None}
    limits |= {f"{axis}_acceleration": "inf" for axis in ("alpha", "beta", "theta")}
    limits |= {"alpha_speed": 1.0, "beta_speed": [20.0, 30.0], "theta_speed": 0.5}
    thin = {"outer_diameter": 1.8, "inner_diameter": 1.0}
    robot = {"tubes": [TUBE, TUBE | thin], "limits": limits}
    q = turning(11, 1.0, (30.0, 40.0))
    allowed = judge_limits(robot, q)
    assert allowed.word == YES
    assert allowed.number == pytest.approx(100)
    cases = {
        "speed": (q * [1.01, 1, 1, 1, 1, 1], 0.1),
        "order": (q + np.array([0, 0, 10.1, 0, 0, 0]), 0.1),
        "position": (q + np.array([0, 0, 0, 10.1, 0, 0]), 0.1),
    }
    words = {name: judge_limits(robot, *case).word for name, case in cases.items()}
    assert words == dict.fromkeys(cases, NO)
    assert judge_limits(robot | {"tubes": robot["tubes"][::-1]}, q).word == NO  # they do not fit
    gap = {"tubes": [TUBE, TUBE | thin | {"length": 180.0}], "limits": limits | {"carriage_gap": 21.0}}
    assert judge_limits(gap, q).word == NO  # 30 mm longer, 10 mm further out: 20 mm apart
    slow = robot | {"limits": limits | {"alpha_acceleration": 5.0}}
    jerky = q.copy()
    jerky[6:, 0] = jerky[5, 0]
    assert judge_limits(slow, jerky).word == NO
