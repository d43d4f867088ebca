"""The equilibria that loaded robots are really in, along motions."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ctr_nlp.loads import Load, LoadOverTime
from ctr_nlp.models.elastic.equilibria import Equilibria
from ctr_nlp.models.loaded.acting import RodKind, eased
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.following.course import Course, course
from ctr_nlp.models.loaded.following.likely import Likely
from ctr_nlp.models.loaded.following.track import Track
from ctr_nlp.models.loaded.stability import least_margins, margins
from ctr_nlp.models.protocol import Followed, Passage, Snap
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Index

FEW = 12
"""Robots at most for which places are looked at side by side; more robots are so themselves."""
TURNING = 0.3
"""Part of the largest turn, of tips that leave a branch, from which on a tube is told to jump."""


class Follower:
    """Follows robots of numbers (N, d, 8), each under a load of its own, side by side; one object a thread."""

    def __init__(self, structure: Structure, numbers: Array, load: Load | LoadOverTime, acting: Array) -> None:
        """load: of which kind they all are; acting: the numbers of each, (N, M, 17 + 3d), at M places of a way."""
        self._structure, self._numbers, self._acting = structure, numbers, acting
        self._conservative = load.conservative
        self._elastic = [Equilibria(structure, own) for own in numbers]
        self.loaded = LoadedEquilibria(structure, RodKind.of(load))

    def settled(self, q: Array) -> tuple[Index, States]:
        """Which robots come to rest at q (N, 2d + 2) without a load and without a history; their states."""
        states = [elastic.settled(place) for elastic, place in zip(self._elastic, q, strict=True)]
        which = np.array([k for k, state in enumerate(states) if state is not None], dtype=int)
        tips = np.array([state.tips for state in states if state is not None])
        known = self._numbers[which], q[which], tips.reshape(len(which), self._numbers.shape[1])
        return which, self.loaded.unloaded(*known)

    def rest(self, q: Array) -> Array:
        """The unknowns (N, 2d + 2) there after the load has come; NaN of robots that snap on the way."""
        which, states = self.settled(q)
        states, done = self.loaded.along(states, q[which], self._acting[which, 0])
        found = np.full(q.shape, np.nan)
        found[which[done == 1]] = states.rows(done == 1).unknowns
        return found

    def followed(self, way: Passage, q: Array, with_margins: bool = True) -> list[Followed]:
        """Along ways through q (N, M, 2d + 2), before which the load comes and after which it goes.

        NaN from a snap to a fresh place.
        """
        places, count, total = course(way), len(q), way.total
        load = eased(self._acting[:, places.at], places.part)
        track = Track(places, self._numbers, q[:, places.at], load)
        robots = range(count)
        snaps = self._branches(places, track, robots)
        if with_margins:
            torn = [k for k in robots if not track.fill(self.loaded, k)]
            for k in torn:
                track.forget(k)
            if torn:
                snaps |= self._branches(places, track, torn)
        frames = (total * np.arange(count)[:, None] + places.frames).ravel()
        known, own = track.known, np.tile(places.own, count)
        here = np.flatnonzero(known & own)
        x, (at, between) = np.full((count * total, q.shape[2]), np.nan), np.full((2, count * total), np.nan)
        x[frames[here]] = track.states.rows(here).unknowns
        if with_margins and self._conservative:
            at[frames[here]] = margins(self.loaded, track.states.rows(here))
            way_there = np.flatnonzero(known & ~own & np.isfinite(at[frames]))
            between = least_margins(self.loaded, track.states.rows(way_there), frames[way_there], at)
        each = zip(np.split(x, count), np.split(at, count), np.split(between, count), strict=True)
        return [_followed(*one, snaps[k], self._numbers.shape[1]) for k, one in enumerate(each)]

    def _branches(self, places: Course, track: Track, robots: Sequence[int]) -> dict[int, list[Snap]]:
        """Follow some robots from station to station; where the branches of each end."""
        snaps = {k: list[Snap]() for k in robots}
        likely = Likely(self._structure, self.loaded, track.states) if len(robots) <= FEW else None
        begins = [*np.flatnonzero(places.fresh).tolist(), len(places.at)]
        for begin, end in itertools.pairwise(begins):
            which, start = self.settled(track.q(begin))
            kept = np.isin(which, robots)
            first = track.rows(which[kept], begin)
            track.states.write(first, start.rows(kept))
            if likely is not None:
                for row in first:
                    likely.look(track.stations(row, row + end - begin))
            for row, slopes in track.onwards(self.loaded, first, first + end - begin - 1, likely):
                robot, place = track.robot(row)
                snaps[robot].append(Snap(int(places.frames[place]) + 1, _leaving(slopes), None))
        return snaps


def _leaving(slopes: Array) -> tuple[int, ...]:
    """The tubes, from 1, whose tips turn most where a branch ends, by the slopes (d + 2, d + 2) there."""
    turn = np.linalg.svd(slopes)[2][-1][2:]
    apart = abs(turn - turn.mean())
    return tuple(int(i) + 1 for i in np.flatnonzero(apart >= TURNING * max(apart.max(), 1e-300)))


def _followed(x: Array, at: Array, between: Array, snaps: list[Snap], d: int) -> Followed:
    """A robot's unknowns x (T, 2d + 2) and margins (T,), with the angle of its innermost tube in one piece."""
    reached = np.isfinite(x[:, d - 1])
    x[reached, d - 1] = np.unwrap(x[reached, d - 1])
    snapped = [snap.frame - 1 for snap in snaps]
    between[snapped] = np.fmin(between[snapped], 0.0)
    return Followed(x, at, between, tuple(snaps))
