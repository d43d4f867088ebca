"""A robot written as a file is read as the same robot."""

from __future__ import annotations

import pytest
from truth import TWO

from ctr_nlp import Limits, Robot, Tolerances, Tube, table_i_robot

LIMITED = Robot(
    (Tube(90.0, 50.0, (0.001, 0.0077), 5.7, 4.3, 0.31, 60_000.0), Tube(202.0, 107.0, 1 / 60, 3.7, 2.9)),
    Limits(beta=((0.0, 45.0), (1.5, 100.0)), carriage_gap=5.0, theta=(0.0, 0.0), beta_acceleration=40.0),
    Tolerances(0.01, (0.02, 0.03), motor_zero=0.04, distribution="normal"),
)


@pytest.mark.parametrize("robot", [table_i_robot(), TWO, LIMITED], ids=["table I", "two", "limits and tolerances"])
def test_a_written_robot_is_read_as_the_same(robot, tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(robot.to_toml("a robot\nof two lines"), encoding="utf-8")
    assert path.read_text().startswith("# a robot\n# of two lines\n")
    assert Robot.from_toml(path) == robot
