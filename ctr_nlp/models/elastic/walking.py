"""One elastic robot that is moved step by step (models/walker.py) and stays on its branch until that ends.

Configurations q and unknowns x (2d + 2,) in rad and mm; equilibria.py follows branches.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.elastic import stability
from ctr_nlp.models.elastic.compiled import get_compiled_elastic
from ctr_nlp.models.elastic.equilibria import Equilibria, EquilibriumState
from ctr_nlp.models.elastic.following import MIN_ELASTIC_SNAP_JUMP_RAD
from ctr_nlp.models.walker import Walker
from ctr_nlp.robot.structure import Structure, tubes_of
from ctr_nlp.typing import Array

MAX_PREDICTED_TIP_STEP_RAD = 0.05
"""Angle in rad that tips may be predicted to turn by in one step from a robot's numbers to others: half of the
distance at which a solution may be on another branch.
"""


class ElasticWalker(Walker):
    """A robot that follows one branch of equilibria after the other, as following.py does along whole motions."""

    def __init__(self, structure: Structure, numbers: Array, q: Array) -> None:
        """Place a robot of numbers (d, 8) at rest at q (2d + 2,), all tubes turned there together from alpha_d."""
        self._structure = structure
        self._numbers = np.array(numbers)
        self._equilibria = Equilibria(structure, self._numbers)
        self._set_state(self._equilibria.find_rest_state(np.array(q, dtype=float)), q)

    def _set_state(self, state: EquilibriumState | None, q: Array) -> None:
        """Record a state at q; x is NaN for None."""
        self._state = state
        self.q = np.array(q, dtype=float)
        self.x = np.full(len(q), np.nan) if state is None else state.x

    def move_to(self, q: Array) -> list[Array]:
        """Move linearly to q (2d + 2,); return the tips' jumps (d,) in rad, an entry for each snap."""
        q = np.array(q, dtype=float)
        jumps = list[Array]()
        if self._state is not None:
            state, jumps = self._equilibria.follow_to_goal(self._state, q)
            self._set_state(state, q)
        return [jump for jump in jumps if abs(jump).max() > MIN_ELASTIC_SNAP_JUMP_RAD]

    def change_tubes(self, numbers: Array, x: Array | None = None) -> list[Array]:
        """Continue as a robot of other numbers (d, 8), in steps if x is far away.

        Returns the tips' jumps (d,) in rad, an entry for each snap. x (2d + 2,): approximate unknowns afterwards;
        None for the present ones.
        """
        before = self._numbers
        jumps = list[Array]()
        change = np.zeros(len(self.q))
        if x is not None and self._state is not None:
            change = x - self.x
        self._numbers = np.array(numbers)
        steps = 1 + int(abs(change).max() / MAX_PREDICTED_TIP_STEP_RAD)
        for k in range(1, steps + 1):
            there = before + (self._numbers - before) * (k / steps)
            self._equilibria = Equilibria(self._structure, there)
            if self._state is not None:
                # Numbers and unknowns change in proportion: each step's prediction is within
                # MAX_PREDICTED_TIP_STEP_RAD of the last equilibrium.
                near = self._state.x + change / steps
                state, fell = self._equilibria.follow_to_goal(self._state._replace(x=near), self.q)
                self._set_state(state, self.q)
                jumps += [jump for jump in fell if abs(jump).max() > MIN_ELASTIC_SNAP_JUMP_RAD]
        return jumps

    def margin(self) -> float:
        """The stability margin of the equilibrium."""
        code = get_compiled_elastic(self._structure)
        # Without a compiler the same quadrature runs in numpy, which is slower.
        if code is not None:
            return float(code.margins(self._numbers.ravel(order="F")[None], self.x[None])[0])
        tubes = tubes_of(self._structure, self._numbers.tolist())
        return float(stability.margins(tubes, self.x[None])[0])
