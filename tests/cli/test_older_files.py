"""Robot, hardware and problem files of before tubes were parameters: they load, or say what to change."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ctr_nlp import Robot, table_i_robot
from ctr_nlp.cli.problems import from_python
from ctr_nlp.hardware.description import Hardware

BEFORE = Path(__file__).resolve().parents[1] / "data" / "before"


def test_a_robot_file_of_before_is_the_robot_that_it_was():
    robot, wanted = Robot.from_toml(BEFORE / "robot.toml"), table_i_robot()
    assert robot.axes == wanted.axes
    for tube, like in zip(robot.tubes, wanted.tubes, strict=True):
        assert tube.curved_length == like.curved_length
        assert tube.tip_curvature == pytest.approx(like.tip_curvature, rel=1e-12)
    stiffness = np.array([[tube.bending_stiffness for tube in one.tubes] for one in (robot, wanted)])
    np.testing.assert_allclose(stiffness[0] / stiffness[0, 0], stiffness[1] / stiffness[1, 0], rtol=1e-12)


def test_a_hardware_file_of_before_is_the_rig_that_it_was():
    hardware = Hardware.from_toml(BEFORE / "hardware.toml")
    assert [axis.joint for axis in hardware.axes] == [f"{j}_{i}" for j in ("beta", "alpha") for i in (1, 2, 3)]
    assert hardware.connection.device == "simulated"
    assert hardware.approach == 0.2


def test_a_problem_file_of_before_is_read():
    problem = from_python(str(BEFORE / "spiral.py"), 6, 3.0, None)
    assert (problem.name, problem.frames, problem.duration) == ("spiral", 6, 3.0)
    assert problem.robot == table_i_robot()
