"""Loaded robots that each bear a force of their own at their tips."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.typing import Array


@dataclass(frozen=True, eq=False)
class Pushed(Loaded):
    """The same of n robots, each of which bears one of forces (n, 3), N, beside the load.

    The forces are in the directions of the base. Only robots apart bear them: follow_apart, points_apart.
    """

    forces: Array

    def acting_apart(self, d: int, rows: int) -> Array:
        """As Loaded.acting_apart, of the n robots after one another, each with as many of the rows."""
        found = super().acting_apart(d, rows)
        found[:, :3] += np.repeat(self.forces, rows // len(self.forces), axis=0)
        return found
