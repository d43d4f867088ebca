"""What of a robot must be compiled, and the numbers of its tubes, which are parameters of every program."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from ctr_nlp.robot.tube import Tube

Kind = Literal["straight", "arc", "linear", "helix"]
"""Of a tube's curved part: without curvature, of one curvature, with one that is linear in arc length, or of one
curvature whose direction turns."""


@dataclass(frozen=True)
class Structure:
    """What must be compiled for a robot: robots that differ in numbers alone share every compiled program.

    kinds: of the tubes' curved parts, outermost first. shown: which tubes can be pushed out so far that their
    straight transmissions show. gap: whether carriages keep a least distance.
    """

    kinds: tuple[Kind, ...]
    shown: tuple[bool, ...]
    gap: bool = False

    @property
    def d(self) -> int:
        """Number of tubes."""
        return len(self.kinds)


class TubeNumbers(NamedTuple):
    """One tube as models take it: numbers, columns of numbers (T, 1) for T robots at once, or symbols.

    length, curved_length: mm. root_curvature, tip_curvature: 1/mm, equal unless kind is linear.
    bending_stiffness: EI, in any unit. torsional_ratio: EI / GJ = 1 + Poisson's ratio. pre_torsion: rad/mm.
    area: of the material in a cross-section, mm^2, by which a tube weighs.
    """

    kind: Kind
    shown: bool
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
        """By how much the direction of the pre-curvature turns along the tube, rad/mm."""
        return self.pre_torsion if self.kind == "helix" else 0.0


Tubes = Sequence[TubeNumbers]
"""The tubes of a robot, outermost first."""

NUMBERS = TubeNumbers._fields[2:]
"""The names of a tube's numbers, in the order in which programs take them as parameters."""


def tubes_of(structure: Structure, numbers: Sequence[Sequence[Any]]) -> tuple[TubeNumbers, ...]:
    """The tubes of a structure whose numbers are given tube by tube, in the order of NUMBERS."""
    rows = zip(structure.kinds, structure.shown, numbers, strict=True)
    return tuple(TubeNumbers(kind, shown, *row) for kind, shown, row in rows)


def tubes_in_columns(structure: Structure, numbers: Any) -> tuple[TubeNumbers, ...]:
    """The tubes of robots that differ in numbers (T, d, 8), as columns (T, 1)."""
    return tubes_of(structure, [list(tube) for tube in numbers.transpose(1, 2, 0)[..., None]])


def freed_places(structure: Structure, freed: Sequence[str]) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """What tubes have of numbers that are free: for each unknown its tube, from 0, and its columns in NUMBERS.

    freed: of NUMBERS, or curvature: one number of an arc or a helix, the two of a part with a linear one.
    """
    root, tip = NUMBERS.index("root_curvature"), NUMBERS.index("tip_curvature")
    curvatures = {"straight": (), "arc": ((root, tip),), "linear": ((root,), (tip,)), "helix": ((root, tip),)}
    found = list[tuple[int, tuple[int, ...]]]()
    for name in freed:
        for i, kind in enumerate(structure.kinds):
            columns = curvatures[kind] if name == "curvature" else ((NUMBERS.index(name),),)
            found += [(i, each) for each in columns]
    return tuple(found)


def numbers_of(tubes: Iterable[Tube]) -> list[list[float]]:
    """Of every tube, in the order of NUMBERS."""
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
    """That of a tube's curved part."""
    if tube.largest_curvature == 0:
        return "straight"
    if tube.pre_torsion != 0:
        return "helix"
    return "linear" if tube.root_curvature != tube.tip_curvature and tube.curved_length else "arc"
