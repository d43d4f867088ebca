"""Checks of a robot's tubes against each other (they must nest), and of angles against the range of motors."""

from __future__ import annotations

import math
from typing import Any

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.tube import Tube
from ctr_nlp.robot.units import between, did_you_mean, suggest_angle, unit_mismatch_factor

MAX_MOTOR_ANGLES_RAD = {"alpha": 20 * math.pi, "theta": 4 * math.pi}
"""Largest angles, rad: ten turns of a tube, more than any motor's cables allow, and two of the base."""


def sequence_of_tubes(tubes: Any) -> tuple[Tube, ...]:
    """Return the tubes of a robot as a tuple.

    Parameters
    ----------
    tubes : Any
        What a user gave for them; a list or tuple of :class:`Tube` is accepted.

    Returns
    -------
    tuple of Tube
        In the given order, outermost first.

    Raises
    ------
    RobotError
        `tubes` is no list or tuple of tubes, or is empty.
    """
    found = tuple(tubes) if isinstance(tubes, list | tuple) else None
    if found is None or not all(isinstance(tube, Tube) for tube in found):
        raise RobotError(f"tubes of a robot are {tubes!r}; give a sequence of Tube(...), the outermost first")
    if not found:
        raise RobotError("a robot has no tubes; give at least one")
    return found


def check_pair(i: int, outer: Tube, inner: Tube) -> None:
    """Check that two neighbouring tubes nest and that their moduli are in the same unit.

    Parameters
    ----------
    i : int
        Number of the outer tube, from 1, for messages; the inner one is tube i + 1.
    outer, inner : Tube
        The two tubes; lengths and diameters in mm.

    Raises
    ------
    RobotError
        The tubes do not nest, are in the wrong order, the inner one is shorter than the outer one, or their moduli
        differ by about a power of a thousand.
    """
    if outer.inner_diameter < inner.outer_diameter:
        # Exchanged, the two would nest: they were given from the inside outwards.
        if inner.inner_diameter >= outer.outer_diameter:
            raise RobotError(f"tubes {i} and {i + 1} are in the wrong order: the outermost must come first")
        raise RobotError(
            f"tubes {i} and {i + 1} do not nest: inner_diameter of tube {i} is {outer.inner_diameter:g} mm, "
            f"outer_diameter of tube {i + 1} is {inner.outer_diameter:g} mm"
        )
    # Carriages stand behind each other in the order of the tubes: that of an inner tube, behind, needs the longer
    # tube.
    if outer.length > inner.length:
        raise RobotError(
            f"length of tube {i} is {outer.length:g} mm and of tube {i + 1} {inner.length:g} mm: "
            "an inner tube must be at least as long as the one around it"
        )
    off = unit_mismatch_factor(outer.youngs_modulus, inner.youngs_modulus)
    # A strain limit of its own says that a tube is of another material.
    if off is not None and outer.max_strain == inner.max_strain:
        raise RobotError(
            f"youngs_modulus of tubes {i} and {i + 1} are {outer.youngs_modulus:g} and {inner.youngs_modulus:g}, "
            f"about {off:.0e} apart; they must be in the same unit: is one in GPa and the other in MPa? "
            "Where their materials are that different, give the max_strain of the softer one"
        )


def check_angle(what: str, axis: str, value: float) -> None:
    """Check that an angle is one that a drive can turn by.

    Parameters
    ----------
    what : str
        The message up to "must lie in".
    axis : str
        Name of the entry of q, as ``"alpha_1"`` or ``"theta_x"``.
    value : float
        Angle, rad.

    Raises
    ------
    RobotError
        The angle is larger than any drive's; the message offers the value in rad where it was likely in degrees.
    """
    most = MAX_MOTOR_ANGLES_RAD[axis.partition("_")[0]]
    # The tolerance lets limits pass that were computed as multiples of pi.
    if abs(value) > most * (1 + 1e-9):
        meant = suggest_angle(value, between(-most, most))
        raise RobotError(f"{what} must lie in [{-most:.4g}, {most:.4g}] rad{did_you_mean(meant)}")
