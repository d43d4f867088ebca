"""Young's moduli in MPa. Without a load only their ratios matter, and robot files may leave them out."""

from __future__ import annotations

from dataclasses import replace

from ctr_nlp.exceptions import LoadError
from ctr_nlp.robot import Robot
from ctr_nlp.robot.units import between, did_you_mean
from ctr_nlp.support.value_checks import number

MODULUS_RANGE_MPA = (100.0, 500_000.0)
"""Least and largest modulus of a tube, MPa, from soft polymers to beyond steel."""
MAX_MODULUS_RATIO = 10.0
"""Largest number that is read as a ratio to the moduli of other tubes, or as written in GPa."""
MODULUS_REMEDY = (
    "; this one looks like a ratio, which is enough without loads: write moduli into the robot file, or give one "
    "by with_modulus (--youngs-modulus)"
)
PA, GPA = 1e-6, 1e3
"""In MPa."""


def check_moduli(robot: Robot) -> None:
    """Raise LoadError unless every tube of a robot has a Young's modulus in MPa, which a load needs."""
    for i, tube in enumerate(robot.tubes, start=1):
        value, (low, high) = tube.youngs_modulus, MODULUS_RANGE_MPA
        if low <= value <= high:
            continue
        found = did_you_mean(_suggest_moduli(value))
        left_out = MODULUS_REMEDY * (value <= MAX_MODULUS_RATIO)
        raise LoadError(
            f"youngs_modulus of tube {i} is {value:g}; under a load it must be in MPa and lie in "
            f"[{low:g}, {high:g}], as about 60000 of nitinol{left_out}{found}"
        )


def with_modulus(robot: Robot, modulus: float) -> Robot:
    """Return the robot with youngs_modulus in MPa, where its tubes have only ratios.

    Shapes without load stay the same. modulus: in MPa, of a tube whose ratio is 1; the others keep their ratio to
    it. A robot whose tubes have moduli in MPa, of which this is one, stays as it is. Raises LoadError.
    """
    low, high = MODULUS_RANGE_MPA
    value = number(
        LoadError,
        "youngs_modulus of a robot",
        modulus,
        lambda given: low <= given <= high,
        f"be in MPa and lie in [{low:g}, {high:g}]{did_you_mean(_suggest_moduli(modulus))}",
    )
    own = [tube.youngs_modulus for tube in robot.tubes]
    # A larger number cannot be a ratio, so that the file has moduli already, and a second scale would be a
    # mistake.
    if max(own) > MAX_MODULUS_RATIO:
        check_moduli(robot)
        if value not in own:
            raise LoadError(
                f"youngs_modulus of a robot is given as {value:g} MPa, but its tubes have moduli in MPa already, "
                f"{', '.join(f'{each:g}' for each in own)}; leave with_modulus (--youngs-modulus) out, or change "
                "the robot file"
            )
        return robot
    scaled = [replace(tube, youngs_modulus=tube.youngs_modulus * value) for tube in robot.tubes]
    found = replace(robot, tubes=tuple(scaled))
    check_moduli(found)
    return found


def _suggest_moduli(value: object) -> list[str]:
    """Return the moduli in MPa that one in GPa or Pa was perhaps meant to be."""
    if not isinstance(value, int | float):
        return []
    plausible = between(*MODULUS_RANGE_MPA)
    offers = ((value * GPA, f"{value:g} GPa"), (value * PA, f"{value:g} Pa"))
    return [f"{mpa:g} MPa ({written})" for mpa, written in offers if plausible(mpa) and value > MAX_MODULUS_RATIO]
