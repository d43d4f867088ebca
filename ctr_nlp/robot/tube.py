"""One tube: its numbers, checked against the strain of its material and against mistakes of units."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.units import between, did_you_mean, suggest_curvature, suggest_length
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_checks import numbers

MAX_PRE_CURVATURE_STRAIN = 0.08
"""Largest strain of a tube's outer fibre by its pre-curvature."""
MAX_TUBE_CURVATURE_PER_MM = 0.5
"""Largest curvature of any tube, 1/mm: a radius of 2 mm, to which nitinol can be bent up to 0.32 mm thick."""
TUBE_LENGTH_RANGE_MM = (1.0, 10_000.0)
"""Shortest and longest tube, mm. What is shorter was likely written in metres, what is longer in micrometres."""
MAX_HELIX_TURN_RAD = 40.0
"""Largest angle by which the direction of a helix's curvature turns along its curved part, rad: six turns.
Programs grow with every turn, and a number beyond it was likely written in degrees.
"""
MAX_STRAIN_LIMIT = 0.5
"""Largest strain limit of a material: what is larger was likely written in percent."""
TUBE_DIAMETER_RANGE_MM = (0.1, 100.0)
"""Least and largest outer diameter, mm."""


@packable("tube")
@dataclass(frozen=True)
class Tube:
    """One pre-curved tube: a straight transmission, then a curved part that ends at its tip.

    Bent into its pre-curvature, a straight tube is strained by curvature * outer_diameter / 2 at its outer fibre,
    and again wherever the tubes around it or its own carriage hold it straight. More than 8 % is refused, the
    strain up to which nitinol recovers (Duerig, Pelton, Stoeckel, An overview of nitinol medical applications,
    Materials Science and Engineering A 273-275, 1999), unless the tube has a `max_strain` of its own. However thin
    the tube, its curvature is at most 0.5 per mm, its outer diameter 0.1 to 100 mm and its length 1 to 10,000 mm:
    beyond these a number was likely written in another unit, which the message names.

    Attributes
    ----------
    length : float
        L, the whole tube from its carriage to its tip, mm.
    curved_length : float
        Length of the curved part behind the tip, mm; the rest is straight.
    curvature : float or (float, float)
        Pre-curvature k, 1/mm: constant, or at the root and at the tip of the curved part and linear in arc length
        between them. It is not negative, but at the root of a tube shaped like an S, which is bent there to the
        other side than at its tip.
    outer_diameter, inner_diameter : float
        Diameters, mm.
    poisson_ratio : float
        Poisson's ratio nu, in (-1, 0.5].
    youngs_modulus : float
        Young's modulus E, MPa. Without a load any unit will do, since only ratios between tubes matter then.
    pre_torsion : float
        Angle by which the direction in which the curved part bends turns along it, rad/mm. One curvature and a
        torsion make a helix, right-handed where the torsion is positive.
    max_strain : float or None
        Largest strain of a material other than nitinol, as a part (0.17 is 17 %), by the pre-curvature and by the
        other tubes of a deployed robot; None for those of nitinol, 8 % and 6 %.

    Raises
    ------
    RobotError
        No tube can have these numbers.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> tube = ctr.Tube(202, 107, 1 / 60, outer_diameter=3.7, inner_diameter=2.9, youngs_modulus=60_000)
    >>> round(tube.bending_stiffness)
    343675
    >>> ctr.Tube(0.2, 0.1, 1 / 60, outer_diameter=3.7, inner_diameter=2.9)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    ctr_nlp.exceptions.RobotError: tube length is 0.2 mm; ... did you mean 200 mm (0.2 m)?
    """

    length: float
    curved_length: float
    curvature: float | tuple[float, float]
    outer_diameter: float
    inner_diameter: float
    poisson_ratio: float = 0.3
    youngs_modulus: float = 1.0
    pre_torsion: float = 0.0
    max_strain: float | None = None

    def __repr__(self) -> str:
        # Without a strain limit as before there was one: digests of hardware are made of this text.
        entries = [f"{f.name}={getattr(self, f.name)!r}" for f in fields(self)]
        return f"Tube({', '.join(entry for entry in entries if entry != 'max_strain=None')})"

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name == "curvature":
                pair = tuple(numbers(f.name, value, 2).tolist())
                # Equal ends are one number: an arc is another structure than a curved part of linear curvature.
                object.__setattr__(self, "curvature", pair[0] if pair[0] == pair[1] else pair)
            elif f.name != "max_strain" or value is not None:
                object.__setattr__(self, f.name, float(numbers(f.name, value, 1)[0]))
        self._check_lengths()
        self._check_diameters()
        self._check_max_strain()
        self._check_curvature()
        self._check_torsion()
        if not -1 < self.poisson_ratio <= 0.5:
            raise RobotError(f"tube poisson_ratio is {self.poisson_ratio:g}; it must lie in (-1, 0.5]")
        if self.youngs_modulus <= 0:
            raise RobotError(f"tube youngs_modulus is {self.youngs_modulus:g}; it must be positive")

    def _check_lengths(self) -> None:
        """Raise RobotError unless the length is positive and likely in mm, and the curved part fits into it."""
        if self.length <= 0:
            raise RobotError(f"tube length is {self.length:g} mm; it must be positive")
        _check_unit("length", self.length, TUBE_LENGTH_RANGE_MM)
        if not 0 <= self.curved_length <= self.length:
            raise RobotError(
                f"tube curved_length is {self.curved_length:g} mm; it must lie in [0, length = {self.length:g}]"
            )
        if self.curved_length:
            _check_unit("curved_length", self.curved_length, TUBE_LENGTH_RANGE_MM)

    def _check_diameters(self) -> None:
        """Raise RobotError unless the diameters leave a wall and are likely in mm."""
        if not 0 <= self.inner_diameter < self.outer_diameter:
            exchanged = 0 < self.outer_diameter < self.inner_diameter
            raise RobotError(
                f"tube inner_diameter is {self.inner_diameter:g} mm; it must lie in "
                f"[0, outer_diameter = {self.outer_diameter:g})"
                + "; are the two diameters exchanged, or in different units?"
                * exchanged
            )
        _check_unit("outer_diameter", self.outer_diameter, TUBE_DIAMETER_RANGE_MM)

    def _check_max_strain(self) -> None:
        """Raise RobotError unless the strain limit, if any, is one that a material can have."""
        limit = self.max_strain
        if limit is not None and not 0 < limit <= MAX_STRAIN_LIMIT:
            percent = limit / 100
            meant = [f"{percent:g} ({limit:g} %)"] if 0 < percent <= MAX_STRAIN_LIMIT else []
            raise RobotError(
                f"tube max_strain is {limit:g}; it must lie in (0, {MAX_STRAIN_LIMIT:g}], as a part"
                f"{did_you_mean(meant)}"
            )

    def _check_curvature(self) -> None:
        """Raise RobotError unless the curvature has a valid sign and strains the tube by at most what it bears."""
        # A sign would say the same as a turn by pi. Only an S has two sides, and it is described with the tip's
        # side positive.
        if self.tip_curvature < 0 or self.root_curvature < 0 == self.tip_curvature:
            shaped = "; at the root alone it may be negative, of a tube that is bent the other way at its tip"
            what = f"it is unsigned (turn the tube instead){shaped if isinstance(self.curvature, tuple) else ''}"
            raise RobotError(f"tube curvature is {self.curvature}; {what}")
        # The strain k D / 2, solved for k.
        largest = self.largest_curvature
        limit = self.pre_curvature_strain_limit
        most = min(MAX_TUBE_CURVATURE_PER_MM, 2 * limit / self.outer_diameter)
        if largest > MAX_TUBE_CURVATURE_PER_MM:
            meant = suggest_curvature(largest, between(0, most))
            raise RobotError(
                f"tube curvature {largest:g} per mm is a radius of {1 / largest:.2g} mm; it must be at most "
                f"{most:.3g} per mm{did_you_mean(meant)}"
            )
        strain = largest * self.outer_diameter / 2
        if strain > limit * (1 + 1e-9):
            material = "nitinol" if self.max_strain is None else "its max_strain"
            raise RobotError(
                f"tube curvature is {largest:g} per mm, a radius of {1 / largest:.3g} mm, and outer_diameter "
                f"{self.outer_diameter:g} mm: the tube is strained by {100 * strain:.3g} %, and {material} "
                f"allows {100 * limit:g} %; the curvature must be at most {most:.3g} per mm"
                f"{self.other_material_hint}"
            )

    def _check_torsion(self) -> None:
        """Raise RobotError unless a torsion belongs to a curved part of one curvature and is likely in rad/mm."""
        if self.pre_torsion == 0:
            return
        if isinstance(self.curvature, tuple) or self.curvature == 0 or self.curved_length == 0:
            raise RobotError(
                f"tube pre_torsion is {self.pre_torsion:g} rad/mm, and curvature {self.curvature} along "
                f"{self.curved_length:g} mm; a helix has one curvature, and neither is 0"
            )
        most = MAX_HELIX_TURN_RAD / self.curved_length
        if not abs(self.pre_torsion) <= most:
            radians = math.radians(self.pre_torsion)
            meant = [f"{radians:.3g} rad/mm ({self.pre_torsion:g} degrees)"] if abs(radians) <= most else []
            raise RobotError(
                f"tube pre_torsion is {self.pre_torsion:g} rad/mm, and the curved part is "
                f"{self.curved_length:g} mm long; it must lie in [{-most:.3g}, {most:.3g}] rad/mm, so that the "
                f"curvature turns by {MAX_HELIX_TURN_RAD:g} rad along it at most{did_you_mean(meant)}"
            )

    @property
    def root_curvature(self) -> float:
        """Curvature where the curved part begins, 1/mm."""
        return self.curvature[0] if isinstance(self.curvature, tuple) else self.curvature

    @property
    def tip_curvature(self) -> float:
        """Curvature at the tip, 1/mm."""
        return self.curvature[1] if isinstance(self.curvature, tuple) else self.curvature

    @property
    def largest_curvature(self) -> float:
        """Larger absolute curvature of root and tip, 1/mm."""
        return max(abs(self.root_curvature), self.tip_curvature)

    @property
    def is_straight(self) -> bool:
        """Whether the tube has no pre-curvature."""
        return self.largest_curvature == 0

    @property
    def usual_extension(self) -> float:
        """Upper limit of beta where none is given, mm: the curved part, or the whole length of a straight tube."""
        return self.length if self.is_straight else self.curved_length

    @property
    def pre_curvature_strain_limit(self) -> float:
        """Largest strain of the outer fibre by the tube's pre-curvature, as a part."""
        return MAX_PRE_CURVATURE_STRAIN if self.max_strain is None else self.max_strain

    @property
    def other_material_hint(self) -> str:
        """End of a message on the strain of nitinol: how to describe another material; empty where one is."""
        return "; for a tube of another material give max_strain" if self.max_strain is None else ""

    @property
    def area(self) -> float:
        """Area of the material in a cross-section, mm^2."""
        return math.pi / 4 * (self.outer_diameter**2 - self.inner_diameter**2)

    @property
    def bending_stiffness(self) -> float:
        """Bending stiffness EI, in units of youngs_modulus x mm^4: N mm^2 where that is in MPa."""
        # Second moment of area of a ring, pi (D^4 - d^4) / 64.
        return self.youngs_modulus * math.pi / 64 * (self.outer_diameter**4 - self.inner_diameter**4)

    @property
    def stiffness_slopes(self) -> tuple[float, float]:
        """Relative growth of the bending stiffness with the outer and with the inner diameter, 1/mm."""
        # d log(D^4 - d^4) / dD and / dd.
        outer = self.outer_diameter
        inner = self.inner_diameter
        return 4 * outer**3 / (outer**4 - inner**4), -4 * inner**3 / (outer**4 - inner**4)


def _check_unit(name: str, value: float, allowed: tuple[float, float]) -> None:
    """Raise RobotError where a length in mm lies outside `allowed`, with the unit that it was likely
    written in.
    """
    low, high = allowed
    if not low <= value <= high:
        meant = suggest_length(value, between(low, high))
        raise RobotError(
            f"tube {name} is {value:g} mm; it must lie in [{low:g}, {high:g}] mm{did_you_mean(meant)}"
        )
