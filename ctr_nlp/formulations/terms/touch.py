"""The lumen's wall as a smooth cost, for programs in which slacks and rows of every place would be too many."""

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
"""mm over which contact sets in: as little as robots differ by, and so much that solvers need half as many steps
as with 0.05."""


@dataclass(frozen=True)
class Touch(Term):
    """What the deepest contact at the places of Lumen costs (lumen.contact); d: number of tubes.

    Of depths t_k, negative where nothing touches, it is w log(1 + sum_k exp(t_k / w)) with w = WIDTH: never less
    than the deepest and 0, and by at most w log(1 + places) more. The wall near to the robot is a parameter, as of
    Lumen.
    """

    d: int
    name = "touch"
    objective_only = True

    def places(self, beta: Sequence[ca.SX]) -> ca.SX:
        """On every tube."""
        return ca.vertcat(*arc_lengths(beta))

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """As Lumen."""
        return wall_parameters(self.d)

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """One cost. The sum is a quantity of its own, so that no place's second derivatives meet another's."""
        points, room = seen(body, parameters["wall"])
        total = Inner.of([ca.sum1(ca.exp(-room / WIDTH))])
        depth = WIDTH * ca.log(1 + total.symbols[0])
        cost = contact(depth, parameters["contact_weight"], parameters["contact_allowed"])
        return Parts(costs=(Cost("contact", cost),), inner=(points, total))

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """No wall near."""
        return far_away(self.d)
