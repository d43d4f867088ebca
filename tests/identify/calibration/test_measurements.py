"""Measurements from files: what they mean, and what is refused in a line."""

import numpy as np
import pytest
from sensed import TWO, observations

from ctr_nlp.exceptions import MeasurementError
from ctr_nlp.identify.calibration.reading import read_measurements

AXES = "alpha_1,alpha_2,beta_1,beta_2"
ROW = "0.1,-0.2,30,80"


def read(tmp_path, *lines, robot=TWO):
    (tmp_path / "m.csv").write_text("\n".join(lines) + "\n")
    return read_measurements(tmp_path / "m.csv", robot)


def test_columns_are_read_in_any_order_and_empty_cells_were_not_measured(tmp_path):
    found = read(
        tmp_path,
        "# a comment",
        f"tip_z,{AXES},tip_x,tip_y,p2_x,p2_y,p2_z,p2_s,p1_sigma,p1_x,p1_y,p1_z",
        f"80,{ROW},1,2,3,4,5,40,0.25,,nan,7",
        f",{ROW.replace('30', '31')},,,3,4,5,20,,,,",
    )
    np.testing.assert_array_equal(found.q[0], [0.1, -0.2, 30, 80, 0, 0])
    np.testing.assert_array_equal(found.tip, [[1, 2, 80], [np.nan] * 3])
    np.testing.assert_array_equal(found.sigma[0], [0.25, 0.5])
    np.testing.assert_array_equal(found.points[0], [[np.nan, np.nan, 7], [3, 4, 5]])
    assert found.sigma[1, 1] == 0.25
    assert np.isnan(found.direction).all()
    assert not found.has_times
    assert found.fresh.all()


def test_forces_at_the_tip_are_known_and_none_act_where_there_are_no_columns(tmp_path):
    found = read(tmp_path, f"{AXES},tip_x,force_y,force_z", f"{ROW},1,0.5,-1", f"{ROW},1,0,0")
    np.testing.assert_array_equal(found.force, [[0, 0.5, -1], [0, 0, 0]])
    assert found.repeated == 0
    assert found.has_tip_force
    assert not read(tmp_path, f"{AXES},tip_x", f"{ROW},1").has_tip_force


def test_a_quaternion_turns_the_z_axis_to_the_direction_of_the_tip(tmp_path):
    half = np.sqrt(0.5)
    found = read(tmp_path, f"{AXES},tip_qw,tip_qx,tip_qy,tip_qz", f"{ROW},{half},0,{half},0")
    np.testing.assert_allclose(found.direction, [[1, 0, 0]], atol=1e-12)


def test_copies_are_counted_and_time_is_put_in_order(tmp_path):
    lines = [f"0.{k},{ROW},{k},2,3" for k in (3, 1, 2, 1, 3, 3)]
    found = read(tmp_path, f"time_s,{AXES},tip_x,tip_y,tip_z", *lines)
    assert found.time.tolist() == [0.1, 0.2, 0.3]
    assert found.repeated == 3
    assert found.fresh.tolist() == [True, False, False]


