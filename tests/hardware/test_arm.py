"""The arm's kinematics, doubted by forward kinematics of our own and by what must hold for any tilt."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import HardwareError, OptionError
from ctr_nlp.hardware.arm import kinematics
from ctr_nlp.hardware.arm.description import ARM_MODELS, JOINT_LIMIT, Arm, check_joints
from ctr_nlp.hardware.arm.kinematics import (
    LARGEST_GAIN,
    LENGTH,
    gains,
    insertion_error,
    inverse_kinematics,
    poses,
    tilt_of_joints,
)

library = pytest.importorskip("ur_analytic_ik")

PUBLISHED = {
    "ur3": (0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
    "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5": (0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10": (0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "ur16e": (0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
    "ur20": (0.2363, -0.8620, -0.7287, 0.2010, 0.1593, 0.1543),
}
"""d1, a2, a3, d4, d5, d6 in m: universal-robots.com, DH parameters for calculations of kinematics and dynamics."""


def flange(model: str, q: np.ndarray) -> np.ndarray:
    """The flange (4, 4) in mm by the textbook's product of Denavit-Hartenberg matrices."""
    d1, a2, a3, d4, d5, d6 = (1000 * value for value in PUBLISHED[model])
    pose = np.eye(4)
    rows = zip(q, (0, a2, a3, 0, 0, 0), (d1, 0, 0, d4, d5, d6), (90, 0, 0, 90, -90, 0), strict=True)
    for angle, a, d, twist in rows:
        turn, bend, along = np.eye(4), np.eye(4), np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
        bend[:3, :3] = Rotation.from_euler("x", twist, degrees=True).as_matrix()
        along[:3, 3] = a, 0, d
        pose = pose @ turn @ along @ bend
    return pose


def walk(*corners: tuple[float, float], count: int = 12) -> np.ndarray:
    """Tilts along straight lines through corners, in degrees."""
    legs = [np.linspace(a, b, count) for a, b in pairwise(corners)]
    return np.radians(np.concatenate(legs))


ROUND = walk((0, 0), (25, 0), (0, 25), (-25, 0), (0, -25), (25, 25), (0, 0))


def test_models_are_those_of_the_library():
    assert set(ARM_MODELS) == {
        name for name in dir(library) if hasattr(getattr(library, name), "inverse_kinematics")
    }


@pytest.mark.parametrize("model", PUBLISHED)
def test_forward_kinematics_are_those_of_the_published_parameters(model):
    arm = Arm(model=model)
    random = np.random.default_rng(0).uniform(-JOINT_LIMIT, JOINT_LIMIT, (50, 6))
    for q, error, theta in zip(random, insertion_error(arm, random), tilt_of_joints(arm, random), strict=True):
        held = flange(model, q) @ arm.mount
        assert error == pytest.approx(np.linalg.norm(held[:3, 3] - arm.insertion_point), abs=1e-9)
        turned = Rotation.from_matrix(arm.base[:3, :3].T @ held[:3, :3]).as_matrix()
        assert theta == pytest.approx(
            [np.arctan2(-turned[1, 2], turned[1, 1]), np.arctan2(-turned[2, 0], turned[0, 0])], abs=1e-9
        )


def test_poses_turn_the_robot_about_the_insertion_point_x_first():
    arm = Arm(insertion_rotation_deg=(10, 120, -30), mount_rotation_deg=(5, 80, 7))
    theta = np.array([[0.3, -0.5], [-1.2, 0.8]])
    held = poses(arm, theta) @ arm.mount
    upright = Rotation.from_euler("xyz", arm.insertion_rotation_deg, degrees=True)
    for frame, angles in zip(held, theta, strict=True):
        assert frame[:3, 3] == pytest.approx(arm.insertion_point, abs=1e-9)
        expected = upright * Rotation.from_euler("y", angles[1]) * Rotation.from_euler("x", angles[0])
        assert frame[:3, :3] == pytest.approx(expected.as_matrix(), abs=1e-12)


def test_the_default_inserts_downwards_and_away_from_itself():
    arm = Arm()
    assert arm.base[:3, 2] == pytest.approx([np.sqrt(0.5), 0, -np.sqrt(0.5)])
    assert np.linalg.inv(arm.mount)[:3, 3] == pytest.approx([60, 0, -125])


