"""Where the page says that a robot is, and colours that are legible on white."""

import dataclasses

import numpy as np
import pytest
from near_fold import near_the_fold, plan_through

from ctr_nlp.view.figures.parts.palette import TUBE_COLOURS
from ctr_nlp.view.report.legible import MIN_LINE_CONTRAST, contrast_with_white, darken_for_white
from ctr_nlp.view.report.places import coordinates, printed_frames, way_to_go

TO_ROBOT = np.array([[0.0, -1, 0, 5], [-1, 0, 0, 7], [0, 0, -1, 9], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def plan():
    return plan_through(near_the_fold(), model="dominant", radius=6.0)


def placed(plan, space, assumed=False):
    """The plan as one whose file has axes of that name."""
    problem = plan.meta["problem"] | {"space": space, "space_assumed": assumed}
    return dataclasses.replace(plan, to_robot=TO_ROBOT, meta=plan.meta | {"problem": problem})


@pytest.mark.parametrize("space", ["RAS", "LPS", "LAS"])
def test_letters_point_where_the_axes_of_the_scan_do(plan, space):
    found = coordinates(placed(plan, space))
    assert found["name"] == space
    assert "".join(axis["letters"][0] for axis in found["axes"]) == space
    for axis, along in zip(found["axes"], np.eye(3), strict=True):
        np.testing.assert_allclose(axis["direction"], TO_ROBOT[:3, :3] @ along)
        assert set(axis["letters"]) in ({"R", "L"}, {"A", "P"}, {"S", "I"})


def test_points_of_the_scan_come_back_to_the_robot(plan):
    found = coordinates(placed(plan, "RAS"))
    tips = np.array(found["tip"]) @ TO_ROBOT[:3, :3].T + TO_ROBOT[:3, 3]
    np.testing.assert_allclose(tips, plan.shape[:, -1], atol=0.1)
    nearest = np.array(found["nearest"]) @ TO_ROBOT[:3, :3].T + TO_ROBOT[:3, 3]
    worst = plan.clearance.argmin(axis=1)
    np.testing.assert_allclose(nearest, plan.shape[np.arange(len(worst)), worst], atol=0.1)
    np.testing.assert_allclose(found["depth"], -plan.clearance.min(axis=1), atol=0.006)


def test_axes_without_a_patient_are_x_y_and_z(plan):
    assert coordinates(plan)["name"] == "the robot's base frame"
    assert [axis["letters"][0] for axis in coordinates(plan)["axes"]] == ["x", "y", "z"]
    assert coordinates(placed(plan, "xyz"))["name"] == "the file's axes"
    assert coordinates(placed(plan, "RAS", assumed=True))["name"] == "RAS, assumed"


def test_the_way_to_go_is_to_the_end_of_the_last_target(plan):
    found = way_to_go(plan)
    np.testing.assert_allclose(found.distance, np.linalg.norm(plan.shape[:, -1] - plan.target[-1, -1], axis=1))
    cosine = plan.tip_direction @ plan.target_direction[-1]
    np.testing.assert_allclose(np.cos(np.radians(found.angle_deg)), cosine, atol=1e-9)


def test_printed_frames_are_first_middle_worst_and_last(plan):
    error = np.arange(len(plan.time), dtype=float) % 5
    assert [each.frame for each in printed_frames(plan, error)] == [0, 6, 4, 11]


def test_no_wall_and_no_shape_are_not_known(plan):
    bare = plan_through(near_the_fold(), model="dominant")
    assert coordinates(bare)["depth"] == coordinates(bare)["nearest"] == [None] * len(bare.time)
    shape = np.array(plan.shape)
    shape[-1] = np.nan
    assert coordinates(dataclasses.replace(plan, shape=shape))["tip"][-1] is None


@pytest.mark.parametrize("colour", TUBE_COLOURS)
def test_lines_of_plots_are_told_from_white(colour):
    found = darken_for_white(colour)
    assert contrast_with_white(found) >= MIN_LINE_CONTRAST
    assert found == colour.lower() or contrast_with_white(colour) < MIN_LINE_CONTRAST
    assert contrast_with_white("#ffffff") == pytest.approx(1.0)
    assert contrast_with_white("#000000") == pytest.approx(21.0)
