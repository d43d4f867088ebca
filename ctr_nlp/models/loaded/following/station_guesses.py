"""Guesses of the equilibria at all stations of a robot's motion, found in one batch instead of one after the
other.

At every station the load is raised on the equilibrium of the unloaded robot that is followed through the motion.
The result is used only where the branch of each guess leads to the next one.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.elastic.following import follow_substeps
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.tips import tip_angles
from ctr_nlp.models.protocol import subdivide_motion
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Flags, Index


class StationGuesses:
    """Guessed equilibria at the rows of states that are to be found. One object for each motion."""

    def __init__(self, structure: Structure, equilibria: LoadedEquilibria, states: States) -> None:
        """Prepare; of states only numbers, q and load are used."""
        self._structure = structure
        self._equilibria = equilibria
        self._states = States.unknown_states(states.numbers, states.q, states.load)
        self._until = np.arange(len(states.q))

    def guess_stations(self, rows: Index) -> None:
        """Find the guesses at some rows, which are the stations of one robot in their order."""
        numbers, q, load, *_ = self._states.rows(rows)
        x = self._unloaded_unknowns(numbers[0], q)
        stands = np.flatnonzero(np.isfinite(x).all(axis=1))
        tips = tip_angles(x[stands], self._structure.d)
        free = self._equilibria.solve_unloaded(numbers[stands], q[stands], tips)
        found, done = self._equilibria.follow_branches(free, q[stands], load[stands])
        self._states.write(rows[stands[done == 1]], found.rows(done == 1))
        states = self._states.rows(rows)
        leads = self._equilibria.branches_lead_to(states.rows(slice(-1)), states.rows(slice(1, None)))
        # For each station the last one that is reached from it by confirmed guesses: all up to there can be
        # skipped.
        self._until[rows] = rows[_last_of_runs(np.append(leads, False))]

    def _unloaded_unknowns(self, numbers: Array, q: Array) -> Array:
        """Return the unknowns (T, 2d + 2) of the robot at q without a load; NaN where none are found."""
        return follow_substeps(self._structure, numbers, subdivide_motion(q, 1), q, margins=False).x

    def skip_confirmed(self, states: States, at: Index) -> Index:
        """Write confirmed guesses to states after the rows `at`.

        Returns the last rows written, or `at` where there are none.
        """
        # A robot that is on another branch than guessed is followed step by step.
        last = np.where(self._states.rows(at).same_equilibria(states.rows(at)), self._until[at], at)
        for begin, end in zip(at, last, strict=True):
            between = slice(begin + 1, end + 1)
            states.write(between, self._states.rows(between))
        return last


def _last_of_runs(leads: Flags) -> Index:
    """Return for each of M places the last one that is reached from it.

    leads (M,): whether it leads to the next one.
    """
    ends = np.where(leads, len(leads), np.arange(len(leads)))
    return np.minimum.accumulate(ends[::-1])[::-1]
