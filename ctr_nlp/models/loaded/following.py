"""The equilibria that a loaded robot is really in, along motions."""

from __future__ import annotations

import numpy as np

from ctr_nlp.loads import Load
from ctr_nlp.models.elastic.equilibria import Equilibria
from ctr_nlp.models.loaded.course import Course, course
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.stability import margins
from ctr_nlp.models.loaded.tips import tips
from ctr_nlp.models.protocol import Followed, Passage, Snap
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array

TURNING = 0.3
"""Part of the largest turn, of tips that leave a branch, from which on a tube is told to jump."""


class Follower:
    """Follows one robot of numbers (d, 6) that bears a load; one object a thread."""

    def __init__(self, structure: Structure, numbers: Array, load: Load, acting: Array) -> None:
        """acting: the load's numbers (7 + 3d,)."""
        self._elastic, self._d = Equilibria(structure, numbers), structure.d
        self.loaded = LoadedEquilibria(structure, numbers, load.follows)
        self._acting, self._conservative = acting[None], load.conservative

    def settled(self, q: Array) -> States | None:
        """Where the robot comes to rest at q (2d + 2,) without a load and without a history."""
        state = self._elastic.settled(q)
        return None if state is None else self.loaded.unloaded(q[None], state.tips[None])

    def rest(self, q: Array) -> Array:
        """The unknowns (2d + 2,) there after the load has come; NaN where the robot snaps on the way."""
        state = self.settled(q)
        if state is not None:
            state, done = self.loaded.along(state, q[None], self._acting)
            if done[0] == 1:
                return state.unknowns[0]
        return np.full(len(q), np.nan)

    def margins(self, x: Array) -> Array:
        """The stability margins (T,) of unknowns x (T, 2d + 2); NaN under a load that has no energy."""
        found, known = np.full(len(x), np.nan), np.isfinite(x).all(axis=1)
        if self._conservative and known.any():
            found[known] = margins(self.loaded, self.states(x[known]))
        return found

    def states(self, x: Array) -> States:
        """The states of unknowns x (T, 2d + 2), each an equilibrium of its own configuration."""
        d, load = self._d, np.repeat(self._acting, len(x), axis=0)
        angles, axes = tips(x, d)
        q = self.loaded.configurations(angles, axes, x[:, d : 2 * d], load)
        slopes = self.loaded.ends(angles, axes, q, load).slopes
        return States(q, load, angles, axes, slopes, np.linalg.det(slopes))

    def followed(self, way: Passage, with_margins: bool = True) -> Followed:
        """Along a way, before which the load comes and after which it goes; NaN from a snap to a fresh place."""
        places = course(way)
        found, snaps = self._places(places)
        stability = np.full(len(places.q), np.nan)
        known = np.array([state is not None for state in found], dtype=bool)
        x = np.full(places.q.shape, np.nan)
        if known.any():
            states = _joined([state for state in found if state is not None])
            x[known] = states.unknowns
            if with_margins and self._conservative:
                stability[known] = margins(self.loaded, states)
        return _at_frames(way, places, x, stability, snaps, self._d)

    def _places(self, places: Course) -> tuple[list[States | None], tuple[Snap, ...]]:
        """The states at every place, and where branches end."""
        found, snaps, state = list[States | None](), list[Snap](), None
        for q, part, frame, fresh in zip(places.q, places.part, places.frames, places.fresh, strict=True):
            if fresh:
                state = self.settled(q)
            elif state is not None:
                reached, done = self.loaded.along(state, q[None], part * self._acting)
                if done[0] < 1:
                    snaps.append(Snap(int(frame) + 1, self._leaving(reached), None))
                state = reached if done[0] == 1 else None
            found.append(state)
        return found, tuple(snaps)

    def _leaving(self, state: States) -> tuple[int, ...]:
        """The tubes, from 1, whose tips turn most where a branch ends."""
        turn = np.linalg.svd(state.slopes[0])[2][-1][2:]
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
