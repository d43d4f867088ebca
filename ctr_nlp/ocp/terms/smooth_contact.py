"""The lumen's wall as a smooth cost, for programs in which a slack and constraints for each robot would be too
many.

With depths t_k in mm of the sample points, negative without contact, and eps = CONTACT_SMOOTHING_MM, the deepest
is smoothed to eps log(1 + sum_k exp(t_k / eps)), which is never less than max(t_k, 0). It needs neither unknowns
nor rows: several robots in every frame can have it (ocp/shared/scenarios.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ctr_nlp.models.inner import Inner
from ctr_nlp.ocp.nlp import CostTerm
from ctr_nlp.ocp.terms.lumen import (
    arc_lengths,
    contact_penalty,
    no_wall_parameters,
    room_at_samples,
    wall_parameters,
)
from ctr_nlp.ocp.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot.structure import Structure

CONTACT_SMOOTHING_MM = 0.3
"""Depth in mm over which contact sets in: about as much as perturbed robots differ by, and enough for solvers to
need half as many steps as with 0.05.
"""


@dataclass(frozen=True)
class SmoothContact(Term):
    """The cost of the deepest contact at the sample points of LumenClearance (lumen.contact_penalty).

    d: number of tubes. For depths t_k, negative where nothing touches, the depth is w log(1 + sum_k exp(t_k / w))
    with w = CONTACT_SMOOTHING_MM: never less than the deepest and 0, and by at most w log(1 + points) more. The
    wall near the robot is a parameter, as in LumenClearance.
    """

    d: int
    name = "touch"
    objective_only = True

    def sample_arc_lengths(self, beta: Sequence[ca.SX]) -> ca.SX:
        """Return the arc lengths of the sample points on every tube, mm, at extensions beta in mm."""
        return ca.vertcat(*arc_lengths(beta))

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return the shapes of the parameters, by name: those of LumenClearance. structure: not used."""
        return wall_parameters(self.d, 1)

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return one cost on body; parameters: symbols by name.

        The sum is an inner quantity of its own, so that no sample point's second derivatives meet another's.
        """
        points, room = room_at_samples(body, parameters["wall"])
        # room is -t_k; exponents are negative where nothing touches, and exp(-NO_WALL_ROOM_MM /
        # CONTACT_SMOOTHING_MM) is 0.
        total = Inner.of([ca.sum1(ca.exp(-room / CONTACT_SMOOTHING_MM))])
        depth = CONTACT_SMOOTHING_MM * ca.log(1 + total.symbols[0])
        cost = contact_penalty(depth, parameters["contact_weight"], parameters["contact_allowed"])
        return Parts(costs=(CostTerm("contact", cost),), inner=(points, total))

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Return the parameters of a frame without a wall nearby, the same for every frame."""
        return no_wall_parameters(self.d, 1)
