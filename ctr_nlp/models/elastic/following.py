"""The equilibria that a robot is really in, along motions."""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.elastic import stability
from ctr_nlp.models.elastic.compiled import compiled
from ctr_nlp.models.elastic.equilibria import Equilibria, State
from ctr_nlp.models.protocol import SUBSTEPS, Followed, Snap
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import NUMBERS, Structure, tubes_of
from ctr_nlp.typing import Array

JUMP = 0.1
"""rad: a tip that turns less while the robot leaves a branch has not snapped."""


def settled(robot: Robot, q: Array) -> Array:
    """The equilibrium x (2d + 2,) at q (2d + 2,) without a history: all tubes turned together from alpha_d.

    NaN where none is found.
    """
    state = Equilibria(robot.structure, robot.numbers).settled(q)
    return np.full(len(q), np.nan) if state is None else state.x


def settled_apart(structure: Structure, numbers: Array, q: Array) -> tuple[Array, Array]:
    """Equilibria x (T, 2d + 2) without a history of robots that differ in numbers (T, d, 6), and margins (T,).

    q (T, 2d + 2): a configuration for each. numbers: in the order of structure.NUMBERS. NaN where none is found.
    """
    x, code = np.full(q.shape, np.nan), compiled(structure)
    known = np.flatnonzero(np.isfinite(q).all(axis=1))
    if code is None:
        for row in known:
            state = Equilibria(structure, numbers[row]).settled(q[row])
            x[row] = np.nan if state is None else state.x
    else:
        flat = np.ascontiguousarray(numbers.swapaxes(1, 2)[known]).reshape(len(known), structure.d * len(NUMBERS))
        states, found = code.settle(flat, q[known])
        x[known[found]] = np.ctypeslib.as_array(states)["x"][found, : q.shape[1]]
    columns = numbers.transpose(1, 2, 0)[..., None]
    return x, stability.margins(tubes_of(structure, [list(tube) for tube in columns]), x)


def follow(robot: Robot, q: Array, x0: Array | None = None, substeps: int = SUBSTEPS) -> Followed:
    """The equilibria of a robot moved through frames q (T, 2d + 2), linearly and in so many substeps between them.

    x0: the equilibrium of the first frame, which may be unstable; else it is settled. After frames that are NaN
    the robot settles anew. An unstable branch that the motion starts on is followed as long as it exists.
    """
    equilibria, state = Equilibria(robot.structure, robot.numbers), None
    q = np.asarray(q, dtype=float)
    x, snaps = np.full(q.shape, np.nan), list[Snap]()
    passed, frames = [x[:0]], list[int]()
    for j, goal in enumerate(q):
        if state is None or not np.isfinite(goal).all():
            state, passage = _start(equilibria, goal, x0 if j == 0 else None), goal[None]
        else:
            passage = np.linspace(q[j - 1], goal, substeps + 1)[1:]
        while state is not None and len(passage):
            found, state = equilibria.walked(state, passage)
            passage = passage[len(found) :]
            if len(passage):
                state, jumps = equilibria.followed(state, passage[0])
                snaps += [_snap(j + 1, jump) for jump in jumps if abs(jump).max() > JUMP]
                found = found if state is None else np.vstack([found, state.x])
                passage = passage[1:]
            passed.append(found)
            frames += [j] * len(found)
        if state is not None:
            x[j] = state.x
    return _rated(robot, x, np.vstack(passed), frames, tuple(snaps))


def _start(equilibria: Equilibria, q: Array, x0: Array | None) -> State | None:
    if not np.isfinite(q).all():
        return None
    return equilibria.settled(q) if x0 is None else equilibria.nearest(q, x0)


def _snap(frame: int, jump: Array) -> Snap:
    return Snap(frame, tuple(int(i) + 1 for i in np.flatnonzero(abs(jump) > JUMP)), float(abs(jump).max()))


def _rated(robot: Robot, x: Array, passed: Array, frames: list[int], snaps: tuple[Snap, ...]) -> Followed:
    """Equilibria at frames with the margins of all that were passed, and on the way to which frame."""
    margins, between = stability.margins(robot.tube_numbers, passed), np.full(len(x), np.inf)
    np.minimum.at(between, frames, margins)
    np.minimum.at(between, [snap.frame - 1 for snap in snaps], 0.0)
    known, at = np.isfinite(x[:, 0]), np.full(len(x), np.nan)
    at[frames] = margins
    return Followed(x, np.where(known, at, np.nan), np.where(known, between, np.nan), snaps)
