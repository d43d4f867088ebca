"""One elastic robot that is moved step by step: Walker."""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.elastic import stability
from ctr_nlp.models.elastic.compiled import compiled
from ctr_nlp.models.elastic.equilibria import Equilibria, State
from ctr_nlp.models.elastic.following import JUMP
from ctr_nlp.models.walker import Walker
from ctr_nlp.robot.structure import Structure, tubes_of
from ctr_nlp.typing import Array

NEAR = 0.05
"""rad that tips may be predicted to turn by in one step from a robot's numbers to others: half of what would
belong to another branch."""


class ElasticWalker(Walker):
    """Follows one branch of equilibria after the other, as following.py does along whole motions."""

    def __init__(self, structure: Structure, numbers: Array, q: Array) -> None:
        """At rest at q (2d + 2,), to which all tubes were turned together from alpha_d."""
        self._structure, self._numbers = structure, np.array(numbers)
        self._equilibria = Equilibria(structure, self._numbers)
        self._take(self._equilibria.settled(np.array(q, dtype=float)), q)

    def _take(self, state: State | None, q: Array) -> None:
        self._state, self.q = state, np.array(q, dtype=float)
        self.x = np.full(len(q), np.nan) if state is None else state.x

    def go(self, q: Array) -> list[Array]:
        """As Walker."""
        q, jumps = np.array(q, dtype=float), list[Array]()
        if self._state is not None:
            state, jumps = self._equilibria.followed(self._state, q)
            self._take(state, q)
        return [jump for jump in jumps if abs(jump).max() > JUMP]

    def become(self, numbers: Array, x: Array | None = None) -> list[Array]:
        """As Walker; in steps, where a robot of other numbers is far away."""
        before, jumps, change = self._numbers, list[Array](), np.zeros(len(self.q))
        if x is not None and self._state is not None:
            change = x - self.x
        self._numbers = np.array(numbers)
        steps = 1 + int(abs(change).max() / NEAR)
        for k in range(1, steps + 1):
            there = before + (self._numbers - before) * (k / steps)
            self._equilibria = Equilibria(self._structure, there)
            if self._state is not None:
                near = self._state.x + change / steps
                state, fell = self._equilibria.followed(self._state._replace(x=near), self.q)
                self._take(state, self.q)
                jumps += [jump for jump in fell if abs(jump).max() > JUMP]
        return jumps

    def margin(self) -> float:
        """As Walker."""
        code = compiled(self._structure)
        if code is not None:
            return float(code.margins(self._numbers.ravel(order="F")[None], self.x[None])[0])
        tubes = tubes_of(self._structure, self._numbers.tolist())
        return float(stability.margins(tubes, self.x[None])[0])
