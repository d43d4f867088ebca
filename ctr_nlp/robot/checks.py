"""Tubes that cannot be nested, and angles that no motor turns by."""

from __future__ import annotations

import math
from typing import Any

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.tube import Tube
from ctr_nlp.robot.units import angle_meant, between, did_you_mean, in_other_units

TURN = {"alpha": 20 * math.pi, "theta": 4 * math.pi}
"""Largest angles, rad: ten turns of a tube, beyond what any motor's cables bear, and two of the base."""


def sequence_of_tubes(tubes: Any) -> tuple[Tube, ...]:
    """Tubes as a tuple; raises RobotError where they are none."""
    found = tuple(tubes) if isinstance(tubes, list | tuple) else None
    if found is None or not all(isinstance(tube, Tube) for tube in found):
        raise RobotError(f"tubes of a robot are {tubes!r}; give a sequence of Tube(...), the outermost first")
    if not found:
        raise RobotError("a robot has no tubes; give at least one")
    return found


def check_pair(i: int, outer: Tube, inner: Tube) -> None:
    """Raise RobotError unless tube i + 1 fits into tube i, from 1, and both are written in the same units."""
    if outer.inner_diameter < inner.outer_diameter:
        if inner.inner_diameter >= outer.outer_diameter:
            raise RobotError(f"tubes {i} and {i + 1} are in the wrong order: the outermost must come first")
        raise RobotError(
            f"tubes {i} and {i + 1} do not nest: inner_diameter of tube {i} is {outer.inner_diameter:g} mm, "
            f"outer_diameter of tube {i + 1} is {inner.outer_diameter:g} mm"
        )
    if outer.length > inner.length:
        raise RobotError(
            f"length of tube {i} is {outer.length:g} mm and of tube {i + 1} {inner.length:g} mm: "
            "an inner tube must be at least as long as the one around it"
        )
    off = in_other_units(outer.youngs_modulus, inner.youngs_modulus)
    if off is not None:
        raise RobotError(
            f"youngs_modulus of tubes {i} and {i + 1} are {outer.youngs_modulus:g} and {inner.youngs_modulus:g}, "
            f"about {off:.0e} apart; they must be in the same unit: is one in GPa and the other in MPa?"
        )


def check_angle(what: str, axis: str, value: float) -> None:
    """Raise RobotError where an angle is larger than any drive's; what: the message up to "must lie in"."""
    most = TURN[axis.partition("_")[0]]
    if abs(value) > most * (1 + 1e-9):
        meant = angle_meant(value, between(-most, most))
        raise RobotError(f"{what} must lie in [{-most:.4g}, {most:.4g}] rad{did_you_mean(meant)}")