@pytest.mark.parametrize("model", ["ur3", "ur3e", "ur5", "ur5e", "ur10e"])
def test_our_own_forward_kinematics_find_every_tilt_again(model):
    large = {} if "3" in model else {"insertion_point": (550, -100, 350)}
    arm = Arm(model=model, **large)
    q = inverse_kinematics(arm, ROUND)
    for at, pose in zip(q, poses(arm, ROUND), strict=True):
        assert flange(model, at) == pytest.approx(pose, abs=1e-7)
    assert tilt_of_joints(arm, q) == pytest.approx(ROUND, abs=1e-9)
    assert insertion_error(arm, q).max() < 1e-7
    assert np.abs(np.diff(q, axis=0)).max() < 0.2


three = st.tuples(*[st.floats(-1, 1)] * 3)


@given(
    st.sampled_from(ARM_MODELS), three, three, three, st.lists(st.tuples(*[st.floats(-30, 30)] * 2), min_size=2)
)
def test_any_arm_follows_exactly_or_says_where_it_cannot(model, place, turn, mount, corners):
    arm = Arm(
        model=model,
        insertion_point=tuple(np.add((450, 0, 300), np.multiply(150, place))),
        insertion_rotation_deg=tuple(np.add((0, 135, 0), np.multiply(60, turn))),
        mount_translation=tuple(np.add((125, 0, 60), np.multiply(60, mount))),
    )
    theta = walk(*corners[:4], count=5)
    try:
        q = inverse_kinematics(arm, theta)
    except HardwareError as error:
        if f"of {len(theta)}, theta" in str(error):
            return
        raise
    assert np.abs(tilt_of_joints(arm, q) - theta).max() < 1e-6
    assert insertion_error(arm, q).max() < 1e-6
    assert np.abs(q).max() <= JOINT_LIMIT + 1e-9
    assert gains(arm, q).max() <= LARGEST_GAIN
    steps = np.abs(np.diff(theta, axis=0)).sum(axis=1)
    assert (np.abs(np.diff(q, axis=0)).max(axis=1) <= LARGEST_GAIN * steps + 1e-9).all()


def test_frames_far_apart_stay_on_the_branch_that_close_ones_show():
    corners = [(60, 10), (-60, -40), (10, 60)]
    dense = walk(*corners, count=2000)
    sparse = dense[[0, 2000, -1]]
    assert inverse_kinematics(Arm(), sparse) == pytest.approx(
        inverse_kinematics(Arm(), dense)[[0, 2000, -1]], abs=1e-7
    )


def test_gain_is_the_jacobian_of_our_own_forward_kinematics():
    arm = Arm()
    for q in np.random.default_rng(1).uniform(-2, 2, (5, 6)):
        at, columns = flange("ur3e", q), []
        for e in np.eye(6):
            ends = [flange("ur3e", q + s * 1e-5 * e) @ np.linalg.inv(at) for s in (1, -1)]
            rate = (ends[0] - ends[1]) / 2e-5
            speed = rate[:3, :3] @ arm.insertion_point + rate[:3, 3]
            columns.append([rate[2, 1], rate[0, 2], rate[1, 0], *speed / LENGTH])
        smallest = np.linalg.svd(np.array(columns))[1][-1]
        assert gains(arm, q[None])[0] == pytest.approx(1 / smallest, rel=1e-5)


def test_gain_is_infinite_with_the_elbow_stretched():
    assert gains(Arm(), np.array([[0.3, -1.0, 0.0, 0.4, 1.0, 0.2]]))[0] > 1e9


def zero_tilt() -> np.ndarray:
    pose = poses(Arm(), np.zeros((1, 2)))[0]
    pose[:3, 3] /= 1000
    return np.array(library.ur3e.inverse_kinematics(pose))


@pytest.mark.parametrize("number", range(8))
def test_start_joints_choose_the_joint_solution_and_the_turn(number):
    wanted = zero_tilt()[number]
    wanted[5] -= 2 * np.pi * np.sign(wanted[5])
    arm = Arm(start_joints_deg=np.degrees(wanted + 0.05).clip(-360, 360).tolist())
    small = np.radians([[3.0, 4.0], [0.0, 0.0]])
    assert inverse_kinematics(arm, small)[1] == pytest.approx(wanted, abs=1e-9)


