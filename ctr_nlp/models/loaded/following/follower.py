"""The equilibria that loaded robots are in along motions.

Under a load q has several equilibria, and the motion before decides which of them a robot is in. It is followed on
its branch from station to station (track.py), from where it settles without a load; a branch that ends is a snap,
after which it is not known where the robot comes to rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ctr_nlp.models.elastic.equilibria import Equilibria
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.following.load_schedule import LoadSchedule, schedule_load
from ctr_nlp.models.loaded.following.station_guesses import StationGuesses
from ctr_nlp.models.loaded.following.track import StateTrack
from ctr_nlp.models.loaded.rod_loads import RodKind, scale_loads
from ctr_nlp.models.loaded.stability import least_margins, margins
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.models.protocol import EquilibriumPath, MotionSubsteps, Snap
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Index

MAX_GUESSED_ROBOTS = 12
"""Most robots whose stations are guessed in a batch (station_guesses.py); more robots fill a batch by themselves.
"""
MIN_SNAP_TURN_SHARE = 0.3
"""Share of the largest turn of a tip, where a branch ends, from which on a tube is reported to jump."""


class Follower:
    """Follows N robots of numbers (N, d, 8), each under a load of its own, in batches.

    Not for several threads at once.
    """

    def __init__(self, structure: Structure, numbers: Array, load: Load | LoadOverTime, acting: Array) -> None:
        """Prepare for loads of the kind of `load`.

        acting (N, M, 17 + 3d): each robot's load at M places of a motion. structure: what the robots share.
        numbers (N, d, 8): of their tubes.
        """
        self._structure = structure
        self._numbers = numbers
        self._acting = acting
        self._conservative = load.conservative
        self._elastic = [Equilibria(structure, own) for own in numbers]
        self.loaded = LoadedEquilibria(structure, RodKind.of(load))

    def rest_without_load(self, q: Array) -> tuple[Index, States]:
        """Return which robots come to rest at q (N, 2d + 2) without a load and a history, and their states."""
        states = [elastic.find_rest_state(place) for elastic, place in zip(self._elastic, q, strict=True)]
        which = np.array([k for k, state in enumerate(states) if state is not None], dtype=int)
        tips = np.array([state.tips for state in states if state is not None])
        known = self._numbers[which], q[which], tips.reshape(len(which), self._numbers.shape[1])
        return which, self.loaded.solve_unloaded(*known)

    def rest(self, q: Array) -> Array:
        """Return the unknowns (N, 2d + 2) at q after the load has grown to its full size.

        NaN of robots that snap before.
        """
        which, states = self.rest_without_load(q)
        states, done = self.loaded.follow_branches(states, q[which], self._acting[which, 0])
        found = np.full(q.shape, np.nan)
        found[which[done == 1]] = states.rows(done == 1).unknowns
        return found

    def follow_motion(self, motion: MotionSubsteps, q: Array, with_margins: bool = True) -> list[EquilibriumPath]:
        """Follow robots along motions through q (N, M, 2d + 2), with the load applied before and removed after.

        motion: which frames the M sub-steps belong to. with_margins: whether stability margins are computed.
        Unknowns are NaN from a snap to the next fresh place.
        """
        places = schedule_load(motion)
        count = len(q)
        total = motion.total
        load = scale_loads(self._acting[:, places.at], places.load_fraction)
        track = StateTrack(places, self._numbers, q[:, places.at], load)
        robots = range(count)
        # First from station to station alone, which is enough for unknowns; margins are wanted at all places.
        snaps = self._branches(places, track, robots)
        if with_margins:
            # Long steps may have passed from one branch to another unseen: where places in between do not join up,
            # the robot is followed again, place by place.
            torn = [k for k in robots if not track.fill(self.loaded, k)]
            for k in torn:
                track.forget(k)
            if torn:
                snaps |= self._branches(places, track, torn)
        frames = (total * np.arange(count)[:, None] + places.frames).ravel()
        known = track.is_known
        own = np.tile(places.is_frame, count)
        here = np.flatnonzero(known & own)
        x, (at, between) = np.full((count * total, q.shape[2]), np.nan), np.full((2, count * total), np.nan)
        x[frames[here]] = track.states.rows(here).unknowns
        # A load without an energy has no margin.
        if with_margins and self._conservative:
            at[frames[here]] = margins(self.loaded, track.states.rows(here))
            way_there = np.flatnonzero(known & ~own & np.isfinite(at[frames]))
            between = least_margins(self.loaded, track.states.rows(way_there), frames[way_there], at)
        each = zip(np.split(x, count), np.split(at, count), np.split(between, count), strict=True)
        return [_assemble_path(*one, snaps[k], self._numbers.shape[1]) for k, one in enumerate(each)]

    def _branches(self, places: LoadSchedule, track: StateTrack, robots: Sequence[int]) -> dict[int, list[Snap]]:
        """Follow robots, by number, from station to station; return the snaps where branches of each end."""
        snaps = {k: list[Snap]() for k in robots}
        likely = (
            StationGuesses(self._structure, self.loaded, track.states)
            if len(robots) <= MAX_GUESSED_ROBOTS
            else None
        )
        # Stretches between fresh places are followed one after the other; robots side by side.
        begins = [*np.flatnonzero(places.fresh).tolist(), len(places.at)]
        for begin, end in itertools.pairwise(begins):
            which, start = self.rest_without_load(track.q(begin))
            kept = np.isin(which, robots)
            first = track.rows(which[kept], begin)
            track.states.write(first, start.rows(kept))
            if likely is not None:
                for row in first:
                    likely.guess_stations(track.stations(row, row + end - begin))
            for row, slopes in track.follow_stations(self.loaded, first, first + end - begin - 1, likely):
                robot, place = track.robot(row)
                snaps[robot].append(Snap(int(places.frames[place]) + 1, _snapping_tubes(slopes), None))
        return snaps


def _snapping_tubes(slopes: Array) -> tuple[int, ...]:
    """Return the tubes, from 1, whose tips turn most where a branch ends, by the slopes (d + 2, d + 2) there."""
    # At the end of a branch slopes are singular: the right singular vector of the least value is the change of the
    # tip that no motor feels. Its first two entries are turns of the frame.
    turn = np.linalg.svd(slopes)[2][-1][2:]
    # Turning all tubes alike turns the robot; it does not snap by that.
    apart = abs(turn - turn.mean())
    return tuple(int(i) + 1 for i in np.flatnonzero(apart >= MIN_SNAP_TURN_SHARE * max(apart.max(), 1e-300)))


def _assemble_path(x: Array, at: Array, between: Array, snaps: list[Snap], d: int) -> EquilibriumPath:
    """Assemble the path of one robot from its unknowns x (T, 2d + 2) and margins at and between frames (T,).

    The angle of its innermost tube is made continuous over frames. Where it snaps, the least margin between frames
    is at most 0.
    """
    reached = np.isfinite(x[:, d - 1])
    # Whole turns of all tubes are the same shape: unwrapped, neighbouring frames have unknowns that can be
    # interpolated.
    x[reached, d - 1] = np.unwrap(x[reached, d - 1])
    snapped = [snap.frame - 1 for snap in snaps]
    between[snapped] = np.fmin(between[snapped], 0.0)
    return EquilibriumPath(x, at, between, tuple(snaps))
