"""The equilibria that a robot is in along motions: which of several it is in depends on how it came there.

Branches are followed by path following (equilibria.py) from sub-step to sub-step; where one ends, the robot snaps.
x are unknowns (rad, mm), q configurations (rad, mm), margins have no unit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_nlp.codegen.cache import vector_lanes
from ctr_nlp.models.elastic.equilibria import Equilibria, EquilibriumState, walk_robot_batch
from ctr_nlp.models.protocol import (
    STABILITY_SUBSTEPS_PER_FRAME,
    EquilibriumPath,
    MotionSubsteps,
    Snap,
    subdivide_motion,
)
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array

MIN_ELASTIC_SNAP_JUMP_RAD = 0.1
"""Angle in rad: a tip that turns by less while the robot leaves a branch has not snapped."""


def solve_rest_unknowns(robot: Robot, q: Array) -> Array:
    """Return the equilibrium x (2d + 2,) of a robot at rest at q (2d + 2,), all tubes turned there from alpha_d.

    NaN where none is found.
    """
    state = Equilibria(robot.structure, robot.numbers).find_rest_state(q)
    return np.full(len(q), np.nan) if state is None else state.x


def solve_rest_batch(structure: Structure, numbers: Array, q: Array) -> Array:
    """Return equilibria x (T, 2d + 2) at rest, of robots that differ in numbers (T or 1, d, 8), one by one.

    structure: what the robots share. q (T, 2d + 2): a configuration for each. NaN where none is found.
    """
    x = np.full(q.shape, np.nan)
    for row, at in enumerate(q):
        # A row that is NaN was never reached, and no equilibrium is looked for.
        if np.isfinite(at).all():
            state = Equilibria(structure, numbers[row if len(numbers) > 1 else 0]).find_rest_state(at)
            x[row] = np.nan if state is None else state.x
    return x


def follow(
    robot: Robot, q: Array, x0: Array | None = None, substeps: int = STABILITY_SUBSTEPS_PER_FRAME
) -> EquilibriumPath:
    """Return the equilibria of a robot moved through frames q (T, 2d + 2), linearly and in substeps between them.

    x0: the equilibrium of the first frame, which may be unstable; None to let the robot settle there. After frames
    that are NaN it settles again. An unstable branch that the motion starts on is followed as long as it exists.
    """
    q = np.asarray(q, dtype=float)
    way = subdivide_motion(q, substeps)
    return follow_substeps(robot.structure, robot.numbers, way, way.q, x0)


def follow_robot_batch(
    structure: Structure, numbers: Array, motion: MotionSubsteps, places: Array, margins: bool = True
) -> list[EquilibriumPath]:
    """Return the equilibria of robots of numbers (n, d, 8), each at its own q at the sub-steps of a motion.

    structure: what the robots share. motion: which frames the M sub-steps belong to. places (n, M, 2d + 2): these
    q. margins: whether stability margins are computed. As many robots as a vector has lanes are followed in one
    batch as far as whole steps suffice, and continue one by one from there.
    """
    # In a batch only up to the first fresh start, since robots settle one by one.
    stop, *_ = [*np.flatnonzero(motion.fresh[1:]) + 1, len(motion.fresh)]
    x, stable = np.full(places.shape, np.nan), np.full(places.shape[:2], np.nan)
    snaps = [list[Snap]() for _ in numbers]
    for first in range(0, len(numbers), vector_lanes()):
        group = slice(first, first + vector_lanes())
        begun = walk_robot_batch(structure, numbers[group], places[group, :stop])
        for k, known in enumerate(begun, first):
            equilibria = Equilibria(structure, numbers[k])
            _follow_places(equilibria, motion, places[k], None, known, x[k], snaps[k])
            if margins:
                stable[k] = equilibria.margins(x[k])
    return _at_frames(motion, x, stable, snaps)


def follow_substeps(
    structure: Structure,
    numbers: Array,
    motion: MotionSubsteps,
    places: Array,
    x0: Array | None = None,
    margins: bool = True,
) -> EquilibriumPath:
    """Return the equilibria of a robot of numbers (d, 8) at its own q at the sub-steps of a motion.

    structure: kinds of its tubes. motion: which frames the M sub-steps belong to. places (M, 2d + 2): these q. x0:
    its equilibrium in the first frame, None to let it settle. margins: whether stability margins are computed.
    """
    equilibria = Equilibria(structure, numbers)
    x = np.full(places.shape, np.nan)
    snaps = list[Snap]()
    _follow_places(equilibria, motion, places, x0, None, x, snaps)
    stable = equilibria.margins(x) if margins else np.full(len(x), np.nan)
    (found,) = _at_frames(motion, x[None], stable[None], [snaps])
    return found


def _follow_places(
    equilibria: Equilibria,
    motion: MotionSubsteps,
    places: Array,
    x0: Array | None,
    solved_start: tuple[Array, EquilibriumState] | None,
    x: Array,
    snaps: list[Snap],
) -> None:
    """Write the equilibria at the sub-steps of a motion, places (M, 2d + 2), to x, and append to snaps.

    x0: the equilibrium in the first frame, None to let the robot settle. solved_start: equilibria (k, 2d + 2) at
    the first sub-steps, k > 0, and the last state; None where none is known.
    """
    # The last sub-step of each sub-step's frame: a robot that failed settles again at a whole frame, not within
    # one.
    last = np.searchsorted(motion.frames, motion.frames, side="right") - 1
    at = 0
    state = None
    if solved_start is not None:
        known, state = solved_start
        x[: len(known)], at = known, len(known) - 1
    while at < len(places):
        if state is None:
            # Nothing is known of what was before. Only of the first frame an equilibrium may be given; everywhere
            # else the robot is turned there from aligned tubes.
            first = x0 if motion.frames[at] == 0 else None
            state = (
                equilibria.find_rest_state(places[at]) if first is None else equilibria.nearest(places[at], first)
            )
        if state is not None:
            at, state = _branches(equilibria, motion, places, at, state, x, snaps)
        if state is None:  # it settles again in the next frame
            after = last[min(at, len(last) - 1)] + 1
            at = len(last) if after == len(last) else last[after]
        state = None


def _branches(
    equilibria: Equilibria,
    way: MotionSubsteps,
    places: Array,
    at: int,
    state: EquilibriumState | None,
    x: Array,
    snaps: list[Snap],
) -> tuple[int, EquilibriumState | None]:
    """Follow one branch after the other from place `at` to the next fresh start.

    Writes equilibria to x and appends to snaps. Returns the place reached, and the state there; None where no
    equilibrium was found.
    """
    assert state is not None
    fresh = np.flatnonzero(way.fresh[at + 1 :])
    stop = at + 1 + fresh[0] if len(fresh) else len(places)
    x[at], at = state.x, at + 1
    while at < stop:
        # Whole steps cost least, and are taken as far as Newton's method leads on. The step at which it fails is
        # made shorter until the branch is found again, or ends in a fold: there the robot snaps.
        found, state = equilibria.walk_through_goals(state, places[at:stop])
        x[at : at + len(found)] = found
        at += len(found)
        if at < stop:
            state, jumps = equilibria.follow_to_goal(state, places[at])
            snaps += [
                _snap(int(way.frames[at]) + 1, jump)
                for jump in jumps
                if abs(jump).max() > MIN_ELASTIC_SNAP_JUMP_RAD
            ]
            if state is None:
                return at, None
            x[at], at = state.x, at + 1
    return at, state


def _snap(frame: int, jump: Array) -> Snap:
    """Return the record of a snap before a frame, from the angles (d,) by which the tips jumped."""
    # A tube that turns by less is carried along by those that jump.
    return Snap(
        frame,
        tuple(int(i) + 1 for i in np.flatnonzero(abs(jump) > MIN_ELASTIC_SNAP_JUMP_RAD)),
        float(abs(jump).max()),
    )


def _at_frames(
    way: MotionSubsteps, x: Array, margins: Array, snaps: Sequence[Sequence[Snap]]
) -> list[EquilibriumPath]:
    """Return equilibria and margins at frames, from x (n, M, 2d + 2), margins (n, M) and snaps of n robots at all
    sub-steps.
    """
    ends = np.flatnonzero(np.diff(way.frames, append=-1))
    reached = way.frames[ends]
    at, between = np.full((2, len(x), way.total), np.nan)
    here = np.full((len(x), way.total, x.shape[2]), np.nan)
    here[:, reached], at[:, reached] = x[:, ends], margins[:, ends]
    # np.fmin ignores NaN margins (not computed, or no equilibrium) at sub-steps between frames.
    between[:, reached] = (
        np.fmin.reduceat(margins, np.concatenate([[0], ends[:-1] + 1]), axis=1) if len(ends) else np.inf
    )
    # A snap lies between two sub-steps, where no margin was looked at: there it was 0.
    for own, least in zip(snaps, between, strict=True):
        np.fmin.at(least, [snap.frame - 1 for snap in own], 0.0)
    between[~np.isfinite(at)] = np.nan
    return [EquilibriumPath(here[k], at[k], between[k], tuple(own)) for k, own in enumerate(snaps)]
