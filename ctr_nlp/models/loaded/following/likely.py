"""Equilibria of one robot at all places of its way, found side by side rather than one after the other.

They are what the robot probably takes: at every tenth place or so the load is raised on the unloaded equilibrium,
the unknowns between are interpolated, and Newton's method makes equilibria of them. They count only where the
branch of each leads to the next one, as a step of LoadedEquilibria.along would.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.elastic.following import followed
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.tips import tip_angles, tips
from ctr_nlp.models.protocol import Passage
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Flags, Index

EVERY = 10
"""Places, of which one is an anchor, between which unknowns are interpolated."""
ALIKE = 1e-6
"""rad by which unknowns of the same equilibrium may differ."""


class Likely:
    """What robots probably take, of all rows of states that are to be found; one object a motion."""

    def __init__(self, structure: Structure, equilibria: LoadedEquilibria, states: States) -> None:
        """Of states only numbers, q and load are looked at."""
        self._structure, self._equilibria = structure, equilibria
        self._states = States.nowhere(states.numbers, states.q, states.load)
        self._until = np.arange(len(states.q))

    def look(self, rows: slice) -> None:
        """Find what a robot takes at the places of some rows, which follow one another."""
        places = self._states.rows(rows)
        numbers, q, load, *_ = places
        at, anchors = np.arange(len(q)), np.unique(np.append(np.arange(0, len(q), EVERY), len(q) - 1))
        known, x = _anchored(self._structure, self._equilibria, places.rows(anchors))
        if len(known):
            guess = np.column_stack([np.interp(at, anchors[known], column) for column in x.T])
            states, there = self._equilibria.near(numbers, q, load, *tips(guess, self._structure.d))
            leads = self._equilibria.leads(states.rows(slice(-1)), states.rows(slice(1, None)))
            self._states.write(rows, states)
            self._until[rows] = rows.start + _last_of_runs(np.append(leads & there[:-1] & there[1:], False))

    def skip(self, states: States, at: Index) -> Index:
        """Write states from rows on as far as they are known; the last rows written, or those where none are."""
        here = abs(self._states.rows(at).unknowns - states.rows(at).unknowns).max(axis=1) < ALIKE
        last = np.where(here, self._until[at], at)
        for begin, end in zip(at, last, strict=True):
            between = slice(begin + 1, end + 1)
            states.write(between, self._states.rows(between))
        return last


def _anchored(structure: Structure, equilibria: LoadedEquilibria, places: States) -> tuple[Index, Array]:
    """At which of a few places, in order, the load can be raised on unloaded equilibria; the unknowns there."""
    numbers, q, load, *_ = places
    rows = np.arange(len(q))
    unloaded = followed(structure, numbers[0], Passage(q, rows, rows == 0, len(q)), q, margins=False).x
    stands = np.flatnonzero(np.isfinite(unloaded).all(axis=1))
    free = equilibria.unloaded(numbers[stands], q[stands], tip_angles(unloaded[stands], structure.d))
    states, done = equilibria.along(free, q[stands], load[stands])
    return stands[done == 1], states.rows(done == 1).unknowns


def _last_of_runs(leads: Flags) -> Index:
    """For each of places (M,) the last that follows, where each that leads is followed by the next."""
    ends = np.where(leads, len(leads), np.arange(len(leads)))
    return np.minimum.accumulate(ends[::-1])[::-1]
