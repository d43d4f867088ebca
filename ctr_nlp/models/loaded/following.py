"""The equilibria that loaded robots are really in, along motions."""

from __future__ import annotations

import numpy as np

from ctr_nlp.loads import Load, LoadOverTime
from ctr_nlp.models.elastic.equilibria import Equilibria
from ctr_nlp.models.loaded.acting import RodKind, eased
from ctr_nlp.models.loaded.course import Course, course
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.stability import margins
from ctr_nlp.models.protocol import Followed, Passage, Snap
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Index

TURNING = 0.3
"""Part of the largest turn, of tips that leave a branch, from which on a tube is told to jump."""


class Follower:
    """Follows robots of numbers (N, d, 6), each under a load of its own, side by side; one object a thread."""

    def __init__(self, structure: Structure, numbers: Array, load: Load | LoadOverTime, acting: Array) -> None:
        """load: of which kind they all are; acting: the numbers of each, (N, 12 + 3d), or (N, M, 12 + 3d) at every
        place of a way.
        """
        self._numbers, self._acting, self._conservative = numbers, acting, load.conservative
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
        places = course(way)
        found, snaps = self._places(places, q[:, places.at])
        x = np.full((len(q), len(places.at), q.shape[2]), np.nan)
        stability = np.full(x.shape[:2], np.nan)
        if found:
            at = np.repeat(np.arange(len(found)), [len(which) for which, _ in found])
            which, states = np.concatenate([which for which, _ in found]), _joined([each for _, each in found])
            x[which, at] = states.unknowns
            if with_margins and self._conservative:
                stability[which, at] = margins(self.loaded, states)
        rows = zip(x, stability, snaps, strict=True)
        return [_at_frames(way, places, *row, self._numbers.shape[1]) for row in rows]

    def _places(self, places: Course, q: Array) -> tuple[list[tuple[Index, States]], list[tuple[Snap, ...]]]:
        """Which robots stand at every place q (N, M, 2d + 2), and their states; where the branches of each end."""
        found, snaps = list[tuple[Index, States]](), [list[Snap]() for _ in q]
        for j, (part, frame, fresh) in enumerate(zip(places.part, places.frames, places.fresh, strict=True)):
            if fresh:
                which, states = self.settled(q[:, j])
            else:
                reached, done = self.loaded.along(states, q[which, j], eased(self._at(places.at[j])[which], part))
                for k in np.flatnonzero(done < 1):
                    snaps[which[k]].append(Snap(int(frame) + 1, _leaving(reached.slopes[k]), None))
                which, states = which[done == 1], reached.rows(done == 1)
            found.append((which, states))
        return found, [tuple(each) for each in snaps]


def _leaving(slopes: Array) -> tuple[int, ...]:
    """The tubes, from 1, whose tips turn most where a branch ends, by the slopes (d + 2, d + 2) there."""
    turn = np.linalg.svd(slopes)[2][-1][2:]
    apart = abs(turn - turn.mean())
    return tuple(int(i) + 1 for i in np.flatnonzero(apart >= TURNING * max(apart.max(), 1e-300)))


def _joined(states: list[States]) -> States:
    return States(*(np.concatenate(arrays) for arrays in zip(*states, strict=True)))


def _at_frames(
    way: Passage, places: Course, x: Array, stability: Array, snaps: tuple[Snap, ...], d: int
) -> Followed:
    """Unknowns x (M, 2d + 2) and margins (M,) of places as those of frames, and the least on the way there."""
    here, (at, between) = np.full((way.total, x.shape[1]), np.nan), np.full((2, way.total), np.nan)
    frames = places.frames[places.own]
    here[frames], at[frames], between[frames] = x[places.own], stability[places.own], np.inf
    np.fmin.at(between, places.frames, stability)
    np.minimum.at(between, [snap.frame - 1 for snap in snaps], 0.0)
    reached = np.isfinite(here[:, d - 1])
    here[reached, d - 1] = np.unwrap(here[reached, d - 1])
    return Followed(here, at, np.where(np.isfinite(at), between, np.nan), snaps)
