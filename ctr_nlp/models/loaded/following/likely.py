"""Equilibria at all stations of a robot's way, found side by side rather than one after the other.

They are what the robot probably takes: the load is raised on the unloaded equilibrium at every station. They count
only where the branch of each leads to the next one.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.elastic.following import followed
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.tips import tip_angles
from ctr_nlp.models.protocol import passage
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Flags, Index


class Likely:
    """What robots probably take, of all rows of states that are to be found; one object a motion."""

    def __init__(self, structure: Structure, equilibria: LoadedEquilibria, states: States) -> None:
        """Of states only numbers, q and load are looked at."""
        self._structure, self._equilibria = structure, equilibria
        self._states = States.nowhere(states.numbers, states.q, states.load)
        self._until = np.arange(len(states.q))

    def look(self, rows: Index) -> None:
        """Find what a robot takes in some rows, which are its stations in their order."""
        numbers, q, load, *_ = self._states.rows(rows)
        x = self._unloaded(numbers[0], q)
        stands = np.flatnonzero(np.isfinite(x).all(axis=1))
        tips = tip_angles(x[stands], self._structure.d)
        free = self._equilibria.unloaded(numbers[stands], q[stands], tips)
        found, done = self._equilibria.along(free, q[stands], load[stands])
        self._states.write(rows[stands[done == 1]], found.rows(done == 1))
        states = self._states.rows(rows)
        leads = self._equilibria.linked(states.rows(slice(-1)), states.rows(slice(1, None)))
        self._until[rows] = rows[_last_of_runs(np.append(leads, False))]

    def _unloaded(self, numbers: Array, q: Array) -> Array:
        """The unknowns (T, 2d + 2) at q (T, 2d + 2) of a robot that bears nothing; NaN where none are found."""
        return followed(self._structure, numbers, passage(q, 1), q, margins=False).x

    def skip(self, states: States, at: Index) -> Index:
        """Write states from rows on as far as they are known; the last rows written, or those where none are."""
        last = np.where(self._states.rows(at).alike(states.rows(at)), self._until[at], at)
        for begin, end in zip(at, last, strict=True):
            between = slice(begin + 1, end + 1)
            states.write(between, self._states.rows(between))
        return last


def _last_of_runs(leads: Flags) -> Index:
    """For each of places (M,) the last that follows, where each that leads is followed by the next."""
    ends = np.where(leads, len(leads), np.arange(len(leads)))
    return np.minimum.accumulate(ends[::-1])[::-1]
