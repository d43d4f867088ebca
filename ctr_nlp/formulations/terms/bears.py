"""The load that a robot bears, on models that know one: numbers for the shape, and no cost."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

from ctr_nlp.formulations.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.loads.load import OF_TIP
from ctr_nlp.robot.structure import Structure
from ctr_nlp.target.target import Frame
from ctr_nlp.typing import Array


@dataclass(frozen=True, eq=False)
class Bears(Term):
    """The numbers (7 + 3d,) of a load (loads.Load.numbers), the same in every frame."""

    acting: Array
    name = "load"

    @property
    def key(self) -> Hashable:
        """The numbers are parameters."""
        return type(self)

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """load: N, N mm and N/mm."""
        return {self.name: (OF_TIP + 3 * structure.d, 1)}

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Nothing beside the shape, which was made with the load."""
        return Parts()

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """The numbers."""
        return {self.name: self.acting}
