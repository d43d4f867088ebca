"""Frames of a motion on a wall as functions of their configurations: costs, constraints and their derivatives.

The unknowns of a frame are coordinates of its equilibrium over which it is smooth (contact_equilibria.py): tubes'
angles at the tip instead of their motors' angles, which have limits and are functions of them, as in programs
without a wall. A frame costs

    d + arrival + W_F total^2 + W_M s_M + W_P s_P

with d the mean squared distance from its target, eq. (8), mm^2, total the sum of the wall's forces, N, and s_M,
s_P >= 0 by how much the stability margin falls below its least, and the largest force at a place exceeds its
limit: two more unknowns. Their costs are exact penalties (Nocedal and Wright, Numerical Optimization, 2006,
chapter 17): both are 0 wherever the limits can be kept. A place is PLACE_LENGTH_MM of the robot: forces there do
not depend on how it is divided into pieces.

Slopes of the margin mu follow from the determinant D(mu, y) that vanishes there, without finding other roots:
dmu/dy = -(dD/dy) / (dD/dmu). Second derivatives are differences of first ones, at equilibria nearby to first
order, which are off by the square of the difference alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.loads.contact_equilibria import ContactEquilibria, ContactSlopes, ContactState
from ctr_nlp.ocp.terms.arrival import ArrivalTerm
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.typing import Array

CONTACT_SIGMA = SIGMA_GRID[::4]
"""Points at which the shape's error counts in the program."""
TOTAL_FORCE_COST_MM2_PER_N2 = 1.0
"""Cost of the square of the sum of the wall's forces: among motions within the limit, the one that leans less is
taken."""
MARGIN_SHORTFALL_COST_MM2, FORCE_EXCESS_COST_MM2_PER_N = 1000.0, 2000.0
"""Costs of a margin below its least, and of a force beyond its limit; arrival costs 50 mm^2 a mm."""
MARGIN_SLOPE_RANGE = 0.3
"""How much larger than its least a margin may be for its slope to count: beyond, it binds nothing nearby."""
MIN_MARGIN_MULTIPLIER_MM2 = 1e-2
"""Least multiplier of a margin, mm^2, for its curvature to count."""
MAX_STEP_MM = 20.0
"""Longest change of an unknown in a frame, in mm (10 mm a rad): farther off, an equilibrium is another one."""
CURVATURE_PROBE_MM = 1e-3
"""Change of an unknown, in mm (10 mm a rad), for differences of first derivatives."""


class FrameMultipliers(NamedTuple):
    """Multipliers of q (T, 2d + 2), of stability margins (T,) and of forces at places (T, K), mm^2 per unit."""

    q: Array
    margin: Array
    force: Array


class FrameValues(NamedTuple):
    """Equilibria of T frames.

    q (T, 2d + 2): configurations. cost (T,): mm^2. margin (T,): stability margins. force (T, K): at places, N.
    """

    q: Array
    cost: Array
    margin: Array
    force: Array


class FrameDerivatives(NamedTuple):
    """Values of T frames, and derivatives by n unknowns y.

    q_by (T, 2d + 2, n), cost_by, margin_by (T, n), force_by (T, K, n). hessian (T, n, n): of the Lagrangian.
    """

    values: FrameValues
    q_by: Array
    cost_by: Array
    margin_by: Array
    force_by: Array
    hessian: Array


