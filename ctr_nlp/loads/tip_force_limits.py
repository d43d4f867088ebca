"""Continuation of equilibria in a tip force: where a branch ends or a condition becomes true; the compliance.

The force is raised along fixed directions of the base frame, in addition to the robot's own load, and the branch
of equilibria is followed until it ends (models/loaded/equilibria.py). All configurations and directions are rows
of one batch. Each force level is twice the one before: a critical force is found to the same relative accuracy
(MIN_FORCE_LEVEL_STEP of its level), whether it is small or large.

Dead forces are conservative, so that stability follows from the second variation of the energy: an equilibrium is
stable where all pivots of its response matrices are positive (models/loaded/stability.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.model import curves
from ctr_nlp.models.loaded.rod_loads import RodKind
from ctr_nlp.models.loaded.stability import pivots
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Flags

TIP_FORCE_LEVELS = 10
"""Doublings of the force from the least level to the largest force."""
MIN_FORCE_LEVEL_STEP = 2.0**-8
"""Least step as a part of a level, and so the relative accuracy of the force at which a branch ends: 0.4 %."""
BISECTIONS = 7
"""Bisections of the level within which a condition becomes true."""
COMPLIANCE_FORCE_N = 1e-4
"""Force at the tip whose displacements give the compliance, N."""

StateCondition = Callable[[States], Flags]
"""A condition: takes T states, returns for which of them it is true, (T,)."""


def find_tip_force_limits(
    equilibria: LoadedEquilibria,
    states: States,
    directions: Array,
    max_force: float,
    conditions: Sequence[StateCondition],
) -> tuple[Array, list[Array]]:
    """Find the tip forces at which branches of equilibria end, and those from which on conditions are true.

    Parameters
    ----------
    equilibria : LoadedEquilibria
        Follows the robot's equilibria.
    states : States
        Equilibria in T configurations under the loads of these.
    directions : (n, 3) array
        Unit vectors in the base frame along which forces are raised.
    max_force : float
        Largest force that is tested, N.
    conditions : sequence of callable
        Conditions: each takes states of m rows and returns for which of them it is true, (m,). It must stay true
        once a force has made it true.

    Returns
    -------
    ends : (T, n) array
        Forces, in addition to the rows' loads, at which their branches end, N, to about 0.4 %.
    found : list of (T, n) arrays
        For each condition the forces from which on it is true, N: 0 where it is true without a force. In both,
        infinity stands for more than `max_force`, and in `found` for never before the branch ends.
    """
    rows = len(states.q)
    count = len(directions)
    # A row for each pair of a configuration and a direction: row k n + j has configuration k and direction j.
    now = states.rows(np.repeat(np.arange(rows), count))
    toward = np.tile(directions, (rows, 1))
    own = now.load
    ends = np.full(rows * count, np.inf)
    found = [np.where(true(now), 0.0, np.inf) for true in conditions]
    before = 0.0
    going = np.arange(rows * count)
    # Forces within a level are steps from the one before, on the branch that has been followed so far. A row whose
    # branch has ended within a level is followed no further.
    for level in max_force * 2.0 ** -np.arange(TIP_FORCE_LEVELS - 1.0, -1.0, -1.0):
        new, done = _raise_tip_force(equilibria, now.rows(going), own[going], level * toward[going])
        force = before + done * (level - before)
        ends[going[done < 1]] = force[done < 1]
        for true, since in zip(conditions, found, strict=True):
            # Also on a branch that ended: what became true before its end counts.
            crossing = np.flatnonzero(np.isinf(since[going]) & true(new))
            which = going[crossing]
            high = force[crossing]
            since[which] = _crossing(equilibria, now.rows(which), own[which], toward[which], before, high, true)
        now = now.replace_rows(going[done == 1], new.rows(done == 1))
        going = going[done == 1]
        before = level
    return ends.reshape(rows, count), [since.reshape(rows, count) for since in found]


def instability_condition(equilibria: LoadedEquilibria) -> StateCondition:
    """Return the condition that an equilibrium is unstable, for loads that have an energy.

    The branch of equilibria need not end there: a straight rod is an equilibrium under any axial force, and
    becomes unstable in two directions at once at Euler's load. The determinant of the response then has a double
    root and keeps its sign, so that its pivots are tested instead: all are positive where the robot is stable
    (models/loaded/stability.py).

    Parameters
    ----------
    equilibria : LoadedEquilibria
        Follows the robot's equilibria.

    Returns
    -------
    callable
        Takes states of m rows; returns which of them are unstable, (m,).
    """

    def true(states: States) -> Flags:
        return np.asarray(~(pivots(equilibria.ends_of(states).responses) > 0).all(axis=(1, 2)))

    return true


def _raise_tip_force(
    equilibria: LoadedEquilibria, states: States, own: Array, force: Array
) -> tuple[States, Array]:
    """Follow the branches of states to tip forces (T, 3), N, in addition to their own loads (T, l).

    Returns the last states on their branches, and the part of the force that was reached, (T,), 1 for all of it.
    """
    # The first three numbers of a load are the tip force in base directions; see Load.numbers.
    load = own.copy()
    load[:, :3] += force
    return equilibria.follow_branches(states, states.q, load, smallest=MIN_FORCE_LEVEL_STEP)


def _crossing(
    equilibria: LoadedEquilibria,
    states: States,
    own: Array,
    toward: Array,
    before: float,
    high: Array,
    true: StateCondition,
) -> Array:
    """Bisect the forces (T,), N, at which a condition becomes true.

    It is false at the force before, N, where states are, and true at the forces high (T,), N; own (T, l): the
    rows' own loads; toward (T, 3): the directions; true: the condition.
    """
    low = np.full(len(high), before)
    for _ in range(BISECTIONS if len(high) else 0):
        middle = (low + high) / 2
        new, _ = _raise_tip_force(equilibria, states, own, middle[:, None] * toward)
        past = true(new)
        # Where the condition is still false the branch is continued from there, over a step that halves each time.
        states = states.replace_rows(~past, new.rows(~past))
        low = np.where(past, low, middle)
        high = np.where(past, middle, high)
    return (low + high) / 2


def compliance(robot: Robot, equilibria: LoadedEquilibria, states: States) -> Array:
    """Compute the compliance of the tips of equilibria: their displacement per small force.

    Central differences of equilibria under forces of 1e-4 N along each axis of the base frame, to both sides.

    Parameters
    ----------
    robot : Robot
        The robot.
    equilibria : LoadedEquilibria
        Follows its equilibria.
    states : States
        T equilibria.

    Returns
    -------
    (T, 3, 3) array
        Displacements of the tip (rows) per force (columns), mm/N; symmetric where the load has an energy. NaN
        where the robot snaps under such a force.
    """
    rows = len(states.q)
    pushed = states.rows(np.repeat(np.arange(rows), 6))
    # Six rows a state: +x, +y, +z, -x, -y, -z.
    force = np.tile(COMPLIANCE_FORCE_N * np.concatenate([np.eye(3), -np.eye(3)]), (rows, 1))
    found, done = _raise_tip_force(equilibria, pushed, pushed.load, force)
    tips = np.where(
        done[:, None] == 1, loaded_shapes(robot, found, np.ones(1), equilibria.rods.kind)[:, 0], np.nan
    )
    # In a central difference the quadratic part cancels, which is large where the robot is about to snap. Rows are
    # forces and columns coordinates: swapped, so that the matrix times a force is a displacement.
    ahead, behind = np.moveaxis(tips.reshape(rows, 2, 3, 3), 1, 0)
    return np.swapaxes(ahead - behind, 1, 2) / (2 * COMPLIANCE_FORCE_N)


def loaded_shapes(robot: Robot, states: States, sigma: Array, kind: RodKind) -> Array:
    """Compute points of the backbone of equilibria under their loads.

    Parameters
    ----------
    robot : Robot
        The robot.
    states : States
        T equilibria.
    sigma : (n,) or (T, n) array
        Arc lengths as parts of beta_d, in [0, 1].
    kind : RodKind
        Kind of rods that the states are of.

    Returns
    -------
    (T, n, 3) array
        Points in the robot's base frame, mm.
    """
    return curves(robot.structure, robot.numbers[None], states.load, states.unknowns, sigma, kind)[0]
