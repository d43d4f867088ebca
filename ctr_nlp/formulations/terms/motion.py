"""What moving costs, eq. (9)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.formulations.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.nlp.nlp import Residual
from ctr_nlp.robot.robot import mm_per_unit
from ctr_nlp.robot.structure import Structure
from ctr_nlp.target.target import Frame
from ctr_nlp.typing import Array


def change(q: ca.SX, previous: ca.SX, mm_per_unit: Array, root: ca.SX) -> Residual:
    """Change of configuration over one frame, eq. (9).

    root: sqrt(lambda) / dt, with lambda in s^2 and dt in s; 0 where there is no frame before.
    """
    return Residual("motion", root * ca.DM(mm_per_unit) * (q - previous))


@dataclass(frozen=True)
class Motion(Term):
    """lambda |W (q - previous)|^2 / dt^2; a step overrides what fill gives, which is that of a first frame."""

    d: int
    name = "motion"

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """previous: q one frame before. motion_root: sqrt(lambda) / dt."""
        return {"previous": (2 * self.d + 2, 1), "motion_root": (1, 1)}

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Eq. (9)."""
        scale = mm_per_unit(self.d)
        return Parts(residuals=(change(body.q, parameters["previous"], scale, parameters["motion_root"]),))

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Those of a frame with none before it."""
        return {"previous": np.zeros(2 * self.d + 2), "motion_root": 0.0}
