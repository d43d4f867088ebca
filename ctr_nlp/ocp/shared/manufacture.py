"""Rules of manufacture: what can be made of nitinol tubing, which a designed robot must satisfy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

from ctr_nlp.exceptions import OptionError
from ctr_nlp.robot.strain import MAX_DEPLOYED_STRAIN
from ctr_nlp.robot.tube import MAX_PRE_CURVATURE_STRAIN, TUBE_DIAMETER_RANGE_MM
from ctr_nlp.support.value_checks import check_instance, number

TUBING_DIAMETER_RATIOS = 1.1, 1.8
"""Ratios of outer to inner diameter between which nitinol tubing is sold (Johnson Matthey, Nitinol specification
guidelines, matthey.com).
"""
TUBING_DIAMETER_TOLERANCES_MM = (
    (0.3, 0.005, 0.010),
    (0.5, 0.007, 0.015),
    (1.5, 0.015, 0.020),
    (2.5, 0.020, 0.030),
    (3.5, 0.020, 0.040),
    (5.0, 0.030, 0.050),
    (math.inf, 0.050, 0.050),
)
"""Largest outer diameter, mm, and the tolerances +- mm of the outer and the inner one with which tubing up to it
is sold (Lumenous, Nitinol tube, lumenous.com/nitinol-tube: the first of its two tables).
"""


@dataclass(frozen=True)
class Manufacture:
    """Rules of manufacture that designed tubes satisfy.

    Attributes
    ----------
    strain_made : float
        Largest strain of a tube's outer fibre when it is bent into its pre-curvature, curvature * outer_diameter /
        2, as a part.
    strain_deployed : float
        Largest strain of the aligned robot's tubes, each against its own pre-curvature (robot/strain.py), as a
        part.
    clearance : float
        Least difference between the inner diameter of a tube and the outer diameter of the next one, mm.
    wall : float
        Least wall thickness, mm.
    channel : float
        Least inner diameter of the innermost tube, mm.
    outer : float
        Largest outer diameter, mm.
    bend_radius : float
        Least radius of any tube's pre-curvature, mm.
    one_sided : bool
        Whether tubes shaped like an S are excluded.

    Raises
    ------
    OptionError
        A rule is not positive, or exceeds what any tube can have.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> rules = ctr.Manufacture(channel=0.5, outer=2.5)
    >>> rules.check_tubes(3)
    """

    strain_made: float = 0.04
    strain_deployed: float = MAX_DEPLOYED_STRAIN
    clearance: float = 0.1
    wall: float = 0.15
    channel: float = 1.0
    outer: float = 5.7
    bend_radius: float = 10.0
    one_sided: bool = False

    def __post_init__(self) -> None:
        # More strain than that breaks tubing of Nitinol. No wall, gap or channel is wider than the thickest tube
        # that can be had.
        most = {
            "strain_made": MAX_PRE_CURVATURE_STRAIN,
            "strain_deployed": MAX_DEPLOYED_STRAIN,
            **dict.fromkeys(("clearance", "wall", "channel", "outer"), TUBE_DIAMETER_RANGE_MM[1]),
            "bend_radius": 10_000.0,
        }
        for name, high in most.items():
            allowed = f"be more than 0 and at most {high:g}"
            given = getattr(self, name)
            value = number(
                OptionError, f"{name} of manufacture", given, partial(_is_positive_up_to, high), allowed
            )
            # The class is frozen; what was given as an integer or as text is kept as a number.
            object.__setattr__(self, name, value)
        check_instance(OptionError, "one_sided of manufacture", self.one_sided, bool)

    def check_tubes(self, d: int) -> None:
        """Check that so many tubes can be nested within the rules.

        Parameters
        ----------
        d : int
            Number of tubes.

        Raises
        ------
        OptionError
            The thinnest d tubes that nest exceed the largest diameter.
        """
        # From the inside: the channel, two walls of each tube, and a clearance (of diameters) between neighbours.
        least = self.channel + 2 * d * self.wall + (d - 1) * self.clearance
        if least > self.outer:
            raise OptionError(
                f"{d} nested tubes with walls of {self.wall:g} mm around a channel of {self.channel:g} mm are at "
                f"least {least:.3g} mm thick, and outer of manufacture is {self.outer:g} mm; "
                "allow a smaller channel, a thinner wall or a larger outer diameter"
            )


def diameter_tolerances(outer: float) -> tuple[float, float]:
    """Return the tolerances with which tubing of an outer diameter is sold.

    Parameters
    ----------
    outer : float
        Outer diameter, mm.

    Returns
    -------
    tuple of (float, float)
        Tolerances of the outer and of the inner diameter, +- mm.
    """
    return next((each, inner) for most, each, inner in TUBING_DIAMETER_TOLERANCES_MM if outer <= most)


def _is_positive_up_to(high: float, value: float) -> bool:
    """Return whether a value is positive and at most `high`."""
    return 0 < value <= high
