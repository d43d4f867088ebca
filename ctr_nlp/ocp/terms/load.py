"""The load on the robot, on models with loads: parameters for the shape, and no cost of its own."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.models.loads.load import FIRST_WEIGHT_COLUMN
from ctr_nlp.ocp.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot.structure import Structure


@dataclass(frozen=True, eq=False)
class LoadTerm(Term):
    """The numbers (17 + 3d,) of a load in every frame, for a number of tubes (loads.Load.numbers_at)."""

    load: Load | LoadOverTime
    tubes: int
    name = "load"

    @property
    def key(self) -> Hashable:
        """The type alone; the numbers are parameters."""
        return type(self)

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return the shape of the load's numbers, N, N mm, N/mm and mm, for the tubes of a structure."""
        return {self.name: (FIRST_WEIGHT_COLUMN + 3 * structure.d, 1)}

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return no contribution: the shape of body has been computed with the load. parameters: not used."""
        return Parts()

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Return the load's numbers at the time of a frame."""
        # Loads that change over time are evaluated at the frame's part of the motion.
        return {self.name: self.load.numbers_at(self.tubes, np.array([frame.motion_fraction]))[0]}
