"""What acts on rods, as models take it, and what kinds of rods it makes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import LoadError
from ctr_nlp.loads import Load, LoadOverTime
from ctr_nlp.loads.load import BEFORE_WEIGHTS, BETWEEN
from ctr_nlp.models.elastic.torsion import Section
from ctr_nlp.models.loaded.vectors import vectors
from ctr_nlp.robot.structure import Kind, Structure
from ctr_nlp.typing import Array, Vector

STEPS = 18
"""Steps of integration a section where numbers are wanted; twice as many where a force may begin or end in one."""
GENTLE = 0.25
"""mm to both sides of a place where a force along the body begins or ends, within which it does so."""


class Loading(NamedTuple):
    """A load's numbers (loads.Load.numbers) as models take them: numbers, columns (T, 1), or symbols.

    force: N, in the base's directions. tool_force: N, in those of the tip. moment, tool_moment: N mm, likewise.
    distributed: N/mm, which acts between two places, mm from the opening. weights: of what every tube is made of,
    N/mm^3.
    """

    force: Vector
    tool_force: Vector
    moment: Vector
    tool_moment: Vector
    distributed: Vector
    between: tuple[Any, Any]
    weights: Sequence[Vector]


def check_kinds(kinds: Sequence[Kind]) -> None:
    """Raise LoadError of a helix: the equations of a loaded rod are written for tubes that bend in a plane."""
    for i, kind in enumerate(kinds, start=1):
        if kind == "helix":
            raise LoadError(
                f"tube {i} is a helix, which bears no load here; plan for it without one, or without pre_torsion"
            )


def loading(values: Sequence[Any]) -> Loading:
    """The numbers of a load as models take them."""
    force, tool_force, moment, tool_moment, distributed = vectors(values[: BETWEEN.start])
    begin, end = values[BETWEEN]
    return Loading(
        force, tool_force, moment, tool_moment, distributed, (begin, end), vectors(values[BEFORE_WEIGHTS:])
    )


@dataclass(frozen=True)
class Along:
    """A force per length, N/mm, which begins and ends gently at two places, mm, of a robot of some length."""

    force: Vector
    between: tuple[Any, Any]
    length: Any
    xp: Any

    def beyond(self, s: Any) -> Any:
        """The length from s to the tip along which it acts, mm."""
        return self._after(s) - self._after(self.length)

    def _after(self, s: Any) -> Any:
        """The same for a robot without an end."""
        begin, end = self.between
        return self._rest(end - s) - self._rest(begin - s)

    def _rest(self, left: Any) -> Any:
        """max(left, 0), rounded within GENTLE of 0."""
        near = self.xp.fmin(self.xp.fmax(left, -GENTLE), GENTLE)
        return (near + GENTLE) ** 2 / (4 * GENTLE) + self.xp.fmax(left - GENTLE, 0.0)


def eased(acting: Array, part: Array) -> Array:
    """Numbers (.., l) of loads of which parts (..) have come, from 0 to 1: all but the places between which they
    act.
    """
    found = part[..., None] * acting
    found[..., BETWEEN] = acting[..., BETWEEN]
    return np.asarray(found)


class RodKind(NamedTuple):
    """What kind of rods: whether a force turns with the tip; whether a moment acts there that is not about its
    direction; whether a force acts between two places along the body; whether tubes weigh something; into how many
    pieces every section is divided, along each of which a force per length of its own acts, or 0 where none does.
    What a kind leaves out is not looked at in the load's numbers.
    """

    follows: bool = False
    bends: bool = False
    distributed: bool = False
    weighs: bool = False
    pieces: int = 0

    @classmethod
    def of(cls, load: Load | LoadOverTime) -> RodKind:
        """That of robots which bear a load."""
        return cls(load.follows, load.bends, load.distributed, load.weighs)

    def divided(self, parts: Sequence[Section]) -> list[Section]:
        """The sections, or their pieces, from base to tip."""
        return [piece for part in parts for piece in part.divided(self.pieces)] if self.pieces else list(parts)

    @property
    def steps(self) -> int:
        """Of integration, in each of these."""
        return STEPS * (2 if self.distributed else 1) // max(self.pieces, 1)

    def numbers(self, structure: Structure) -> int:
        """How many numbers a load has: of loads.Load.numbers, and then three of every piece, N/mm, if any."""
        d, shown = structure.d, structure.shown
        parts = sum(1 + sum(shown[i:]) for i in range(d))
        return BEFORE_WEIGHTS + 3 * d + 3 * self.pieces * parts


PLAIN = RodKind()
"""Those of loads that act at the tip and keep their direction."""