def test_where_the_arm_stands_chooses_the_branch_at_the_first_frame():
    for known in zero_tilt():
        there = inverse_kinematics(Arm(), np.radians([[0.0, 0.0], [20.0, -10.0]]), known)[-1]
        back = inverse_kinematics(Arm(), np.radians([[20.0, -10.0], [0.0, 0.0]]), there)
        assert back[0] == pytest.approx(there, abs=1e-9)
        assert back[1] == pytest.approx(known, abs=1e-9)


def test_the_branch_is_the_one_furthest_from_singularities_and_limits():
    chosen = gains(Arm(), inverse_kinematics(Arm(), ROUND)).max()
    for known in zero_tilt():
        try:
            other = inverse_kinematics(Arm(), ROUND, known)
        except HardwareError:
            continue
        assert chosen <= gains(Arm(), other).max() + 1e-9


def test_a_tilt_out_of_reach_is_named():
    with pytest.raises(
        HardwareError, match=r"frame 3 of 3, theta = \(0, 1\) rad: every joint solution ends: out of"
    ):
        inverse_kinematics(Arm(insertion_point=(500, 0, 400)), np.array([[0.0, 0.0], [0.0, 0.1], [0.0, 1.0]]))
    with pytest.raises(HardwareError, match=r"frame 1 of 1.*out of the arm's reach"):
        inverse_kinematics(Arm(insertion_point=(900, 0, 0)), np.zeros((1, 2)))


def test_a_singularity_on_the_way_is_named():
    """The joint solution that suits small tilts best; another one goes on."""
    nearest = np.degrees(inverse_kinematics(Arm(), np.zeros((1, 2)))[0])
    with pytest.raises(
        HardwareError, match=r"frame 2 of 3.*joint solution of the start ends: singular: joints would turn \d+"
    ):
        inverse_kinematics(Arm(start_joints_deg=nearest.tolist()), np.array([[0.0, 0.0], [0.0, 1.8], [0.0, 0.0]]))
    inverse_kinematics(Arm(), np.array([[0.0, 0.0], [0.0, 1.8], [0.0, 0.0]]))


def test_a_joint_limit_is_named():
    start = zero_tilt()[0]
    end = inverse_kinematics(Arm(), np.radians([[0.0, 0.0], [0.0, 30.0]]), start)[-1]
    joint = 5
    turned = start.copy()
    turned[joint] += 2 * np.pi * np.round((np.sign(end - start)[joint] * 2 * np.pi - start[joint]) / (2 * np.pi))
    theta = np.radians([[0.0, 0.0], [0.0, 1.0], [0.0, 30.0]])
    followed = inverse_kinematics(Arm(), theta, start)[:, joint] + turned[joint] - start[joint]
    room = JOINT_LIMIT - np.abs(followed)
    if (room >= 0).all():
        pytest.fail(f"this motion keeps the limit: {followed}")
    frame = int(np.argmax(room < 0)) + 1
    with pytest.raises(HardwareError, match=rf"frame {frame} of 3.*joint 6 \(wrist 3\) would turn beyond 360 deg"):
        inverse_kinematics(Arm(), theta, turned)


def test_a_jump_is_named(monkeypatch):
    """Were the library to lose a joint solution for a moment, the next one is not taken for it."""
    whole, calls = kinematics._solutions, []

    def losing(model, pose):
        calls.append(None)
        return whole(model, pose)[:1] if len(calls) > 3 else whole(model, pose)[1:2]

    monkeypatch.setattr(kinematics, "_solutions", losing)
    with pytest.raises(HardwareError, match=r"frame 4 of 9.*joint \d \(.*\) would jump by"):
        inverse_kinematics(Arm(), np.linspace((0, 0), (0.05, 0), 9))


def insertion_error_between(arm, q, substeps=8):
    """Largest insertion_error (T - 1,) in mm between samples (T, 6), joints interpolated linearly."""
    part = np.linspace(0, 1, substeps + 1)[:, None]
    followed = q[:-1, None] * (1 - part) + q[1:, None] * part
    return insertion_error(arm, followed.reshape(-1, 6)).reshape(-1, substeps + 1).max(axis=1)


