"""Hard constraints of a frame: the order of tubes, eq. (2), their carriages' gap, and the stability margin.

Limits (3) are bounds of the configuration and no term. The margin is constrained through determinants that are
positive as long as it is larger than the least one (models/elastic/stability.py); a smallest eigenvalue would not
be smooth where two meet.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.ocp.nlp import Constraint
from ctr_nlp.ocp.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot.structure import Structure, Tubes

MIN_INNER_DETERMINANT = 0.05
"""Least value of determinants before the last: where two vanish together, an unstable shape looks stable."""


def order(tubes: Tubes, beta: Sequence[ca.SX], gap: ca.SX | None) -> tuple[Constraint, ...]:
    """Return the constraints beta_i <= beta_{i+1}, eq. (2), and of the least gap between carriages, mm, if any.

    tubes: of the robot. beta: extensions, mm. gap: None for a robot without one.
    """
    if len(tubes) == 1:
        return ()
    growth = ca.diff(ca.vertcat(*beta))
    constraints = [_positive("order", growth)]
    if gap is not None:
        # Carriage i is L_i - beta_i behind the insertion point: neighbours are (L_{i+1} - beta_{i+1}) -
        # (L_i - beta_i) apart.
        room = ca.diff(ca.vertcat(*(tube.length for tube in tubes))) - gap - growth
        constraints.append(_positive("carriage gap", room))
    return tuple(constraints)


def _positive(name: str, value: ca.SX) -> Constraint:
    """Return a constraint value >= 0, entry by entry."""
    return Constraint(name, value, np.zeros(value.numel()), np.full(value.numel(), np.inf))


@dataclass(frozen=True)
class Order(Term):
    """The order of tubes, eq. (2), and the carriages' gap, mm."""

    gap: float | None
    name = "order"

    @property
    def key(self) -> Hashable:
        """The type, and whether there is a gap, whose size is a parameter."""
        return type(self), self.gap is None

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return the shape of the parameter gap, mm, if there is one. structure: not used."""
        return {} if self.gap is None else {"gap": (1, 1)}

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return the constraints of eq. (2) and of the gap on body; parameters: symbols by name."""
        return Parts(constraints=order(body.tubes, body.beta, parameters.get("gap")))

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Return the robot's gap, which is the same in every frame."""
        return {} if self.gap is None else {"gap": self.gap}


@dataclass(frozen=True)
class Margin(Term):
    """The least stability margin, on models that can snap; planners may require more than fill returns."""

    least: float
    name = "margin"

    @property
    def key(self) -> Hashable:
        """The type: the margin is a parameter."""
        return type(self)

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return the shape of the margin, from 0, the snap, to 1, where no tube acts on another.

        structure: not used.
        """
        return {"margin": (1, 1)}

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return determinants of body that are positive as long as the margin is kept; none where nothing twists.

        parameters: not used, as the shape has been computed with the margin.
        """
        value = body.shape.stability
        # One tube, or no margin: nothing can snap.
        if value is None:
            return Parts()
        count = value.numel()
        # Jacobi's condition requires all of them positive on the way. The last one is 0 where the margin is
        # exactly the least one, so that its bound is 0.
        lower = np.append(np.full(count - 1, MIN_INNER_DETERMINANT), 0.0)
        return Parts(constraints=(Constraint("stability", value, lower, np.full(count, np.inf)),))

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Return the least margin, which is the same in every frame."""
        return {"margin": self.least}
