"""Frames of a motion on a wall as functions of their configurations: costs, constraints and their derivatives.

The unknowns of a frame are coordinates of its equilibrium over which it is smooth (contact_neighbours.py): tubes'
angles at the tip instead of their motors' angles, which have limits and are functions of them, as in programs
without a wall. A frame costs

    d + arrival + W_F total^2 + W_M s_M + W_P s_P

with d the mean squared distance from its target, eq. (8), mm^2, total the sum of the wall's forces, N, and s_M,
s_P >= 0 by how much the stability margin falls below its least, and the largest force at a place exceeds its
limit: two more unknowns. Their costs are exact penalties (Nocedal and Wright, Numerical Optimization, 2006,
chapter 17): both are 0 wherever the limits can be kept. A place is PLACE_LENGTH_MM of the robot: forces there do
not depend on how it is divided into pieces.

With F(u, y) = 0 the equilibrium and L(u, y) the Lagrangian of a frame, the Hessian of L(u(y), y) is

    (u_y, 1)^T  d^2(L + l^T F)  (u_y, 1),    l = -(dF/du)^-T dL/du  (adjoint variables),

since terms with second derivatives of u cancel. It is found from second differences of the number L + l^T F along
u_y: for n unknowns, (n + 1)(n + 2) / 2 + n rods, however many pieces of the robot touch the wall. The margin has
no such l: it is found at equilibria that are exact to the second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctr_nlp.loads.contact_equilibria import ContactEquilibria
from ctr_nlp.loads.contact_neighbours import ContactNeighbours, ContactSlopes
from ctr_nlp.loads.contact_rods import ContactState, ContactStates, signed_probes
from ctr_nlp.models.loaded.stability import LOADED_MARGIN_TOLERANCE, MAX_COMPUTED_MARGIN
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
CURVATURE_PROBE_MM = 2e-4
"""Change of an unknown, in mm (10 mm a rad), for second differences. Searches converge in half as many steps as
with 1e-3 mm, whose Hessians are wrong by some 0.1 %, and slowly with 1e-2 mm."""


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


class _Costs(NamedTuple):
    """Costs (..,), mm^2, and their derivatives by points (.., n, 3) and by the total force (..,), N."""

    cost: Array
    by_points: Array
    by_total: Array


@dataclass
class ContactFrames:
    """Frames of a problem on a wall, and the equilibria in which the robot is at present.

    problem: robot and target. equilibria: of its robot. margin: least stability margins (T,). arrival: the term of
    the tip's arrival, or None. states: of the frames, from which others are predicted.

    Unknowns of the frames are the coordinates y of ContactNeighbours.coordinates.
    """

    problem: Problem
    equilibria: ContactEquilibria
    margin: Array
    arrival: ArrivalTerm | None
    states: list[ContactState]

    def __post_init__(self) -> None:
        self._nearby = ContactNeighbours(self.equilibria)
        self._present = ContactStates.stack(self.states)
        self._y = self._nearby.coordinates(self._present)
        self._ahead = self._y, self.states
        self._slopes: list[ContactSlopes] | None = None
        self._margins: tuple[ContactStates, Array] | None = None
        # Smooth margins are known where a robot has the one that it is tested at: the least that is asked for, or
        # what it begins with, where that is less, but for the accuracy of both.
        margins = np.minimum(self.equilibria.margins(self._present), MAX_COMPUTED_MARGIN)
        self._tested_at = np.minimum(self.margin, margins - 10 * LOADED_MARGIN_TOLERANCE)

    @property
    def y(self) -> Array:
        """Unknowns (T, 2d + 2) of the present equilibria."""
        return self._y

    def values(self, y: Array) -> FrameValues | None:
        """Return the values at y (T, n); None where a frame has no equilibrium near the present one."""
        found = self._find(y)
        if found is None:
            return None
        states = ContactStates.stack(found)
        margins = self._find_margins(states)
        if margins is None:
            return None
        forces = self.equilibria.forces(states)
        shapes = self.equilibria.shapes(states, CONTACT_SIGMA)
        cost = self._costs(shapes[:, None], forces.force.sum(axis=1)[:, None]).cost[:, 0]
        return FrameValues(states.q, cost, margins, forces.at_places)

    def move_to(self, y: Array) -> bool:
        """Make the equilibria at y (T, n) the present ones; False where a frame has none near the present one."""
        states = self._find(y)
        if states is None:
            return False
        if (y != self._y).any():
            self._slopes = None
            self._y = y.copy()
            self.states = states
            self._present = ContactStates.stack(states)
        return True

    def derivatives(self, multipliers: FrameMultipliers, curvature: bool = True) -> FrameDerivatives:
        """Return values and derivatives at the present equilibria.

        multipliers: in the Lagrangian. curvature: whether its Hessian is wanted; 0 otherwise.
        """
        slopes = self._find_slopes()
        margins = self._find_margins(self._present)
        # Solvers go to unknowns whose values are known only.
        assert margins is not None
        count, n = self._y.shape
        margin_by = np.zeros((count, n))
        counts = np.flatnonzero(margins < self.margin + MARGIN_SLOPE_RANGE)
        if len(counts):
            margin_by[counts] = self._nearby.margin_slopes(
                self._present.rows(counts), [slopes[j] for j in counts], self._tested_at[counts]
            )
        costs = self._costs(
            np.stack([each.points for each in slopes])[:, None],
            np.array([each.force.sum() for each in slopes])[:, None],
        )
        cost_by = np.stack(
            [
                np.tensordot(by_points[0], each.points_by, 2) + by_total[0] * each.force_by.sum(axis=0)
                for each, by_points, by_total in zip(slopes, costs.by_points, costs.by_total, strict=True)
            ]
        )
        hessian = np.zeros((count, n, n))
        if curvature:
            hessian = self._hessians(slopes, costs, margin_by, multipliers)
        return FrameDerivatives(
            FrameValues(
                self._present.q, costs.cost[:, 0], margins, np.stack([each.force_at_places for each in slopes])
            ),
            np.stack([each.q_by for each in slopes]),
            cost_by,
            margin_by,
            np.stack([each.force_at_places_by for each in slopes]),
            hessian,
        )

    def _find_slopes(self) -> list[ContactSlopes]:
        """Return the slopes of the present equilibria."""
        if self._slopes is None:
            self._slopes = self._nearby.slopes(self._present, CONTACT_SIGMA)
        return self._slopes

    def _find_margins(self, states: ContactStates) -> Array | None:
        """Return the smooth stability margins (T,) of states; None where a frame's is not known."""
        if self._margins is None or any(map(np.any, map(np.not_equal, self._margins[0], states))):
            margins = self.equilibria.known_margins(states, self._tested_at)
            if np.isnan(margins).any():
                return None
            self._margins = states, margins
        return self._margins[1]

    def _find(self, y: Array) -> list[ContactState] | None:
        """Return the equilibria at y (T, n), predicted from the present ones; None where a frame has none."""
        if (y == self._y).all():
            return self.states
        if (y == self._ahead[0]).all():
            return self._ahead[1]
        steps = y - self._y
        if not abs(steps * self.problem.robot.mm_per_unit).max() <= MAX_STEP_MM:
            return None
        slopes = self._find_slopes()
        near = self._nearby.predict(self._present, slopes, steps[:, None])
        found = [each for each in self._nearby.settle(near, slopes) if each is not None]
        if len(found) < len(y):
            return None
        self._ahead = y.copy(), found
        return found

    @cached_property
    def _targets(self) -> Array:
        """Points (T, n, 3) of the target at CONTACT_SIGMA, mm."""
        return np.stack([frame.at(CONTACT_SIGMA) for frame in self.problem.target_frames])

    @cached_property
    def _arrival(self) -> tuple[Array, Array]:
        """Weight, mm, of the tip's distance from its target in each frame, and the distance that rounds it, mm."""
        assert self.arrival is not None
        given = [
            self.arrival.values(frame.points[-1:], frame.motion_fraction) for frame in self.problem.target_frames
        ]
        weights, radii = (
            np.array([float(each[name]) for each in given])[:, None]
            for name in ("arrival_weight", "arrival_required")
        )
        return weights, radii

    def _costs(self, points: Array, total: Array) -> _Costs:
        """Return the costs (T, P) of P shapes in each frame; points (T, P, n, 3), mm, total (T, P): force, N."""
        weights = np.full(len(CONTACT_SIGMA), 1.0)
        weights[[0, -1]] = 0.5
        weights /= weights.sum()
        away = points - self._targets[:, None]
        cost = (away**2).sum(axis=-1) @ weights + TOTAL_FORCE_COST_MM2_PER_N2 * total**2
        by_points = 2 * weights[:, None] * away
        if self.arrival is not None:
            # w (sqrt(|a|^2 + r^2) - r) grows like the term in ocp/terms/arrival.py, without its corners: a long
            # robot's angles would have to be kept to 1e-4 rad, and steps would go to and fro across them.
            weight, radius = self._arrival
            rounded = np.hypot(np.linalg.norm(away[:, :, -1], axis=-1), radius)
            cost += weight * (rounded - radius)
            by_points[:, :, -1] += (weight / rounded)[..., None] * away[:, :, -1]
        return _Costs(cost, by_points, 2 * TOTAL_FORCE_COST_MM2_PER_N2 * total)

    def _hessians(
        self,
        slopes: Sequence[ContactSlopes],
        costs: _Costs,
        margin_by: Array,
        multipliers: FrameMultipliers,
    ) -> Array:
        """Return the Hessians (T, n, n) of the frames' Lagrangians over y, by second differences.

        slopes, costs: at the present equilibria. margin_by (T, n): slopes of stability margins.
        """
        d = self.problem.robot.d
        count, n = self._y.shape
        probes = CURVATURE_PROBE_MM / self.problem.robot.mm_per_unit * np.ones((count, 1))
        probes[:, d : 2 * d] = signed_probes(self._present.q[:, d : 2 * d], probes[:, d : 2 * d])
        first, second = np.triu_indices(n)
        single = np.eye(n)
        # Rows: nowhere, along each unknown once, and along two of them, which may be the same.
        steps = probes[:, None] * np.vstack([np.zeros(n), single, single[first] + single[second]])
        around = self._nearby.look_around(self._present, slopes, steps, CONTACT_SIGMA)
        found = self._costs(around.points, around.force.sum(axis=2)).cost
        found += (multipliers.force[:, None] * around.at_places).sum(axis=2)
        found += (multipliers.q[:, None, : d - 1] * around.states.q.reshape(count, -1, n)[..., : d - 1]).sum(
            axis=2
        )
        for j, (slope, step) in enumerate(zip(slopes, around.corrections, strict=True)):
            of_force = costs.by_total[j, 0] + multipliers.force[j] @ slope.places
            by_u = np.tensordot(costs.by_points[j, 0], slope.points_by_u, 2) + of_force @ slope.force_by_u
            by_u[3 : d + 2] += multipliers.q[j, : d - 1]
            # dL/du . (-(dF/du)^-1 F) = l^T F.
            found[j] += step @ by_u
        bent = np.flatnonzero((abs(multipliers.margin) > MIN_MARGIN_MULTIPLIER_MM2) & margin_by.any(axis=1))
        if len(bent):
            rows = (bent[:, None] * steps.shape[1] + np.arange(steps.shape[1])).ravel()
            of_margin = self._nearby.margins_around(
                around.states.rows(rows),
                [slopes[j] for j in bent.tolist()],
                [around.corrections[j] for j in bent.tolist()],
                self._tested_at[bent],
            )
            found[bent] += multipliers.margin[bent, None] * of_margin
        change = found[:, 1 + n :] - found[:, 1 + first] - found[:, 1 + second] + found[:, :1]
        hessian = np.zeros((count, n, n))
        hessian[:, first, second] = hessian[:, second, first] = change / (probes[:, first] * probes[:, second])
        return hessian
