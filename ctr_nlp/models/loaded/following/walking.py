"""One loaded robot that is moved step by step: Walker."""

from __future__ import annotations

import numpy as np

from ctr_nlp.loads import Load
from ctr_nlp.models.loaded.equilibria import States
from ctr_nlp.models.loaded.following.follower import Follower
from ctr_nlp.models.loaded.stability import margins
from ctr_nlp.models.walker import Walker
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array


class LoadedWalker(Walker):
    """Follows the branch of equilibria that it is on under a load that changes only when it is told.

    Where that ends, nobody knows where the robot comes to rest: x is NaN then.
    """

    def __init__(self, structure: Structure, numbers: Array, q: Array, load: Load) -> None:
        """At rest at q (2d + 2,), to which all tubes were turned together from alpha_d, and then loaded."""
        self.q, self._conservative = np.array(q, dtype=float), load.conservative
        self._acting = load.numbers(structure.d)[None]
        follower = Follower(structure, np.array(numbers, dtype=float)[None], load, self._acting[:, None])
        self._equilibria = follower.loaded
        _, states = follower.settled(self.q[None])
        self._go_on(states if len(states.q) else None)

    def _go_on(self, states: States | None, numbers: Array | None = None) -> None:
        """Go on to q under the load, from states of the robot there or elsewhere; None where it has none.

        numbers (1, d, 8): of its tubes from then on, None for those that it has.
        """
        if states is not None:
            states, done = self._equilibria.along(states, self.q[None], self._acting, numbers=numbers)
            states = states if done[0] == 1 else None
        self._states = states
        self.x = np.full(len(self.q), np.nan) if states is None else states.unknowns[0]

    def go(self, q: Array) -> list[Array]:
        """As Walker; no jump is told, as it is not known where a robot comes to rest that snaps under a load."""
        self.q = np.array(q, dtype=float)
        self._go_on(self._states)
        return []

    def become(self, numbers: Array, x: Array | None = None) -> list[Array]:
        """As Walker; x is not looked at: the branch is followed while the numbers change."""
        self._go_on(self._states, np.array(numbers, dtype=float)[None])
        return []

    def bear(self, load: Array) -> list[Array]:
        """As Walker."""
        self._acting = np.array(load, dtype=float)[None]
        self._go_on(self._states)
        return []

    def margin(self) -> float:
        """As Walker; NaN, too, under a load that has no energy."""
        if self._states is None or not self._conservative:
            return float("nan")
        return float(margins(self._equilibria, self._states)[0])
