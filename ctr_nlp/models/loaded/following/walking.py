"""One loaded robot that is moved step by step, as by its motors, and stays on its branch of equilibria."""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.loaded.equilibria import States
from ctr_nlp.models.loaded.following.follower import Follower
from ctr_nlp.models.loaded.stability import margins
from ctr_nlp.models.loads import Load
from ctr_nlp.models.walker import Walker
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array


class LoadedWalker(Walker):
    """A robot on its branch of equilibria, under a load that changes only by `change_load`.

    Where the branch ends, it is not known where the robot comes to rest: x is NaN from then on.
    """

    def __init__(self, structure: Structure, numbers: Array, q: Array, load: Load) -> None:
        """Place the robot at q (2d + 2,), to which all tubes were turned together from alpha_d, and load it."""
        self.q = np.array(q, dtype=float)
        self._conservative = load.conservative
        self._acting = load.numbers(structure.d)[None]
        follower = Follower(structure, np.array(numbers, dtype=float)[None], load, self._acting[:, None])
        self._equilibria = follower.loaded
        # Unloaded first: which equilibrium a robot is in under a load depends on how it came there.
        _, states = follower.rest_without_load(self.q[None])
        self._follow_to_target(states if len(states.q) else None)

    def _follow_to_target(self, states: States | None, numbers: Array | None = None) -> None:
        """Follow the branch from states to q under the present load; None where the robot has no state.

        numbers (1, d, 8): of its tubes from then on, None for those that it has.
        """
        if states is not None:
            states, done = self._equilibria.follow_branches(states, self.q[None], self._acting, numbers=numbers)
            states = states if done[0] == 1 else None
        self._states = states
        self.x = np.full(len(self.q), np.nan) if states is None else states.unknowns[0]

    def move_to(self, q: Array) -> list[Array]:
        """Move to q (2d + 2,) on a line; no jump is reported, as the equilibrium after a snap is not known."""
        self.q = np.array(q, dtype=float)
        self._follow_to_target(self._states)
        return []

    def change_tubes(self, numbers: Array, x: Array | None = None) -> list[Array]:
        """Continue as a robot of other numbers (d, 8), along its branch while they change; x is ignored."""
        self._follow_to_target(self._states, np.array(numbers, dtype=float)[None])
        return []

    def change_load(self, load: Array) -> list[Array]:
        """Continue under another load of the same kind, with numbers (17 + 3d,); no jump is reported."""
        self._acting = np.array(load, dtype=float)[None]
        self._follow_to_target(self._states)
        return []

    def margin(self) -> float:
        """Return the stability margin; NaN where there is no equilibrium, or the load has no energy."""
        if self._states is None or not self._conservative:
            return float("nan")
        return float(margins(self._equilibria, self._states)[0])
