"""The load that a robot bears, on models that know one: numbers for the shape, and no cost."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.formulations.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.loads import Load, LoadOverTime
from ctr_nlp.loads.load import BEFORE_WEIGHTS
from ctr_nlp.robot.structure import Structure
from ctr_nlp.target.target import Frame


@dataclass(frozen=True, eq=False)
class Bears(Term):
    """The numbers (17 + 3d,) of a load (loads.Load.over) that a robot bears in every frame, of so many tubes."""

    load: Load | LoadOverTime
    tubes: int
    name = "load"

    @property
    def key(self) -> Hashable:
        """The numbers are parameters."""
        return type(self)

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """load: N, N mm, N/mm and mm."""
        return {self.name: (BEFORE_WEIGHTS + 3 * structure.d, 1)}

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Nothing beside the shape, which was made with the load."""
        return Parts()

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """The numbers in that part of the motion."""
        return {self.name: self.load.over(self.tubes, np.array([frame.part]))[0]}
