"""The equilibria of the elastic model that a robot would really be in: numbers, along motions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.models import dominant
from ctr_nlp.models.elastic import shape as elastic
from ctr_nlp.models.elastic import stability, torsion
from ctr_nlp.models.elastic.equilibria import Branches, State
from ctr_nlp.robot import Robot
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array, Vector

SUBSTEPS = 10
JUMP = 0.1
"""rad: a tip that turns less while the robot leaves a branch has not snapped."""


class Snap(NamedTuple):
    """frame: on the way to which, from 1. tubes: whose tips jump, from 1. jump: of the one furthest, rad."""

    frame: int
    tubes: tuple[int, ...]
    jump: float


class Followed(NamedTuple):
    """A robot's equilibria x (T, 2d + 2) along a motion; NaN where q is or where none is found.

    stability (T,): margins at frames; stability_between (T,): least margins on the way from the frame before, at
    most 0 where the robot snaps.
    """

    x: Array
    stability: Array
    stability_between: Array
    snaps: tuple[Snap, ...]


def untwisted(robot: Robot, q: Array) -> Array:
    """Starts x (.., 2d + 2) for solvers at q (.., 2d + 2): tubes have their motors' angles all along."""
    x = np.array(q, dtype=float)
    x[..., : robot.d - 1] -= x[..., robot.d - 1 : robot.d]
    return x


def configuration(robot: Robot, x: Array) -> Array:
    """The configurations q (T, 2d + 2) of equilibria x (T, 2d + 2)."""
    columns, d = dominant.columns_of(x), robot.d
    twisted = torsion.twist(robot, columns, torsion.sections(robot, columns[d : 2 * d], np), np)
    return np.hstack([*torsion.motors(robot, columns, twisted), *columns[d:]])


def shapes(robot: Robot, x: Array, sigma: Array = SIGMA) -> Array:
    """Points (T, n, 3) in mm of the elastic model at x (T, 2d + 2) and sigma (n,) or (T, n)."""
    columns, d = dominant.columns_of(x), robot.d
    parts = torsion.sections(robot, columns[d : 2 * d], np)
    lengths, _ = elastic.arms(robot, columns[d : 2 * d], parts, sigma * columns[2 * d - 1], np)
    vectors = elastic.curves(robot, columns, parts, torsion.twist(robot, columns, parts, np), np)
    travelled = np.stack([np.broadcast_to(length, (len(x), np.shape(sigma)[-1])) for length in lengths], axis=-1)
    directions, base = (
        np.concatenate([_stacked(vector, len(x), 1) for vector in some], axis=1)
        for some in (vectors, elastic.turned_base(robot, columns, np))
    )
    return np.asarray(travelled @ (directions @ base))


def tangents(robot: Robot, x: Array, sigma: Array = SIGMA) -> Array:
    """Unit tangents (T, n, 3) of the elastic model at x (T, 2d + 2) and sigma (n,)."""
    return _stacked(elastic.backbone(robot, dominant.columns_of(x), sigma, np).tangents, len(x), len(sigma))


def _stacked(vector: Vector, *shape: int) -> Array:
    return np.stack([np.broadcast_to(part, shape) for part in vector], axis=-1)


def settled(robot: Robot, q: Array) -> Array:
    """The equilibrium x (2d + 2,) at q (2d + 2,) without a history: all tubes turned together from alpha_d.

    NaN where none is found.
    """
    state = Branches(robot).settled(q)
    return np.full(len(q), np.nan) if state is None else state.x


def follow(robot: Robot, q: Array, x0: Array | None = None, substeps: int = SUBSTEPS) -> Followed:
    """The equilibria of a robot moved through frames q (T, 2d + 2), linearly and in so many substeps between them.

    x0: the equilibrium of the first frame, which may be unstable; else it is settled. After frames that are NaN
    the robot settles anew. An unstable branch that the motion starts on is followed as long as it exists.
    """
    branches, state, q = Branches(robot), None, np.asarray(q, dtype=float)
    x, snaps = np.full(q.shape, np.nan), list[Snap]()
    passed, frames = [x[:0]], list[int]()
    for j, goal in enumerate(q):
        if state is None or not np.isfinite(goal).all():
            state, way = _start(branches, goal, x0 if j == 0 else None), goal[None]
        else:
            way = np.linspace(q[j - 1], goal, substeps + 1)[1:]
        for place in way:
            if state is not None:
                state, jumps = branches.followed(state, place)
                snaps += [_snap(j + 1, jump) for jump in jumps if abs(jump).max() > JUMP]
            if state is not None:
                passed.append(state.x[None])
                frames.append(j)
        if state is not None:
            x[j] = state.x
    return _rated(robot, x, np.vstack(passed), frames, tuple(snaps))


def _start(branches: Branches, q: Array, x0: Array | None) -> State | None:
    if not np.isfinite(q).all():
        return None
    return branches.settled(q) if x0 is None else branches.nearest(q, x0)


def _snap(frame: int, jump: Array) -> Snap:
    return Snap(frame, tuple(int(i) + 1 for i in np.flatnonzero(abs(jump) > JUMP)), float(abs(jump).max()))


def _rated(robot: Robot, x: Array, passed: Array, frames: list[int], snaps: tuple[Snap, ...]) -> Followed:
    """Equilibria at frames with the margins of all that were passed, and on the way to which frame."""
    margins, between = stability.margins(robot, passed), np.full(len(x), np.inf)
    np.minimum.at(between, frames, margins)
    np.minimum.at(between, [snap.frame - 1 for snap in snaps], 0.0)
    known, at = np.isfinite(x[:, 0]), np.full(len(x), np.nan)
    at[frames] = margins
    return Followed(x, np.where(known, at, np.nan), np.where(known, between, np.nan), snaps)
