"""How large a force at its tip a robot bears: raised until it snaps, or leaves its lumen, and what it gives in.

All configurations and directions are followed side by side, a row each, through levels of force of which each is
twice the one before, so that what happens within a level is found to the same part of the force everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ctr_nlp.models.loaded.acting import RodKind
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.model import curves
from ctr_nlp.models.loaded.stability import pivots
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Flags

LEVELS = 10
"""Doublings of the force from the least level to the largest force."""
PART = 2.0**-8
"""The least step, as a part of a level: the end of a branch is found to so small a part of the force."""
BISECTIONS = 7
"""Of the level within which something comes true of a robot."""
SMALL = 1e-4
"""N at the tip, whose displacements tell the compliance."""

Question = Callable[[States], Flags]
"""Whether something is true of states, (T,)."""


def borne(
    equilibria: LoadedEquilibria, states: States, directions: Array, most: float, asked: Sequence[Question]
) -> tuple[Array, list[Array]]:
    """Forces (T, n) N beside their load, along directions (n, 3) of the base, at which branches of states end.

    And for everything that is asked, those (T, n) from which on it is true, 0 where it is so without a force.
    Infinity stands for more than most, N.
    """
    rows, count = len(states.q), len(directions)
    now, toward = states.rows(np.repeat(np.arange(rows), count)), np.tile(directions, (rows, 1))
    own, ends = now.load, np.full(rows * count, np.inf)
    found = [np.where(true(now), 0.0, np.inf) for true in asked]
    before, going = 0.0, np.arange(rows * count)
    for level in most * 2.0 ** -np.arange(LEVELS - 1.0, -1.0, -1.0):
        new, done = _raised(equilibria, now.rows(going), own[going], level * toward[going])
        force = before + done * (level - before)
        ends[going[done < 1]] = force[done < 1]
        for true, since in zip(asked, found, strict=True):
            crossing = np.flatnonzero(np.isinf(since[going]) & true(new))
            which, high = going[crossing], force[crossing]
            since[which] = _crossing(equilibria, now.rows(which), own[which], toward[which], before, high, true)
        now = now.replaced(going[done == 1], new.rows(done == 1))
        going, before = going[done == 1], level
    return ends.reshape(rows, count), [since.reshape(rows, count) for since in found]


def unstable(equilibria: LoadedEquilibria) -> Question:
    """Whether some direction gives way, also where two do at once and no branch ends, as at Euler's load.

    Of loads that have an energy.
    """

    def true(states: States) -> Flags:
        return np.asarray(~(pivots(equilibria.ends_of(states).responses) > 0).all(axis=(1, 2)))

    return true


def _raised(equilibria: LoadedEquilibria, states: States, own: Array, force: Array) -> tuple[States, Array]:
    """States as far as their branches go towards forces (T, 3) beside their own loads, and how far, (T,)."""
    load = own.copy()
    load[:, :3] += force
    return equilibria.along(states, states.q, load, smallest=PART)


def _crossing(
    equilibria: LoadedEquilibria,
    states: States,
    own: Array,
    toward: Array,
    before: float,
    high: Array,
    true: Question,
) -> Array:
    """From which forces (T,) on something is true, between that before, where states are, and high ones (T,)."""
    low = np.full(len(high), before)
    for _ in range(BISECTIONS if len(high) else 0):
        middle = (low + high) / 2
        new, _ = _raised(equilibria, states, own, middle[:, None] * toward)
        past = true(new)
        states = states.replaced(~past, new.rows(~past))
        low, high = np.where(past, low, middle), np.where(past, middle, high)
    return (low + high) / 2


def compliance(robot: Robot, equilibria: LoadedEquilibria, states: States) -> Array:
    """How tips of states give in to small forces there, (T, 3, 3) mm/N, symmetric where the load has an energy."""
    rows = len(states.q)
    pushed = states.rows(np.repeat(np.arange(rows), 6))
    force = np.tile(SMALL * np.concatenate([np.eye(3), -np.eye(3)]), (rows, 1))
    found, done = _raised(equilibria, pushed, pushed.load, force)
    tips = np.where(done[:, None] == 1, shapes(robot, found, np.ones(1), equilibria.rods.kind)[:, 0], np.nan)
    ahead, behind = np.moveaxis(tips.reshape(rows, 2, 3, 3), 1, 0)
    return np.swapaxes(ahead - behind, 1, 2) / (2 * SMALL)


def shapes(robot: Robot, states: States, sigma: Array, kind: RodKind) -> Array:
    """Points (T, n, 3) mm of states of such rods at sigma (n,) or (T, n)."""
    return curves(robot.structure, robot.numbers[None], states.load, states.unknowns, sigma, kind)[0]
