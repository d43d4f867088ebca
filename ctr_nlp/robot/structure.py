"""Structure of a robot, for which programs are compiled, and the numbers of its tubes, which are their parameters.

Programs depend on the structure as code and on the numbers as parameters, so that robots that differ in numbers
alone (perturbed robots, designed tubes) share every compiled program.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from ctr_nlp.robot.tube import Tube

Kind = Literal["straight", "arc", "linear", "helix"]
"""Kind of a tube's curved part: without curvature, of one curvature, with a curvature that is linear in arc
length, or of one curvature whose direction turns.
"""
HELIX_TURN_PER_PIECE_RAD = 2.0
"""Largest angle, rad, by which a helix's curvature turns along a piece that is integrated in a few steps."""


@dataclass(frozen=True)
class Structure:
    """The part of a robot for which programs are compiled; robots that differ in numbers alone have the same
    structure.

    Attributes
    ----------
    kinds : tuple of str
        Kinds of the tubes' curved parts, outermost first.
    transmission_emerges : tuple of bool
        Which tubes can be extended so far that their straight transmissions come out of the insertion point.
    gap : bool
        Whether a least distance between carriages is a constraint.
    pieces : tuple of int
        In how many pieces sections with each tube are integrated; empty where every one is a single piece.
    """

    kinds: tuple[Kind, ...]
    transmission_emerges: tuple[bool, ...]
    gap: bool = False
    pieces: tuple[int, ...] = ()

    @property
    def d(self) -> int:
        """Number of tubes."""
        return len(self.kinds)


class TubeNumbers(NamedTuple):
    """Numbers of one tube as models take them: floats, columns (T, 1) for a batch of T robots, or symbols.

    Attributes
    ----------
    kind : str
        Kind of its curved part.
    transmission_emerges : bool
        Whether its straight transmission can come out.
    pieces : int
        In how many pieces a section with this tube is integrated: more than one for a helix of several turns.
    length, curved_length : Any
        Lengths, mm.
    root_curvature, tip_curvature : Any
        Pre-curvature at both ends of the curved part, 1/mm; equal unless `kind` is ``"linear"``.
    bending_stiffness : Any
        EI, in any unit without a load, else N mm^2.
    torsional_ratio : Any
        EI / GJ, which is 1 + Poisson's ratio.
    pre_torsion : Any
        Torsion of a helix, rad/mm.
    area : Any
        Area of the material in a cross-section, mm^2, for the tube's own weight.
    """

    kind: Kind
    transmission_emerges: bool
    pieces: int
    length: Any
    curved_length: Any
    root_curvature: Any
    tip_curvature: Any
    bending_stiffness: Any
    torsional_ratio: Any
    pre_torsion: Any
    area: Any

    @property
    def slope(self) -> Any:
        """Growth of the pre-curvature from the tip to the root, 1/mm^2."""
        return (self.root_curvature - self.tip_curvature) / self.curved_length if self.kind == "linear" else 0.0

    @property
    def spin(self) -> Any:
        """Angle by which the direction of the pre-curvature turns per length along the tube, rad/mm."""
        return self.pre_torsion if self.kind == "helix" else 0.0


Tubes = Sequence[TubeNumbers]
"""The tubes of a robot, outermost first."""

TUBE_NUMBER_NAMES = TubeNumbers._fields[3:]
"""Names of a tube's numbers, in the order in which programs take them as parameters."""


def tubes_of(structure: Structure, numbers: Sequence[Sequence[Any]]) -> tuple[TubeNumbers, ...]:
    """Return the tubes of a structure with given numbers.

    Parameters
    ----------
    structure : Structure
        Of d tubes.
    numbers : sequence of sequences
        For each tube its eight numbers, in the order of `TUBE_NUMBER_NAMES`; floats, arrays or symbols.

    Returns
    -------
    tuple of TubeNumbers
        Outermost first.
    """
    pieces = structure.pieces or (1,) * structure.d
    rows = zip(structure.kinds, structure.transmission_emerges, pieces, numbers, strict=True)
    return tuple(TubeNumbers(kind, shown, count, *row) for kind, shown, count, row in rows)