def test_several_files_are_recordings(tmp_path):
    for name, points in (("a", ""), ("b", ",p1_x,p1_y,p1_z,p1_s")):
        values = ",1,2,3,10" if points else ""
        text = f"{AXES},tip_x,tip_y,tip_z{points}\n{ROW},1,2,3{values}\n"
        (tmp_path / f"{name}.csv").write_text(text)
    found = read_measurements([tmp_path / "a.csv", tmp_path / "b.csv"], TWO)
    assert found.recording.tolist() == [0, 1]
    assert found.points.shape == (2, 1, 3)
    assert found.repeated == 0


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["alpha_1,beta_1,beta_2,tip_x", "0,1,2,3"], "m.csv has no column alpha_2"),
        ([f"{AXES},tip_w", f"{ROW},1"], "has a column 'tip_w', which is unknown; known are alpha_1"),
        ([f"{AXES},tip_x,tip_x", f"{ROW},1,1"], "the column 'tip_x' twice"),
        ([f"{AXES},tip_x", f"{ROW}"], "line 2 of .* has 4 cells; the first line names 5"),
        ([f"{AXES},tip_x", f"{ROW},1", f"{ROW},1e"], "tip_x in line 3 of .* is '1e'; it must be a number"),
        ([f"{AXES},tip_x", f"{ROW},inf"], "tip_x in line 2 of .* is 'inf'"),
        ([f"{AXES},tip_x,force_x", f"{ROW},1,"], "force_x in line 2 of .* is empty; write 0 where nothing pulls"),
        (
            [f"{AXES},tip_x,force_x", f"{ROW},1,150"],
            r"force_x, force_y, force_z in line 2 of .* are \[150.0, 0.0, 0.0\] N; .* at most 100 N.* of a gram",
        ),
        ([f"{AXES},tip_x", "0.1,,30,80,1"], "alpha_2 in line 2 of .* is empty"),
        (
            [f"{AXES},tip_x", "0.1,0,90,80,1"],
            "beta_2 in line 2 is 80 mm; it must lie between beta_1, 90 mm",
        ),
        ([f"{AXES},tip_x", "0.1,0,30,180,1"], "beta_2 .* is 180 mm; .* the tube's length, 160 mm"),
        ([f"{AXES},tip_x", "720,0,30,80,1"], r"alpha_1 .* is 720 rad.*did you mean 12.57 rad \(720 degrees\)"),
        ([f"{AXES},p1_x,p1_y,p1_z", f"{ROW},1,2,3"], "p1 in line 2 of .* has neither p1_sigma nor p1_s"),
        ([f"{AXES},p1_x,p1_y,p1_z,p1_s", f"{ROW},1,2,3,81"], r"p1_s is 81 mm in line 2.*s in \[0, 80\] mm"),
        ([f"{AXES},tip_qw,tip_qx,tip_qy,tip_qz", f"{ROW},1,1,0,0"], "tip_qw.* of length 1.41"),
        ([f"{AXES},tip_x", f"{ROW},"], "nothing was measured"),
        ([f"{AXES},tip_x"], "hold no rows"),
        ([f"{AXES},time_s,tip_x", f"{ROW},0.1,1", f"{ROW},,1"], "has no time_s in some rows"),
        ([f"{AXES},time_s,tip_x", f"{ROW},0.1,1", f"{ROW},0.1,2"], "two different observations .* time 0.1 s"),
        (
            [f"time_s,{AXES},tip_x", "0,3.1,0,30,80,1", "0.1,-3.1,0,30,80,1"],
            "alpha_1 goes from 3.1 to -3.1 rad between 0 and 0.1 s: is it wrapped",
        ),
    ],
)
def test_what_cannot_have_been_measured_is_refused_in_one_line(lines, message, tmp_path):
    with pytest.raises(MeasurementError, match=message) as raised:
        read(tmp_path, *lines)
    assert "\n" not in str(raised.value)


def test_a_file_that_is_not_there_and_none_at_all_are_refused(tmp_path):
    with pytest.raises(MeasurementError, match="cannot be read"):
        read_measurements(tmp_path / "nothing.csv", TWO)
    with pytest.raises(MeasurementError, match="no file of measurements"):
        read_measurements([], TWO)


def test_measurements_know_their_shapes():
    q = np.array([[0.1, -0.2, 30.0, 80.0, 0, 0]])
    with pytest.raises(MeasurementError, match=r"tip of measurements has shape \(1, 2\)"):
        observations(q, tip=np.zeros((1, 2)))
    with pytest.raises(MeasurementError, match="must have 6: alpha_1"):
        observations(q[:, :5], tip=np.zeros((1, 3))).check(TWO)
    found = observations(q, np.ones((1, 2, 3)), (0.5, 1.2))
    with pytest.raises(MeasurementError, match="a point lies at sigma"):
        found.check(TWO)
    assert found.observed_mask.all()
    assert len(found[np.array([0])]) == 1
