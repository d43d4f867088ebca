"""How far tubes that share one curve are bent away from their own pre-curvature.

Where all tubes are turned alike, none twists another, and the balance of moments leaves them one curvature: the
mean of their pre-curvatures, weighted with their bending stiffnesses (Dupont, Lock, Itkowitz, Butler, Design and
control of concentric-tube robots, IEEE Transactions on Robotics 26(2), 2010). Its own shape being the one in which
a tube is free of strain, its outer fibre is then strained by outer_diameter / 2 * |its own curvature - that one|.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.tube import Tube

STRAIN_DEPLOYED = 0.06
"""Largest strain of a tube's outer fibre, relative to its own pre-curved shape, by the other tubes."""
INSIDE, SHORTEST = 1e-9, 1e-6
"""mm from the ends of a piece at which its strains are looked at, and of the shortest piece that counts: a shorter
one is what rounding leaves between tubes that end together."""


class Strain(NamedTuple):
    """tube: which, from 1. place: arc length, mm. own, common: its pre-curvature, and the robot's, 1/mm."""

    tube: int
    place: float
    own: float
    common: float
    strain: float


def check_deployed(tubes: Sequence[Tube], beta: Sequence[float]) -> None:
    """Raise RobotError where a tube of the aligned robot at beta (d,) mm is strained by more than 6 %.

    6 % is the strain to which superelastic nitinol is loaded, and from which it must come back, where its
    plateaus are measured (ASTM F2516).
    """
    worst = largest_strain(tubes, beta)
    if worst is not None and worst.strain > STRAIN_DEPLOYED * (1 + 1e-9):
        raise RobotError(
            f"tube {worst.tube} is strained by {100 * worst.strain:.3g} % at {worst.place:.1f} mm of the aligned, "
            f"deployed robot, and nitinol bears {100 * STRAIN_DEPLOYED:g} % there: its own curvature is "
            f"{worst.own:.4g} per mm, that of all tubes together {worst.common:.4g}, its outer_diameter "
            f"{tubes[worst.tube - 1].outer_diameter:g} mm. The curvatures must be closer to each other"
        )


def largest_strain(tubes: Sequence[Tube], beta: Sequence[float]) -> Strain | None:
    """Where a tube of the aligned robot at beta (d,) mm is strained most; None where nothing is deployed."""
    starts = [max(b - tube.curved_length, 0.0) for tube, b in zip(tubes, beta, strict=True)]
    edges = sorted({0.0, *beta, *(start for start, b in zip(starts, beta, strict=True) if start < b)})
    pieces = [(a, b) for a, b in itertools.pairwise(edges) if b - a > SHORTEST]
    places = [place for a, b in pieces for place in (a + INSIDE, b - INSIDE)]
    found = [strain for place in places for strain in _strains(tubes, beta, place)]
    return max(found, key=lambda one: one.strain, default=None)


def _strains(tubes: Sequence[Tube], beta: Sequence[float], s: float) -> list[Strain]:
    """Of all tubes that reach beyond s mm."""
    there = [
        (i, tube, pre_curvature(tube, b - s)) for i, (tube, b) in enumerate(zip(tubes, beta, strict=True)) if b > s
    ]
    stiffness = sum(tube.bending_stiffness for _, tube, _ in there)
    common = sum(tube.bending_stiffness * own for _, tube, own in there) / stiffness
    return [Strain(i + 1, s, own, common, tube.outer_diameter / 2 * abs(own - common)) for i, tube, own in there]


def pre_curvature(tube: Tube, from_tip: float) -> float:
    """Of a tube at a distance from its tip in mm, 1/mm: 0 along its transmission."""
    if from_tip > tube.curved_length:
        return 0.0
    part = from_tip / tube.curved_length if tube.curved_length else 0.0
    return tube.tip_curvature + part * (tube.root_curvature - tube.tip_curvature)
