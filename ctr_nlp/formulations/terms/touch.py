"""The lumen's wall as a smooth cost, for programs in which slacks and constraints of every place would be too
many.

With depths t_k in mm of the places, negative without contact, and eps = WIDTH, the deepest is smoothed to eps
log(1 + sum_k exp(t_k / eps)), which is never less than max(t_k, 0). It needs neither unknowns nor rows: several
robots in every frame can have it (formulations/shared/scenarios.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ctr_nlp.formulations.terms.lumen import arc_lengths, contact, far_away, seen, wall_parameters
from ctr_nlp.formulations.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.nlp.nlp import Cost, Inner
from ctr_nlp.robot.structure import Structure
from ctr_nlp.target.target import Frame

WIDTH = 0.3
"""Depth in mm over which contact sets in: as little as robots differ by, and so much that solvers need half as
many steps as with 0.05.
"""


@dataclass(frozen=True)
class Touch(Term):
    """The cost of the deepest contact at the places of Lumen (lumen.contact); d: number of tubes.

    Of depths t_k, negative where nothing touches, it is w log(1 + sum_k exp(t_k / w)) with w = WIDTH: never less
    than the deepest and 0, and by at most w log(1 + places) more. The wall near the robot is a parameter, as in
    Lumen.
    """

    d: int
    name = "touch"
    objective_only = True

    def places(self, beta: Sequence[ca.SX]) -> ca.SX:
        """Arc lengths of the places on every tube, mm."""
        return ca.vertcat(*arc_lengths(beta))

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Shapes of the parameters, by name: the same as Lumen's."""
        return wall_parameters(self.d)

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """One cost. The sum is a quantity of its own, so that no place's second derivatives meet another's."""
        points, room = seen(body, parameters["wall"])
        # room is -t_k; exponents are negative where nothing touches, and exp(-FAR / WIDTH) is 0.
        total = Inner.of([ca.sum1(ca.exp(-room / WIDTH))])
        depth = WIDTH * ca.log(1 + total.symbols[0])
        cost = contact(depth, parameters["contact_weight"], parameters["contact_allowed"])
        return Parts(costs=(Cost("contact", cost),), inner=(points, total))

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Parameters for no wall nearby."""
        return far_away(self.d)
