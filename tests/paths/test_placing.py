"""A path before the robot where an insertion direction is given."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from strategies import numbers, rigid_transforms

from ctr_nlp import curve_from_points
from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.paths.placement import move_to_robot_frame

ANGLE = np.linspace(0, 1.2, 100)
ARC = curve_from_points(70 * np.column_stack([1 - np.cos(ANGLE), 0 * ANGLE, np.sin(ANGLE)]))
HEADING = ARC.point(np.array([10.0]))[0] / np.linalg.norm(ARC.point(np.array([10.0]))[0])


@given(rigid_transforms(), st.tuples(*[numbers(-1, 1)] * 3), numbers(1e-3, 1e3))
def test_the_given_direction_becomes_z_and_the_first_point_the_origin(transform, direction, scale):
    direction = np.array(direction)
    assume(np.linalg.norm(direction) > 0.1 and direction @ HEADING > 0.01)
    there = transform[:3, :3] @ direction
    curve, to_robot = move_to_robot_frame(ARC.apply_transform(transform), scale * there)
    assert to_robot[:3, :3] @ there / np.linalg.norm(there) == pytest.approx([0, 0, 1], abs=1e-9)
    assert curve.point(np.zeros(1))[0] == pytest.approx(np.zeros(3), abs=1e-9)
    assert np.linalg.det(to_robot[:3, :3]) == pytest.approx(1)
    s = np.linspace(0, ARC.length, 10)
    assert curve.point(s) == pytest.approx(
        ARC.apply_transform(transform).point(s) @ to_robot[:3, :3].T + to_robot[:3, 3], abs=1e-9
    )


def test_the_default_is_the_mean_direction_over_the_first_10_mm():
    assert move_to_robot_frame(ARC)[1] == pytest.approx(move_to_robot_frame(ARC, HEADING)[1], abs=1e-12)


@pytest.mark.parametrize(("degrees", "allowed"), [(0, True), (89, True), (91, False), (180, False)])
def test_a_direction_away_from_the_path_is_refused(degrees, allowed):
    direction = Rotation.from_euler("y", degrees, degrees=True).apply(HEADING)
    if allowed:
        move_to_robot_frame(ARC, direction)
        return
    with pytest.raises(CurveError, match=f"insertion direction is {degrees} degrees away .* must be within 90"):
        move_to_robot_frame(ARC, direction)


@pytest.mark.parametrize(
    "direction", [(0, 0, 0), (0, 0, np.nan), (np.inf, 0, 0), (1, 2), ((0, 0, 1),), "up", (0, None, 1)]
)
def test_no_direction_is_refused(direction):
    with pytest.raises(OptionError, match=r"insertion direction is .*three finite numbers, not all of them 0"):
        move_to_robot_frame(ARC, direction)


def test_a_path_that_returns_at_once_can_be_told_its_direction():
    angle = np.linspace(0, 2 * np.pi, 200)
    ring = 10 / (2 * np.pi) * np.column_stack([1 - np.cos(angle), 0 * angle, np.sin(angle)])
    curve = curve_from_points(ring)
    curve, _ = move_to_robot_frame(curve.part(0.0, min(10.0, curve.length)), (0, 0, 1))
    assert curve.tangent(np.zeros(1))[0] == pytest.approx([0, 0, 1], abs=1e-3)
