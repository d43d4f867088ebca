"""Loads in the form that the rod's equations take, and the kinds of rods that they make.

A kind says which terms the equations contain; within it, all loads share one compiled program, whose parameters
are the load's numbers (loads/load.py). A force along the body sets in and ends within FORCE_EDGE_HALF_WIDTH_MM of
its places instead of abruptly, so that shapes stay smooth functions of the extensions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import LoadError
from ctr_nlp.models.elastic.torsion import RobotSection
from ctr_nlp.models.loaded.vectors import vectors
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.models.loads.load import FIRST_WEIGHT_COLUMN, FORCE_RANGE_COLUMNS
from ctr_nlp.robot.structure import Kind, Structure
from ctr_nlp.typing import Array, Vector

LOADED_STEPS_PER_SECTION = 18
"""Steps of integration a section in evaluations; twice as many where a force may begin or end in one."""
FORCE_EDGE_HALF_WIDTH_MM = 0.25
"""Distance, mm, to both sides of a place where a force along the body begins or ends, within which it does so."""


class Loading(NamedTuple):
    """A load's numbers (loads.Load.numbers) split into vectors: of numbers, columns (T, 1), or symbols.

    force: at the tip, N, in the base's directions. tool_force: at the tip, N, in those of the tip. moment,
    tool_moment: at the tip, N mm, likewise. distributed: N/mm, in the base's directions, which acts between two
    places, mm from the opening. weights: of each tube's material, N/mm^3.
    """

    force: Vector
    tool_force: Vector
    moment: Vector
    tool_moment: Vector
    distributed: Vector
    between: tuple[Any, Any]
    weights: Sequence[Vector]


class PieceForce(NamedTuple):
    """A force per length along a piece, N/mm, linear in the place: mean + growth (2 x - 1), x from 0 to 1 along
    it.

    Its resultant is the mean times the length; growth moves the place at which the resultant acts. foundation: the
    rows of the derivative of the force per length by the place's displacement, N/mm per mm, or empty.
    """

    mean: Vector
    growth: Vector
    foundation: Sequence[Vector] = ()


def check_kinds(kinds: Sequence[Kind]) -> None:
    """Raise LoadError if the kinds of a robot's tubes include a helix.

    The equations of a loaded rod are written for tubes that bend in a plane.
    """
    for i, kind in enumerate(kinds, start=1):
        if kind == "helix":
            raise LoadError(
                f"tube {i} is a helix, for which loads are not supported; leave out the load or pre_torsion"
            )


def loading(values: Sequence[Any]) -> Loading:
    """Split the values of a load's numbers, in the order of loads.Load.numbers, into the vectors of a Loading."""
    # The five vectors come first, then the range of the distributed force, then the weights of tubes.
    force, tool_force, moment, tool_moment, distributed = vectors(values[: FORCE_RANGE_COLUMNS.start])
    begin, end = values[FORCE_RANGE_COLUMNS]
    return Loading(
        force, tool_force, moment, tool_moment, distributed, (begin, end), vectors(values[FIRST_WEIGHT_COLUMN:])
    )


@dataclass(frozen=True)
class DistributedForce:
    """A force per length, N/mm, between two places, mm from the opening, on a robot of a given length, mm.

    xp: casadi or numpy.
    """

    force: Vector
    between: tuple[Any, Any]
    length: Any
    xp: Any

    def beyond(self, s: Any) -> Any:
        """Return the length from s to the tip along which the force acts, mm.

        Multiplied by the force, it is the load beyond s.
        """
        # Where the robot ends before the force does, the part beyond its tip is subtracted.
        return self._after(s) - self._after(self.length)

    def _after(self, s: Any) -> Any:
        """Return the length beyond s along which the force would act on a robot without an end, mm."""
        begin, end = self.between
        return self._rest(end - s) - self._rest(begin - s)

    def _rest(self, left: Any) -> Any:
        """Return max(left, 0), mm, with the corner at 0 rounded within FORCE_EDGE_HALF_WIDTH_MM to either side."""
        # The parabola (x + g)^2 / 4g meets 0 at -g and x at g with equal slopes: the force per length, which is
        # the derivative, rises linearly over 2g.
        near = self.xp.fmin(self.xp.fmax(left, -FORCE_EDGE_HALF_WIDTH_MM), FORCE_EDGE_HALF_WIDTH_MM)
        return (near + FORCE_EDGE_HALF_WIDTH_MM) ** 2 / (4 * FORCE_EDGE_HALF_WIDTH_MM) + self.xp.fmax(
            left - FORCE_EDGE_HALF_WIDTH_MM, 0.0
        )


