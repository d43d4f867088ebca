"""Loaded robots at the places of their schedules: followed from station to station, and filled in between.

Between two stations configuration and load change linearly, so that one long step, halved where it fails, replaces
many short ones.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.following.load_schedule import LoadSchedule
from ctr_nlp.models.loaded.following.station_guesses import StationGuesses
from ctr_nlp.typing import Array, Flags, Index

MAX_LINEAR_SECOND_DIFFERENCE = 1e-9
"""Largest second difference, rad, mm or N, up to which a change from place to place counts as linear."""


class StateTrack:
    """States of N robots at M places each, one robot's after the other's; NaN where none is known.

    Stations are frames, and places where a line ends.
    """

    def __init__(self, places: LoadSchedule, numbers: Array, q: Array, load: Array) -> None:
        """Prepare for numbers (N, d, 8), q (N, M, 2d + 2), load (N, M, l); places: the schedule."""
        self._count, self._length, _ = q.shape
        flat = (array.reshape(self._count * self._length, -1) for array in (q, load))
        self.states = States.unknown_states(np.repeat(numbers, self._length, axis=0), *flat)
        self._fresh = np.tile(places.fresh, self._count)
        self._stations = (
            places.is_frame | places.fresh | _find_line_ends(np.concatenate([q, load], axis=2))
        ).ravel()

    def rows(self, robots: Index, place: int) -> Index:
        """Return the rows of robots, by number, at a place."""
        return robots * self._length + place

    def robot(self, row: int) -> tuple[int, int]:
        """Return the number of the robot that a row belongs to, and that of its place."""
        return divmod(row, self._length)

    def q(self, place: int) -> Array:
        """Return the configurations (N, 2d + 2) of all robots at a place."""
        return self.states.q[self.rows(np.arange(self._count), place)]

    @property
    def is_known(self) -> Flags:
        """Whether the state of each row is known, (N M,)."""
        return np.isfinite(self.states.determinant)

    def stations(self, begin: int, end: int) -> Index:
        """Return the rows of stations from row `begin` to before row `end`."""
        return begin + np.flatnonzero(self._stations[begin:end])

    def follow_stations(
        self, equilibria: LoadedEquilibria, at: Index, last: Index, guesses: StationGuesses | None
    ) -> Iterator[tuple[int, Array]]:
        """Follow robots from rows `at` to rows `last`, from station to station.

        equilibria: solver of the robots' structure and kind of load. guesses: equilibria to which confirmed
        stretches may skip, or None. Yields the stations that branches do not reach, each with the slopes (d + 2, d
        + 2) where its branch ends.
        """
        states = self.states
        following = _next(self._stations)
        while True:
            # Rows that were guessed and confirmed cost nothing; the others take a step each, all in one batch.
            at = at if guesses is None else guesses.skip_confirmed(states, at)
            at, last = at[at < last], last[at < last]
            if not len(at):
                return
            ahead = following[at]
            reached, done = equilibria.follow_branches(states.rows(at), states.q[ahead], states.load[ahead])
            there = done == 1
            yield from zip(ahead[~there], reached.slopes[~there], strict=True)
            at = ahead[there]
            last = last[there]
            states.write(at, reached.rows(there))

    def fill(self, equilibria: LoadedEquilibria, robot: int) -> bool:
        """Find the states between stations of a robot, by number; return whether each place leads to the next one.

        equilibria: solver of the robots' structure and kind of load.
        """
        here = slice(robot * self._length, (robot + 1) * self._length)
        states = self.states.rows(here)
        stations = self._stations[here]
        known = self.is_known[here]
        # The last station at or before each place: from it the line leads through the place.
        before = np.maximum.accumulate(np.where(stations, np.arange(self._length), 0))
        wanted = np.flatnonzero(~stations & known[before] & known[_next(stations)])
        found, done = equilibria.follow_branches(
            states.rows(before[wanted]), states.q[wanted], states.load[wanted]
        )
        states.write(wanted[done == 1], found.rows(done == 1))
        self.states.write(here, states)
        known[wanted] = done == 1
        # A fresh place has no history: nothing leads to it.
        joined = np.flatnonzero(known[1:] & ~self._fresh[here][1:])
        return bool(done.all() and equilibria.branches_lead_to(states.rows(joined), states.rows(joined + 1)).all())

    def forget(self, robot: int) -> None:
        """Forget a robot's states, and make each of its places a station."""
        here = slice(robot * self._length, (robot + 1) * self._length)
        numbers, q, load, *_ = self.states.rows(here)
        self.states.write(here, States.unknown_states(numbers, q, load))
        self._stations[here] = True


def _find_line_ends(values: Array) -> Flags:
    """Return at which places (N, M) of values (N, M, k) a line ends; the first and last places count as such."""
    found = np.ones(values.shape[:2], dtype=bool)
    # Places are evenly spaced in time: on a line second differences are 0.
    found[:, 1:-1] = abs(np.diff(values, 2, axis=1)).max(axis=2, initial=0.0) > MAX_LINEAR_SECOND_DIFFERENCE
    return found


def _next(stations: Flags) -> Index:
    """Return the next station after each row; the last row where there is none."""
    rows = np.arange(len(stations))
    ends = np.where(stations, rows, len(rows) - 1)
    return np.append(np.minimum.accumulate(ends[::-1])[::-1][1:], len(rows) - 1)
