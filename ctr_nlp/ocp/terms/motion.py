"""The cost of moving, eq. (9): lambda |W (q - previous)|^2 / dt^2 in mm^2, for one frame.

lambda is in s^2, dt in s; W turns units of q into mm: 10 mm/rad for angles, 1 for beta. Over a horizon, links have
this cost instead (ocp/horizon.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.ocp.nlp import Residual
from ctr_nlp.ocp.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot.robot import mm_per_unit
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array


def motion_residual(q: ca.SX, previous: ca.SX, mm_per_unit: Array, root: ca.SX) -> Residual:
    """Return the change of configuration over one frame, eq. (9), as a residual in mm.

    q, previous (k, 1): configurations in this frame and the one before, or some of their entries, rad and mm.
    mm_per_unit: the diagonal of W. root: sqrt(lambda) / dt; 0 where there is no frame before.
    """
    return Residual("motion", root * ca.DM(mm_per_unit) * (q - previous))


@dataclass(frozen=True)
class MotionCost(Term):
    """The cost lambda |W (q - previous)|^2 / dt^2.

    FrameSolver.step overrides the values of fill, which are for a first frame.
    """

    d: int
    name = "motion"

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return the shapes of q one frame before, and of sqrt(lambda) / dt. structure: not used."""
        return {"previous": (2 * self.d + 2, 1), "motion_root": (1, 1)}

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return the residual of eq. (9) on the configuration of body; parameters: symbols by name."""
        # W of eq. (9): 10 mm/rad for angles and 1 for extensions.
        scale = mm_per_unit(self.d)
        return Parts(
            residuals=(motion_residual(body.q, parameters["previous"], scale, parameters["motion_root"]),)
        )

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Return the values for a frame with none before it, which costs nothing."""
        # motion_root = 0 switches the term off; `previous` then does not matter.
        return {"previous": np.zeros(2 * self.d + 2), "motion_root": 0.0}