def scale_loads(acting: Array, part: Array) -> Array:
    """Return the numbers (.., l) of loads (acting) of which only a fraction (part, (..), from 0 to 1) is applied.

    The places between which a force along the body acts are no forces, and are not scaled.
    """
    found = part[..., None] * acting
    found[..., FORCE_RANGE_COLUMNS] = acting[..., FORCE_RANGE_COLUMNS]
    return np.asarray(found)


class RodKind(NamedTuple):
    """The terms that the equations of a rod contain.

    follows: a force at the tip turns with the tool. bends: a moment acts at the tip that is not about its
    direction. distributed: a force acts between two places along the body. weighs: tubes have a weight. pieces:
    number of pieces into which every section is divided, each with a force per length of its own that is linear
    along it, or 0 where there are none. founded: whether that force changes as the piece moves, by a stiffness of
    its own, which counts in responses alone. Numbers of a load whose term a kind does not contain are ignored.
    """

    follows: bool = False
    bends: bool = False
    distributed: bool = False
    weighs: bool = False
    pieces: int = 0
    founded: bool = False

    @classmethod
    def of(cls, load: Load | LoadOverTime) -> RodKind:
        """Return the kind of rods that a load makes."""
        return cls(load.has_follower_force, load.has_tip_moment, load.has_distributed_force, load.has_weight)

    def split_sections(self, parts: Sequence[RobotSection]) -> list[RobotSection]:
        """Return the sections (parts), or their pieces, from base to tip."""
        return (
            [piece for part in parts for piece in part.split_evenly(self.pieces)] if self.pieces else list(parts)
        )

    @property
    def steps(self) -> int:
        """Steps of integration in each section, or in each piece where sections are divided."""
        # The corner of a force along the body costs accuracy in the step that it falls into. Pieces share the
        # steps of their section, rounded up: of 18 steps, one alone would be left for each of 12 pieces, along
        # which the wall's push changes.
        steps = LOADED_STEPS_PER_SECTION * (2 if self.distributed else 1)
        return math.ceil(steps / max(self.pieces, 1))

    def numbers(self, structure: Structure) -> int:
        """Return how many numbers a load of a robot has: of loads.Load.numbers, and six for every piece, N/mm, if
        any (PieceForce), with nine more of its foundation.

        structure: of the robot, whose tubes determine the number of sections.
        """
        d = structure.d
        shown = structure.transmission_emerges
        # Sections lie between neighbouring tips; each is divided once more for every tube present whose straight
        # part may show (torsion.sections).
        parts = sum(1 + sum(shown[i:]) for i in range(d))
        return FIRST_WEIGHT_COLUMN + 3 * d + self.numbers_per_piece * self.pieces * parts

    @property
    def numbers_per_piece(self) -> int:
        """How many numbers of a load belong to each piece."""
        return 15 if self.founded else 6

    @property
    def place_changes(self) -> int:
        """How many numbers, apart from the tubes' angles, describe a change of a place.

        Two turns of the tangent; on a foundation the displacement, too.
        """
        return 5 if self.founded else 2


TIP_FORCE_ROD_KIND = RodKind()
"""The kind of loads that act at the tip and keep their direction."""
