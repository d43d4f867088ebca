"""The robot of the paper, Table I."""

from __future__ import annotations

import warnings

from ctr_nlp.robot.robot import Robot
from ctr_nlp.robot.tube import Tube


def table_i_robot(literal: bool = False) -> Robot:
    """The robot of the paper, Table I, read so that only curved parts are deployed: 50, 107 and 150 mm.

    literal=True takes the table at its word: those lengths are straight and 40, 95, 240 mm are curved.
    """
    curved = (40.0, 95.0, 240.0) if literal else (50.0, 107.0, 150.0)
    return Robot(
        (
            Tube(90.0, curved[0], 1 / 130, outer_diameter=5.7, inner_diameter=4.3),
            Tube(202.0, curved[1], 1 / 60, outer_diameter=3.7, inner_diameter=2.9),
            Tube(390.0, curved[2], 1 / 80, outer_diameter=2.1, inner_diameter=1.0),
        )
    )


def seed_robot(literal: bool = False) -> Robot:
    """The old name of table_i_robot, for one more version."""
    warnings.warn("seed_robot is called table_i_robot now", DeprecationWarning, stacklevel=2)
    return table_i_robot(literal)
