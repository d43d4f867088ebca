"""The equilibria that loaded robots are really in, along motions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ctr_nlp.loads import Load, LoadOverTime
from ctr_nlp.models.elastic.equilibria import Equilibria
from ctr_nlp.models.loaded.acting import RodKind, eased
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.following.course import Course, course
from ctr_nlp.models.loaded.following.likely import Likely
from ctr_nlp.models.loaded.stability import least_margins, margins
from ctr_nlp.models.protocol import Followed, Passage, Snap
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Index

FEW = 12
"""Robots at most for which places are looked at side by side; more robots are so themselves."""
TURNING = 0.3
"""Part of the largest turn, of tips that leave a branch, from which on a tube is told to jump."""


class Follower:
    """Follows robots of numbers (N, d, 6), each under a load of its own, side by side; one object a thread."""

    def __init__(self, structure: Structure, numbers: Array, load: Load | LoadOverTime, acting: Array) -> None:
        """load: of which kind they all are; acting: the numbers of each, (N, 12 + 3d), or (N, M, 12 + 3d) at every
        place of a way.
        """
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

    def _at(self, place: int) -> Array:
        """The numbers (N, 12 + 3d) at a place of a way."""
        return self._acting if self._acting.ndim == 2 else self._acting[:, place]

    def rest(self, q: Array) -> Array:
        """The unknowns (N, 2d + 2) there after the load has come; NaN of robots that snap on the way."""
        which, states = self.settled(q)
        states, done = self.loaded.along(states, q[which], self._at(0)[which])
        found = np.full(q.shape, np.nan)
        found[which[done == 1]] = states.rows(done == 1).unknowns
        return found

    def followed(self, way: Passage, q: Array, with_margins: bool = True) -> list[Followed]:
        """Along ways through q (N, M, 2d + 2), before which the load comes and after which it goes.

        NaN from a snap to a fresh place.
        """
        places, count, total = course(way), len(q), way.total
        states, snaps = self._branches(places, q[:, places.at])
        frames = (total * np.arange(count)[:, None] + places.frames).ravel()
        known, own = np.isfinite(states.determinant), np.tile(places.own, count)
        here = np.flatnonzero(known & own)
        x, (at, between) = np.full((count * total, q.shape[2]), np.nan), np.full((2, count * total), np.nan)
        x[frames[here]] = states.rows(here).unknowns
        if with_margins and self._conservative:
            at[frames[here]] = margins(self.loaded, states.rows(here))
            way_there = np.flatnonzero(known & ~own & np.isfinite(at[frames]))
            between = least_margins(self.loaded, states.rows(way_there), frames[way_there], at)
        each = zip(np.split(x, count), np.split(at, count), np.split(between, count), snaps, strict=True)
        return [_followed(*one, self._numbers.shape[1]) for one in each]

    def _branches(self, places: Course, q: Array) -> tuple[States, list[tuple[Snap, ...]]]:
        """The states of robots at places q (N, M, 2d + 2), one robot's after the other's, and where branches end.

        Those of the k-th place of a robot are not numbers where it has snapped before.
        """
        count, length, _ = q.shape
        acting = self._acting[:, None] if self._acting.ndim == 2 else self._acting[:, places.at]
        load = eased(np.broadcast_to(acting, (count, length, acting.shape[2])), places.part)
        flat = (array.reshape(count * length, -1) for array in (q, load))
        states = States.nowhere(np.repeat(self._numbers, length, axis=0), *flat)
        snaps = [list[Snap]() for _ in q]
        likely = Likely(self._structure, self.loaded, states) if count <= FEW else None
        begins = np.flatnonzero(places.fresh)
        for begin, end in zip(begins, np.append(begins[1:], length), strict=True):
            which, start = self.settled(q[:, begin])
            first = which * length + begin
            states.write(first, start)
            if likely is not None:
                for row in first:
                    likely.look(slice(row, row + end - begin))
            for row, slopes in self._onwards(states, first, first + end - begin - 1, likely):
                robot, place = divmod(row, length)
                snaps[robot].append(Snap(int(places.frames[place]) + 1, _leaving(slopes), None))
        return states, [tuple(each) for each in snaps]

    def _onwards(
        self, states: States, at: Index, last: Index, likely: Likely | None
    ) -> Iterator[tuple[int, Array]]:
        """Follow robots from rows of states to others, and write those between; rows that branches do not lead to,
        with the slopes (d + 2, d + 2) where they end.
        """
        while True:
            at = at if likely is None else likely.skip(states, at)
            at, last = at[at < last], last[at < last]
            if not len(at):
                return
            reached, done = self.loaded.along(states.rows(at), states.q[at + 1], states.load[at + 1])
            there = done == 1
            yield from zip(at[~there] + 1, reached.slopes[~there], strict=True)
            at, last = at[there] + 1, last[there]
            states.write(at, reached.rows(there))


def _leaving(slopes: Array) -> tuple[int, ...]:
    """The tubes, from 1, whose tips turn most where a branch ends, by the slopes (d + 2, d + 2) there."""
    turn = np.linalg.svd(slopes)[2][-1][2:]
    apart = abs(turn - turn.mean())
    return tuple(int(i) + 1 for i in np.flatnonzero(apart >= TURNING * max(apart.max(), 1e-300)))


def _followed(x: Array, at: Array, between: Array, snaps: tuple[Snap, ...], d: int) -> Followed:
    """A robot's unknowns x (T, 2d + 2) and margins (T,), with the angle of its innermost tube in one piece."""
    reached = np.isfinite(x[:, d - 1])
    x[reached, d - 1] = np.unwrap(x[reached, d - 1])
    snapped = [snap.frame - 1 for snap in snaps]
    between[snapped] = np.fmin(between[snapped], 0.0)
    return Followed(x, at, between, snaps)
