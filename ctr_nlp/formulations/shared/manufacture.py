"""What can be made of Nitinol tubing, and what a designed robot must hold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

from ctr_nlp.exceptions import OptionError
from ctr_nlp.robot.strain import STRAIN_DEPLOYED
from ctr_nlp.robot.tube import DIAMETERS, STRAIN_MADE
from ctr_nlp.support.values import instance, number

SOLD_RATIO = 1.1, 1.8
"""Between what outer diameters are as parts of inner ones where Nitinol tubing is sold (Johnson Matthey, Nitinol
specification guidelines, matthey.com)."""
DIAMETERS_WITHIN = (
    (0.3, 0.005, 0.010),
    (0.5, 0.007, 0.015),
    (1.5, 0.015, 0.020),
    (2.5, 0.020, 0.030),
    (3.5, 0.020, 0.040),
    (5.0, 0.030, 0.050),
    (math.inf, 0.050, 0.050),
)
"""Up to what outer diameter Nitinol tubing is sold with what tolerances of the outer and the inner one, +- mm
(Lumenous, Nitinol tube, lumenous.com/nitinol-tube: the first of its two tables)."""


@dataclass(frozen=True)
class Manufacture:
    """Rules that designed tubes keep; lengths in mm, strains as parts.

    strain_made: of a tube's outer fibre when it is bent into its pre-curvature; strain_deployed: of the aligned
    robot's tubes, each against its own pre-curvature (robot/strain.py). clearance: by how much the inner diameter
    of a tube exceeds the outer diameter of the next. wall: least thickness. channel: least inner diameter of the
    innermost tube. outer: largest outer diameter. bend_radius: the least of any tube's pre-curvature. one_sided:
    whether no tube is shaped like an S. Raises OptionError.
    """

    strain_made: float = 0.04
    strain_deployed: float = STRAIN_DEPLOYED
    clearance: float = 0.1
    wall: float = 0.15
    channel: float = 1.0
    outer: float = 5.7
    bend_radius: float = 10.0
    one_sided: bool = False

    def __post_init__(self) -> None:
        most = {
            "strain_made": STRAIN_MADE,
            "strain_deployed": STRAIN_DEPLOYED,
            **dict.fromkeys(("clearance", "wall", "channel", "outer"), DIAMETERS[1]),
            "bend_radius": 10_000.0,
        }
        for name, high in most.items():
            allowed = f"be more than 0 and at most {high:g}"
            given = getattr(self, name)
            value = number(OptionError, f"{name} of manufacture", given, partial(_within, high), allowed)
            object.__setattr__(self, name, value)
        instance(OptionError, "one_sided of manufacture", self.one_sided, bool)

    def check_tubes(self, d: int) -> None:
        """Raise OptionError where the thinnest d tubes that can be nested exceed the largest diameter."""
        least = self.channel + 2 * d * self.wall + (d - 1) * self.clearance
        if least > self.outer:
            raise OptionError(
                f"{d} nested tubes with walls of {self.wall:g} mm around a channel of {self.channel:g} mm are at "
                f"least {least:.3g} mm thick, and outer of manufacture is {self.outer:g} mm; "
                "allow a smaller channel, a thinner wall or a larger outer diameter"
            )


def diameters_within(outer: float) -> tuple[float, float]:
    """The tolerances, +- mm, of the outer and the inner diameter of tubing sold with this outer diameter, mm."""
    return next((each, inner) for most, each, inner in DIAMETERS_WITHIN if outer <= most)


def _within(high: float, value: float) -> bool:
    return 0 < value <= high
