"""Strain of aligned tubes: how far tubes that share one curve are bent away from their own pre-curvature.

Where all tubes are turned alike, none twists another, and the balance of moments leaves them one curvature: the
mean of their pre-curvatures k_i, weighted with their bending stiffnesses EI_i (Dupont, Lock, Itkowitz, Butler,
Design and control of concentric-tube robots, IEEE Transactions on Robotics 26(2), 2010),

    k = sum_j EI_j k_j / sum_j EI_j.

A tube is free of strain in its own pre-curved shape, so that its outer fibre is then strained by D_i / 2 |k_i -
k|, where D_i is its outer diameter.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.tube import Tube

MAX_DEPLOYED_STRAIN = 0.06
"""Largest strain of a tube's outer fibre, relative to its own pre-curved shape, by the other tubes."""
STRAIN_EDGE_OFFSET_MM, MIN_STRAIN_PIECE_MM = 1e-9, 1e-6
"""Distance from the ends of a piece at which strains are evaluated, mm, and the shortest piece that counts, mm: a
shorter one is what rounding leaves between tubes that end together.
"""


class Strain(NamedTuple):
    """Strain of one tube at one place of the aligned robot.

    Attributes
    ----------
    tube : int
        Its number, from 1.
    place : float
        Arc length from the insertion point, mm.
    own, common : float
        Its pre-curvature there, and the curvature that all tubes share, 1/mm.
    strain : float
        Strain of its outer fibre, as a part (0.06 is 6 %).
    """

    tube: int
    place: float
    own: float
    common: float
    strain: float


def check_deployed(tubes: Sequence[Tube], beta: Sequence[float]) -> None:
    """Check that no tube of the aligned robot is strained by more than 6 %, or its own max_strain.

    In the standard test of superelastic nitinol (ASTM F2516) specimens are loaded to a strain of 6 %, from which
    they must recover.

    Parameters
    ----------
    tubes : sequence of Tube
        The d tubes, outermost first.
    beta : sequence of float
        Their extensions (d,), mm.

    Raises
    ------
    RobotError
        A tube is strained by more.
    """
    allowed = [MAX_DEPLOYED_STRAIN if tube.max_strain is None else tube.max_strain for tube in tubes]
    found = strains(tubes, beta)
    worst = max(found, key=lambda one: one.strain / allowed[one.tube - 1], default=None)
    if worst is not None and worst.strain > allowed[worst.tube - 1] * (1 + 1e-9):
        tube = tubes[worst.tube - 1]
        material = "nitinol" if tube.max_strain is None else "its max_strain"
        raise RobotError(
            f"tube {worst.tube} is strained by {100 * worst.strain:.3g} % at {worst.place:.1f} mm of the aligned, "
            f"deployed robot, and {material} allows {100 * allowed[worst.tube - 1]:g} % there: its own curvature "
            f"is {worst.own:.4g} per mm, that of all tubes together {worst.common:.4g}, its outer_diameter "
            f"{tube.outer_diameter:g} mm. The curvatures must be closer to each other{tube.other_material_hint}"
        )


def largest_strain(tubes: Sequence[Tube], beta: Sequence[float]) -> Strain | None:
    """Find where a tube of the aligned robot is strained most.

    Parameters
    ----------
    tubes : sequence of Tube
        The d tubes, outermost first.
    beta : sequence of float
        Their extensions (d,), mm.

    Returns
    -------
    Strain or None
        The largest strain; None where nothing is deployed.
    """
    return max(strains(tubes, beta), key=lambda one: one.strain, default=None)


def strains(tubes: Sequence[Tube], beta: Sequence[float]) -> list[Strain]:
    """Return the strains of all tubes of the aligned robot where they can be largest.

    Parameters
    ----------
    tubes : sequence of Tube
        The d tubes, outermost first.
    beta : sequence of float
        Their extensions (d,), mm.

    Returns
    -------
    list of Strain
        From the insertion point to the tip; empty where nothing is deployed.
    """
    # Between these edges the same tubes are present, and pre-curvatures are linear in arc length. The strain is
    # then the absolute value of a linear function, which is largest at an end of the piece.
    starts = [max(b - tube.curved_length, 0.0) for tube, b in zip(tubes, beta, strict=True)]
    edges = sorted({0.0, *beta, *(start for start, b in zip(starts, beta, strict=True) if start < b)})
    pieces = [(a, b) for a, b in itertools.pairwise(edges) if b - a > MIN_STRAIN_PIECE_MM]
    places = [place for a, b in pieces for place in (a + STRAIN_EDGE_OFFSET_MM, b - STRAIN_EDGE_OFFSET_MM)]
    # Just inside of each piece, where it is clear which tubes are present.
    return [strain for place in places for strain in _strains(tubes, beta, place)]


def _strains(tubes: Sequence[Tube], beta: Sequence[float], s: float) -> list[Strain]:
    """Return the strains of all tubes that reach beyond arc length s, mm."""
    there = [
        (i, tube, pre_curvature(tube, b - s)) for i, (tube, b) in enumerate(zip(tubes, beta, strict=True)) if b > s
    ]
    # The mean curvature of the tubes that are present at s, weighted with EI: the equation at the top of this
    # file.
    stiffness = sum(tube.bending_stiffness for _, tube, _ in there)
    common = sum(tube.bending_stiffness * own for _, tube, own in there) / stiffness
    return [Strain(i + 1, s, own, common, tube.outer_diameter / 2 * abs(own - common)) for i, tube, own in there]


def pre_curvature(tube: Tube, from_tip: float) -> float:
    """Return the pre-curvature of a tube at a distance from its tip.

    Parameters
    ----------
    tube : Tube
        The tube.
    from_tip : float
        Distance from its tip along it, mm.

    Returns
    -------
    float
        1/mm; linear along the curved part, and 0 along the straight transmission.
    """
    if from_tip > tube.curved_length:
        return 0.0
    part = from_tip / tube.curved_length if tube.curved_length else 0.0
    return tube.tip_curvature + part * (tube.root_curvature - tube.tip_curvature)
