"""The robot of the paper, Table I."""

from __future__ import annotations

from ctr_nlp.robot.robot import Robot
from ctr_nlp.robot.tube import Tube


def table_i_robot(literal: bool = False) -> Robot:
    """Return the robot of the paper, Table I.

    Parameters
    ----------
    literal : bool
        Whether the table's lengths 50, 107 and 150 mm are straight, as it says, so that 40, 95 and 240 mm are
        curved. By default they are the curved lengths, since the paper deploys curved parts only (section III-A).

    Returns
    -------
    Robot
        Three tubes, outermost first, with default limits and tolerances. Young's moduli are ratios (all 1), which
        is enough without a load.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> robot = ctr.table_i_robot()
    >>> robot.d, robot.reach
    (3, 150.0)
    >>> [tube.curved_length for tube in ctr.table_i_robot(literal=True).tubes]
    [40.0, 95.0, 240.0]
    """
    curved = (40.0, 95.0, 240.0) if literal else (50.0, 107.0, 150.0)
    return Robot(
        (
            Tube(90.0, curved[0], 1 / 130, outer_diameter=5.7, inner_diameter=4.3),
            Tube(202.0, curved[1], 1 / 60, outer_diameter=3.7, inner_diameter=2.9),
            Tube(390.0, curved[2], 1 / 80, outer_diameter=2.1, inner_diameter=1.0),
        )
    )