def structure_of(tubes: Tubes) -> Structure:
    """Return the structure of tubes, without a least distance between carriages."""
    pieces = tuple(tube.pieces for tube in tubes)
    return Structure(
        tuple(tube.kind for tube in tubes),
        tuple(tube.transmission_emerges for tube in tubes),
        pieces=pieces if any(count > 1 for count in pieces) else (),
    )


def tubes_of_batch(structure: Structure, numbers: Any) -> tuple[TubeNumbers, ...]:
    """Return the tubes of a batch of robots of one structure.

    Parameters
    ----------
    structure : Structure
        Of d tubes.
    numbers : ndarray
        Numbers (T, d, 8) of T robots.

    Returns
    -------
    tuple of TubeNumbers
        Each number a column (T, 1), which broadcasts against samples along the robots (T, n).
    """
    # (T, d, 8) becomes (d, 8, T, 1): tubes, then numbers, each a column.
    return tubes_of(structure, [list(tube) for tube in numbers.transpose(1, 2, 0)[..., None]])


def locate_free_numbers(
    structure: Structure, free_names: Sequence[str]
) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Find the numbers of tubes that are unknowns of a program.

    Parameters
    ----------
    structure : Structure
        Of d tubes.
    free_names : sequence of str
        Names among `TUBE_NUMBER_NAMES`, or ``"curvature"``: one number of an arc or a helix, two of a linear part,
        none of a straight one.

    Returns
    -------
    tuple of (int, tuple of int)
        For each unknown its tube, from 0, and its columns in `TUBE_NUMBER_NAMES`: two for a curvature that root
        and tip share.
    """
    root = TUBE_NUMBER_NAMES.index("root_curvature")
    tip = TUBE_NUMBER_NAMES.index("tip_curvature")
    curvatures = {"straight": (), "arc": ((root, tip),), "linear": ((root,), (tip,)), "helix": ((root, tip),)}
    found = list[tuple[int, tuple[int, ...]]]()
    for name in free_names:
        for i, kind in enumerate(structure.kinds):
            columns = curvatures[kind] if name == "curvature" else ((TUBE_NUMBER_NAMES.index(name),),)
            found += [(i, each) for each in columns]
    return tuple(found)


def numbers_of(tubes: Iterable[Tube]) -> list[list[float]]:
    """Return the numbers of `tubes` as lists of eight floats, in the order of `TUBE_NUMBER_NAMES`."""
    return [
        [
            tube.length,
            tube.curved_length,
            tube.root_curvature,
            tube.tip_curvature,
            tube.bending_stiffness,
            1 + tube.poisson_ratio,
            tube.pre_torsion,
            tube.area,
        ]
        for tube in tubes
    ]


def kind_of(tube: Tube) -> Kind:
    """Return the kind of the curved part of `tube`."""
    if tube.largest_curvature == 0:
        return "straight"
    if tube.pre_torsion != 0:
        return "helix"
    # Without a curved part there is nothing along which the curvature could change.
    return "linear" if tube.root_curvature != tube.tip_curvature and tube.curved_length else "arc"


def helix_pieces(tubes: Iterable[Tube]) -> tuple[int, ...]:
    """Return in how many pieces sections with each of `tubes` are integrated; empty where each is one piece."""
    found = tuple(_count_pieces(abs(tube.pre_torsion) * tube.curved_length) for tube in tubes)
    return found if any(count > 1 for count in found) else ()


def _count_pieces(turn: float) -> int:
    """Return the number of pieces of a curved part along which the direction of curvature turns by `turn` rad."""
    # The tolerance keeps a helix of exactly 2 rad, computed as a product, in one piece.
    return max(1, math.ceil(turn / HELIX_TURN_PER_PIECE_RAD - 1e-9))