@dataclass
class ContactFrames:
    """Frames of a problem on a wall, and the equilibria in which the robot is at present.

    problem: robot and target. equilibria: of its robot. margin: least stability margins (T,). arrival: the term of
    the tip's arrival, or None. states: of the frames, from which others are predicted.

    Unknowns of the frames are the coordinates y of ContactEquilibria.tip_coordinates.
    """

    problem: Problem
    equilibria: ContactEquilibria
    margin: Array
    arrival: ArrivalTerm | None
    states: list[ContactState]

    def __post_init__(self) -> None:
        self._y = np.stack([self.equilibria.tip_coordinates(state) for state in self.states])
        self._ahead = self._y, self.states
        self._slopes: list[ContactSlopes] | None = None

    @property
    def y(self) -> Array:
        """Unknowns (T, 2d + 2) of the present equilibria."""
        return self._y

    def values(self, y: Array) -> FrameValues | None:
        """Return the values at y (T, n); None where a frame has no equilibrium near the present one."""
        states = self._find(y)
        if states is None:
            return None
        points = [self.equilibria.shape(state, CONTACT_SIGMA) for state in states]
        forces = [self.equilibria.forces(state) for state in states]
        cost = np.array(
            [
                self._cost(j, shape, force.force.sum())[0]
                for j, (shape, force) in enumerate(zip(points, forces, strict=True))
            ]
        )
        return FrameValues(
            np.stack([state.q for state in states]),
            cost,
            self.equilibria.margins(states),
            np.stack([each.at_places for each in forces]),
        )

    def move_to(self, y: Array) -> bool:
        """Make the equilibria at y (T, n) the present ones; False where a frame has none near the present one."""
        states = self._find(y)
        if states is None:
            return False
        if (y != self._y).any():
            self._slopes = None
            self._y = y.copy()
            self.states = states
        return True

    def derivatives(self, multipliers: FrameMultipliers, curvature: bool = True) -> FrameDerivatives:
        """Return values and derivatives at the present equilibria.

        multipliers: in the Lagrangian. curvature: whether its Hessian is wanted; 0 otherwise.
        """
        if self._slopes is None:
            self._slopes = self._find_slopes()
        margins = self.equilibria.margins(self.states)
        n = self._y.shape[1]
        margin_by = np.zeros((len(self.states), n))
        counts = np.flatnonzero(margins < self.margin + MARGIN_SLOPE_RANGE)
        if len(counts):
            margin_by[counts] = self.equilibria.margin_slopes(
                [self.states[j] for j in counts], [self._slopes[j] for j in counts], margins[counts]
            )
        found = [self._cost_slopes(j, slopes) for j, slopes in enumerate(self._slopes)]
        hessian = np.zeros((len(self.states), n, n))
        if curvature:
            for j in range(len(self.states)):
                hessian[j] = self._hessian(j, margins[j], margin_by[j], multipliers)
        return FrameDerivatives(
            FrameValues(
                np.stack([state.q for state in self.states]),
                np.array([each[0] for each in found]),
                margins,
                np.stack([slopes.force_at_places for slopes in self._slopes]),
            ),
            np.stack([slopes.q_by for slopes in self._slopes]),
            np.stack([each[1] for each in found]),
            margin_by,
            np.stack([slopes.places_by for slopes in self._slopes]),
            hessian,
        )

    def _find_slopes(self) -> list[ContactSlopes]:
        """Return the slopes of the present equilibria."""
        return [self.equilibria.slopes([state], CONTACT_SIGMA)[0] for state in self.states]

    def _find(self, y: Array) -> list[ContactState] | None:
        """Return the equilibria at y (T, n), predicted from the present ones; None where a frame has none."""
        if (y == self._y).all():
            return self.states
        if (y == self._ahead[0]).all():
            return self._ahead[1]
        found = []
        for j, (state, goal) in enumerate(zip(self.states, y, strict=True)):
            there = self._at(j, state, goal, self._y[j])
            if there is None:
                return None
            found.append(there)
        self._ahead = y.copy(), found
        return found

    def _at(self, j: int, state: ContactState, goal: Array, y: Array) -> ContactState | None:
        """Return the equilibrium of frame j at `goal` (n,), from the state at y (n,); None for none nearby."""
        if (goal == y).all():
            return state
        step = goal - y
        if not abs(step * self.problem.robot.mm_per_unit).max() <= MAX_STEP_MM:
            return None
        if self._slopes is None:
            self._slopes = self._find_slopes()
        return self.equilibria.settle(self.equilibria.predict(state, self._slopes[j], step))

    def _cost(self, j: int, points: Array, total: float) -> tuple[float, Array, Array]:
        """Return the cost of frame j, mm^2, and its derivatives by points (n, 3) and by the total force, N."""
        frame = self.problem.target_frames[j]
        weights = np.full(len(CONTACT_SIGMA), 1.0)
        weights[[0, -1]] = 0.5
        weights /= weights.sum()
        away = points - frame.at(CONTACT_SIGMA)
        cost = float(weights @ (away**2).sum(axis=1)) + TOTAL_FORCE_COST_MM2_PER_N2 * total**2
        by_points = 2 * weights[:, None] * away
        if self.arrival is not None:
            # w (sqrt(|a|^2 + r^2) - r) grows like the term in ocp/terms/arrival.py, without its corners: a long
            # robot's angles would have to be kept to 1e-4 rad, and steps would go to and fro across them.
            given = self.arrival.values(frame.points[-1:], frame.motion_fraction)
            weight, radius = float(given["arrival_weight"]), float(given["arrival_required"])
            rounded = float(np.hypot(np.linalg.norm(away[-1]), radius))
            cost += weight * (rounded - radius)
            by_points[-1] += weight * away[-1] / rounded
        return cost, by_points, np.asarray(2 * TOTAL_FORCE_COST_MM2_PER_N2 * total)

    def _cost_slopes(self, j: int, slopes: ContactSlopes) -> tuple[float, Array]:
        """Return the cost of frame j, mm^2, and its derivatives (n,) by y."""
        cost, by_points, by_total = self._cost(j, slopes.points, slopes.force.sum())
        slope = np.tensordot(by_points, slopes.points_by, 2) + by_total * slopes.force_by.sum(axis=0)
        return cost, slope

    def _hessian(self, j: int, margin: float, margin_by: Array, multipliers: FrameMultipliers) -> Array:
        """Return the Hessian (n, n) of frame j's Lagrangian over y, by differences of its slope.

        margin_by (n,): slope of its margin by y.
        """
        assert self._slopes is not None
        state = self.states[j]
        slopes = self._slopes[j]
        of_margin = float(multipliers.margin[j])
        bent = abs(of_margin) > MIN_MARGIN_MULTIPLIER_MM2 and margin_by.any()

        def slope(at: ContactSlopes, by_margin: Array) -> Array:
            """Return the slope (n,) of the Lagrangian."""
            of_q = multipliers.q[j] @ at.q_by + multipliers.force[j] @ at.places_by
            return np.asarray(self._cost_slopes(j, at)[1] + of_q + of_margin * by_margin)

        probes = self._probes(state.q)
        steps = np.diag(probes)
        near = [self.equilibria.predict(state, slopes, step) for step in steps]
        slopes_near = self.equilibria.slopes(near, CONTACT_SIGMA)
        by_margin = np.zeros((len(probes), len(probes)))
        if bent:
            by_margin = self.equilibria.margin_slopes(near, slopes_near, margin + steps @ margin_by)
        here = slope(slopes, margin_by if bent else 0 * margin_by)
        change = np.stack([slope(*each) - here for each in zip(slopes_near, by_margin, strict=True)])
        found = change / probes[:, None]
        return np.asarray((found + found.T) / 2)

    def _probes(self, q: Array) -> Array:
        """Return changes (n,) of the coordinates, rad and mm, that keep the tubes' ends of q (n,) in order."""
        robot = self.problem.robot
        probes = CURVATURE_PROBE_MM / robot.mm_per_unit
        room = np.append(np.diff(robot.split(q)[1]), np.inf)
        probes[robot.d : 2 * robot.d] *= np.where(room > CURVATURE_PROBE_MM, 1.0, -1.0)
        return np.asarray(probes)