def test_the_insertion_point_moves_little_between_samples():
    arm = Arm()
    coarse = inverse_kinematics(arm, walk((-20, 10), (20, -10), count=11))
    fine = inverse_kinematics(arm, walk((-20, 10), (20, -10), count=21))
    found = insertion_error_between(arm, coarse)
    for a, b, worst in zip(coarse[:-1], coarse[1:], found, strict=True):
        middle = flange("ur3e", (a + b) / 2) @ arm.mount
        assert worst == pytest.approx(np.linalg.norm(middle[:3, 3] - arm.insertion_point), rel=0.05)
    assert found.shape == (10,)
    assert insertion_error_between(arm, fine).max() == pytest.approx(found.max() / 4, rel=0.2)
    dense = walk((-20, 10), (20, -10), count=176)
    assert insertion_error_between(arm, inverse_kinematics(arm, dense)).max() < 0.001


def resting(**changes: float) -> tuple[np.ndarray, np.ndarray]:
    """Joint 4 goes 0, 0.01, 0.03, 0.04, 0.04 rad in tenths of a second, the others stay."""
    q = np.zeros((5, 6))
    q[:, 3] = [0, 0.01, 0.03, 0.04, 0.04]
    return 0.1 * np.arange(5), q


def test_speed_is_checked_by_frame_and_joint():
    time, q = resting()
    enough = np.degrees(0.2) * 1.001
    check_joints(Arm(joint_speed_deg=[1, 1, 1, enough, 1, 1]), time, q)
    message = r"speed of joint 4 \(wrist 1\) to frame 3 of 5 \(0.2 s\) is 11.46 deg/s; it must be at most 11"
    with pytest.raises(HardwareError, match=message):
        check_joints(Arm(joint_speed_deg=[1, 1, 1, 11, 1, 1]), time, q)


def test_acceleration_is_checked_and_counts_the_start_from_rest():
    time, q = resting()
    check_joints(Arm(joint_acceleration_deg=np.degrees(1.0) * 1.001), time, q)
    with pytest.raises(HardwareError, match=r"acceleration of joint 4 .* is 57.3 deg/s\^2; it must be at most 57"):
        check_joints(Arm(joint_acceleration_deg=57), time, q)
    with pytest.raises(HardwareError, match=r"acceleration of joint 1 \(base\) to frame 1 of 2"):
        check_joints(Arm(joint_acceleration_deg=57), time[:2], np.outer([0, 0.03], np.eye(6)[0]))


def test_times_and_joints_are_checked():
    time, q = resting()
    with pytest.raises(HardwareError, match=r"time of frame 3 does not come after"):
        check_joints(Arm(), np.array([0, 0.1, 0.1, 0.2, 0.3]), q)
    with pytest.raises(HardwareError, match=r"finite \(T, 6\)"):
        check_joints(Arm(), time, q * np.nan)
    with pytest.raises(HardwareError, match=r"shape \(2,\); it must be finite \(T, 2\)"):
        inverse_kinematics(Arm(), np.zeros(2))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("model", "ur4", r"model of the arm is 'ur4'; it must be one of ur3, ur3e, ur5"),
        ("device", "grbl", r"device of the arm is 'grbl'; it must be one of simulated, ur"),
        ("insertion_point", [1, 2], r"insertion_point of the arm is \[1, 2\]; it must be 3 numbers"),
        ("insertion_point", 3.0, r"insertion_point of the arm is 3.0; it must be 3 numbers"),
        ("mount_rotation_deg", [0, "a", 0], r"mount_rotation_deg"),
        ("mount_translation", [0, float("inf"), 0], r"mount_translation .* finite"),
        ("start_joints_deg", [0, 0, 0, 400, 0, 0], r"start_joints_deg .* at most 360"),
        ("joint_speed_deg", 0, r"joint_speed_deg of the arm is 0; it must be positive"),
        ("joint_speed_deg", [1, 2], r"joint_speed_deg"),
        ("joint_acceleration_deg", [1, 1, 1, 1, 1, -1], r"joint_acceleration_deg"),
        ("tilt_speed_deg", -1, r"tilt_speed_deg of the arm is -1; it must be positive"),
        ("skew_tolerance", 0, r"skew_tolerance of the arm is 0; it must be positive"),
        ("host", "", r"host of the arm is ''"),
    ],
)
def test_bad_fields_are_named(field, value, message):
    with pytest.raises(HardwareError, match=message):
        replace(Arm(), **{field: value})


def test_a_missing_library_is_named_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ur_analytic_ik", None)
    with pytest.raises(
        OptionError, match=r'ur_analytic_ik is not installed; .*-m pip install "ctr_nlp\[hardware\]"'
    ):
        inverse_kinematics(Arm(), np.zeros((1, 2)))
