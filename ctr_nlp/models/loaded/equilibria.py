"""Equilibria of loaded robots, a batch of rows, each followed along a line of configurations and loads.

Robots of the rows may differ in the numbers of their tubes. Every tip is an equilibrium of some configuration
(rod.py); the tip whose base stands at a given q is a root of d + 2 equations: the base's tangent points where
theta has it (2), and the motors are at alpha (d). It is found by Newton's method from a prediction along the
tangent of the branch, as elastic/equilibria.py does without a load. A step that strays from its prediction, or
passes a singular Jacobian, is halved until it is clear that the branch ends there. Angles are in rad, lengths in
mm, forces in N.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.models.dominant.shape import base_frame
from ctr_nlp.models.elastic.compiled import (
    MAX_PREDICTED_TURN_RAD,
    MAX_PREDICTION_ERROR_RAD,
    MIN_PATH_STEP_FRACTION,
)
from ctr_nlp.models.loaded.compiled import RodBases, Rods
from ctr_nlp.models.loaded.rod_loads import TIP_FORCE_ROD_KIND, RodKind
from ctr_nlp.models.loaded.tips import axes_of, turn_tips, unknowns
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Flags

LOADED_NEWTON_TOLERANCE_RAD, MAX_LOADED_NEWTON_STEPS = 1e-7, 12
"""Newton's method: the size of the last step, rad, whose error is about its square; and most steps."""
NEWTON_BASIN_RADIUS_RAD = 1e-2
"""Distance, rad, from its prediction up to which a known equilibrium is taken for the one on the predicted branch.
"""
SAME_EQUILIBRIUM_TOLERANCE_RAD = 1e-6
"""Largest difference of the unknowns of two descriptions of the same equilibrium, rad."""
MAX_LOADED_NEWTON_TURN_RAD, MAX_LOADED_NEWTON_STEP_RATIO = 1.0, 0.7
"""Largest angle, rad, of a Newton step, and its largest ratio to the step before; where either is exceeded,
Newton's method is given up.
"""


class States(NamedTuple):
    """T equilibria.

    numbers (T, d, 8): of the robots' tubes. q (T, 2d + 2): configurations. load (T, 17 + 3d). angles (T, d), axes
    (T, 3, 3): of the tips, the angles relative to the axes. slopes (T, d + 2, d + 2): derivatives of tilt and
    motors over the tip (rod.Rod); determinant (T,): of these, 0 where the branch ends.
    """

    numbers: Array
    q: Array
    load: Array
    angles: Array
    axes: Array
    slopes: Array
    determinant: Array

    def rows(self, which: Any) -> States:
        """Return the states of some rows; `which` is any index."""
        return States(*(each[which] for each in self))

    def move_tips(self, step: Array) -> tuple[Array, Array]:
        """Return angles and axes of the tips after changes step (T, d + 2) of them, rad."""
        return turn_tips(self.angles, self.axes, step)

    def same_equilibria(self, others: States) -> Flags:
        """Return whether these are the same equilibria as others, (T,); False where either is unknown (NaN)."""
        return np.asarray(
            abs(self.unknowns - others.unknowns).max(axis=1, initial=0.0) < SAME_EQUILIBRIUM_TOLERANCE_RAD
        )

    @property
    def unknowns(self) -> Array:
        """Unknowns x (T, 2d + 2), explained in tips.py."""
        return unknowns(self.angles, self.axes, self.q)

    @classmethod
    def unknown_states(cls, numbers: Array, q: Array, load: Array) -> States:
        """Return states of robots at q (T, 2d + 2) whose equilibria are not known: NaN.

        numbers (T, d, 8): of the tubes. load (T, 17 + 3d).
        """
        rows, d, _ = numbers.shape
        shapes = (rows, d), (rows, 3, 3), (rows, d + 2, d + 2), (rows,)
        return cls(numbers, q, load, *(np.full(shape, np.nan) for shape in shapes))

    def write(self, which: Any, others: States) -> None:
        """Write others to the rows that `which`, any index, selects."""
        for array, values in zip(self, others, strict=True):
            array[which] = values

    def replace_rows(self, which: Any, others: States) -> States:
        """Return a copy of these states with others in the rows that `which`, any index, selects."""
        found = States(*(each.copy() for each in self))
        found.write(which, others)
        return found


class LoadedEquilibria:
    """Solver of equilibria of loaded robots. Not to be used from several threads at once."""

    def __init__(self, structure: Structure, kind: RodKind = TIP_FORCE_ROD_KIND) -> None:
        """Prepare for robots of a structure, under loads of a kind."""
        self.d = structure.d
        self.rods = Rods(structure, kind)

    def solve_unloaded(self, numbers: Array, q: Array, tips: Array) -> States:
        """Return the equilibria without a load of robots of numbers (T, d, 8) at q (T, 2d + 2).

        tips (T, d): approximate angles of the tubes at their tips, rad; only their differences count.
        """
        placed = self.place_unloaded_tips(numbers, q, tips)
        every = np.ones(len(q), dtype=bool)
        return self._solve_newton(numbers, q, self._no_load(len(q)), *placed, every)[0]

    def place_unloaded_tips(self, numbers: Array, q: Array, tips: Array) -> tuple[Array, Array]:
        """Return angles and axes of unloaded tips with bases at q (T, 2d + 2) and the innermost motor at alpha_d.

        numbers (T, d, 8): of the tubes. tips (T, d): angles of the tubes at their tips, rad; only their
        differences count. The other motors' angles follow from the tips, and need not be those of q.
        """
        rows = len(q)
        d = self.d
        axes = np.tile(np.eye(3), (rows, 1, 1))
        angles = tips - tips[:, -1:]
        ends = self.ends(numbers, angles, axes, q, self._no_load(rows))
        # Integrated from a tip that points along z: without a load the whole robot may then be turned, about its
        # base's tangent until the innermost motor is at alpha_d, and with its base into the tilt.
        spin = q[:, d - 1] - ends.angles[:, -1]
        base = base_axes(q[:, 2 * d :])
        cos = np.cos(spin)[:, None]
        sin = np.sin(spin)[:, None]
        spun = np.stack(
            [cos * base[:, 0] + sin * base[:, 1], cos * base[:, 1] - sin * base[:, 0], base[:, 2]], axis=1
        )
        # R_tip = R_base A^T, where A is the base of a tip that stands still
        return angles, np.swapaxes(ends.axes, 1, 2) @ spun

    def follow_branches(
        self,
        states: States,
        q: Array,
        load: Array,
        most: float = 1.0,
        smallest: float = MIN_PATH_STEP_FRACTION,
        numbers: Array | None = None,
    ) -> tuple[States, Array]:
        """Follow branches of equilibria from states towards q (T, 2d + 2) and load (T, l), on a line in both.

        Returns the equilibria as far as branches go, and the fraction of the line that was covered, (T,). most,
        smallest: largest and smallest fraction of the line in a step. numbers (T, d, 8): of the tubes at the end
        of the line; None for those of the states.
        """
        start = states
        done = np.zeros(len(q))
        tubes = np.zeros(start.numbers.shape) if numbers is None else numbers - start.numbers
        part = np.full(len(q), min(1.0, most))
        while True:
            # Rows have steps of their own: those that are done, or whose steps have become too small, drop out.
            active = np.flatnonzero((done < 1) & (part >= smallest))
            if not len(active):
                return states, done
            ahead = done[active] + part[active]
            goal = start.q[active] + ahead[:, None] * (q - start.q)[active]
            pull = start.load[active] + ahead[:, None] * (load - start.load)[active]
            here = states.rows(active)._replace(
                numbers=start.numbers[active] + ahead[:, None, None] * tubes[active]
            )
            new, there = self._step(here, goal, pull)
            gone = active[there]
            stopped = active[~there]
            states = states.replace_rows(gone, new.rows(there))
            done[gone] += part[gone]
            # Fractions are summed up: rounding must not leave a last step of 1e-16.
            done[gone[done[gone] > 1 - 1e-12]] = 1.0
            # Double the step after a success, halve it after a failure.
            part[gone] = np.minimum(np.minimum(2 * part[gone], most), 1 - done[gone])
            part[stopped] /= 2

    def branches_lead_to(self, states: States, goals: States) -> Flags:
        """Return whether the branches of states lead to goals on straight lines, (T,).

        A goal within NEWTON_BASIN_RADIUS_RAD of the tangent's prediction counts as reached; for others the line is
        followed. False where either is unknown.
        """
        found = np.isfinite(states.determinant) & np.isfinite(goals.determinant)
        known = np.flatnonzero(found)
        # The prediction takes one integration of the rod, following takes several.
        found[known] = self._within_prediction(states.rows(known), goals.rows(known))
        left = known[~found[known]]
        reached, done = self.follow_branches(states.rows(left), goals.q[left], goals.load[left])
        found[left] = (done == 1) & reached.same_equilibria(goals.rows(left))
        return found

    def _within_prediction(self, states: States, goals: States) -> Flags:
        """Return whether goals (T,) lie within NEWTON_BASIN_RADIUS_RAD of the tangents' predictions at states."""
        angles, axes, near = self._predict_tips(states, goals.q, goals.load)
        away = abs(unknowns(angles, axes, goals.q) - goals.unknowns).max(axis=1, initial=0.0)
        return np.asarray(near & (away < NEWTON_BASIN_RADIUS_RAD) & (goals.determinant * states.determinant > 0))

    def _step(self, states: States, q: Array, load: Array) -> tuple[States, Flags]:
        """Return the equilibria at q (T, 2d + 2) and loads on the branches of nearby states, and whether each was
        found.
        """
        angles, axes, near = self._predict_tips(states, q, load)
        new, found = self._solve_newton(states.numbers, q, load, angles, axes, near)
        away = np.maximum(abs(new.angles - angles).max(axis=1), abs(new.axes - axes).max(axis=(1, 2)))
        # A determinant of another sign lies on another branch, or past the end of this one: in between it was 0.
        return new, found & (away < MAX_PREDICTION_ERROR_RAD) & (new.determinant * states.determinant > 0)

    def _predict_tips(self, states: States, q: Array, load: Array) -> tuple[Array, Array, Flags]:
        """Return tips at q (T, 2d + 2) and loads along the tangents of states' branches, and whether each turns
        little.
        """
        d = self.d
        # The old tip under the new load, at the new extensions: one Newton step for the residual at its base. This
        # is the tangent's prediction without derivatives over load and extensions.
        here = self.ends(states.numbers, states.angles, states.axes, q, load)
        step = compute_newton_steps(states.slopes, self.misfit(q, here))
        motors = q[:, :d] - states.q[:, :d]
        apart = abs(motors[:, :-1] - motors[:, -1:]).max(axis=1, initial=0.0)
        # Tubes may turn against each other as far as their motors do, and by MAX_PREDICTED_TURN_RAD more; near a
        # fold tips turn far for little turns of motors.
        near = abs(step[:, 2:-1] - step[:, -1:]).max(axis=1, initial=0.0) < MAX_PREDICTED_TURN_RAD + apart
        near &= abs(step).max(axis=1) < MAX_LOADED_NEWTON_TURN_RAD
        return *states.move_tips(step), near

    def _solve_newton(
        self, numbers: Array, q: Array, load: Array, angles: Array, axes: Array, wanted: Flags
    ) -> tuple[States, Flags]:
        """Find equilibria from tips by Newton's method in the rows that are wanted.

        Returns the states, and whether each row converged.
        """
        angles = angles.copy()
        axes = axes.copy()
        rows = len(q)
        side = self.d + 2
        slopes = np.tile(np.eye(side), (rows, 1, 1))
        found = np.zeros(rows, dtype=bool)
        going = wanted.copy()
        most = np.full(rows, MAX_LOADED_NEWTON_TURN_RAD)
        for _ in range(MAX_LOADED_NEWTON_STEPS):
            at = np.flatnonzero(going)
            if not len(at):
                break
            ends = self.ends(numbers[at], angles[at], axes[at], q[at], load[at])
            slopes[at] = ends.slopes
            step = compute_newton_steps(slopes[at], self.misfit(q[at], ends))
            size = abs(step).max(axis=1)
            # Steps must shrink by MAX_LOADED_NEWTON_STEP_RATIO each: a start from which they do not is in no basin
            # of convergence, and no further step is wasted.
            moved = size < most[at]
            # The last step is still taken: after it the error is about its square.
            found[at] |= size < LOADED_NEWTON_TOLERANCE_RAD
            going[at], most[at] = (
                moved & (size >= LOADED_NEWTON_TOLERANCE_RAD),
                MAX_LOADED_NEWTON_STEP_RATIO * size,
            )
            angles[at[moved]], axes[at[moved]] = turn_tips(angles[at[moved]], axes[at[moved]], step[moved])
        return States(numbers, q, load, angles, axes, slopes, np.linalg.det(slopes)), found

    def ends(
        self, numbers: Array, angles: Array, axes: Array, q: Array, load: Array, soft: Array | None = None
    ) -> RodBases:
        """Integrate the rods of tips at the extensions of q (T, 2d + 2) under loads (load, (T, 17 + 3d)).

        numbers (T, d, 8): of the tubes. angles (T, d), rad, and axes (T, 3, 3): of the tips. soft (T, 2):
        softnesses of torsion and bending in responses; None for 1.
        """
        soft = np.ones((len(q), 2)) if soft is None else soft
        return self.rods(numbers, angles, axes, q[:, self.d : 2 * self.d], load, soft)

    def ends_of(self, states: States, soft: Array | None = None) -> RodBases:
        """Integrate the rods of states; soft (T, 2): softnesses of responses, None for 1."""
        return self.ends(states.numbers, states.angles, states.axes, states.q, states.load, soft)

    def states(self, numbers: Array, angles: Array, axes: Array, beta: Array, load: Array) -> States:
        """Return the states of tips under loads, each at the configuration that it is an equilibrium of.

        numbers (T, d, 8): of the tubes. angles (T, d), rad, and axes (T, 3, 3): of the tips. beta (T, d):
        extensions, mm. load (T, 17 + 3d).
        """
        q = self.configurations(numbers, angles, axes, beta, load)
        slopes = self.ends(numbers, angles, axes, q, load).slopes
        return States(numbers, q, load, angles, axes, slopes, np.linalg.det(slopes))

    def misfit(self, q: Array, ends: RodBases) -> Array:
        """Return the residuals at the bases (ends) of robots that should stand at q (T, 2d + 2): (T, d + 2) rad.

        The first two are turns of the base's tangent about d_1 and d_2, the others turns of the motors, in the
        order of responses.
        """
        between = _between(q, ends)
        x, y, z = (between[:, 2, k] for k in range(3))
        sine = np.hypot(x, y)
        # The rotation vector that turns z into the tangent (x, y, z): angle over sine, times (-y, x, 0). At angle
        # 0 the quotient is 1.
        factor = np.where(sine > 1e-12, np.arctan2(sine, z) / np.maximum(sine, 1e-300), 1.0)
        motors = q[:, : self.d] - _alpha(ends, between)
        # Whole turns of all motors together change nothing. The innermost decides, so that the others keep their
        # turns against it.
        motors -= 2 * np.pi * np.round(motors[:, -1:] / (2 * np.pi))
        return np.hstack([(-factor * y)[:, None], (factor * x)[:, None], motors])

    def configurations(self, numbers: Array, angles: Array, axes: Array, beta: Array, load: Array) -> Array:
        """Return the configurations q (T, 2d + 2) of tips.

        numbers (T, d, 8): of the tubes. angles (T, d), rad, and axes (T, 3, 3): of the tips. beta (T, d):
        extensions, mm. load (T, 17 + 3d). theta_x is within a quarter turn, and alpha is known up to whole turns
        of all tubes together.
        """
        q = np.hstack([np.zeros(beta.shape), beta, np.zeros((len(beta), 2))])
        ends = self.ends(numbers, angles, axes, q, load)
        x, y, z = ends.axes[:, 2].T
        # The third column of R of eq. (4) is (sin ty cos tx, -sin tx, cos ty cos tx).
        q[:, 2 * self.d :] = np.stack([-np.arcsin(np.clip(y, -1, 1)), np.arctan2(x, z)], axis=1)
        q[:, : self.d] = _alpha(ends, _between(q, ends))
        return q

    def _no_load(self, rows: int) -> Array:
        """Return zeros (rows, l) for loads."""
        return np.zeros((rows, self.rods.size))


def base_axes(theta: Array) -> Array:
    """Return the columns of R of eq. (4), (T, 3, 3), row by row d_1, d_2 and t, for theta (T, 2)."""
    return axes_of(base_frame(theta[:, 0], theta[:, 1], np))


def _between(q: Array, ends: RodBases) -> Array:
    """Return the rotations (T, 3, 3) from where rods' bases point to where those of q (T, 2d + 2) do."""
    d = ends.angles.shape[1]
    return base_axes(q[:, 2 * d :]) @ np.swapaxes(ends.axes, 1, 2)


def _alpha(ends: RodBases, between: Array) -> Array:
    """Return the motors' angles (T, d) of rods; between: the result of _between. shape.py has them in symbols."""
    # The turn of the rod's base frame about the tangent: the angle of the rotation's upper block, which is exact
    # where both tangents agree.
    spin = np.arctan2(between[:, 1, 0] - between[:, 0, 1], between[:, 0, 0] + between[:, 1, 1])
    return ends.angles + spin[:, None]


def compute_newton_steps(slopes: Array, misfit: Array) -> Array:
    """Return the steps (T, n) that remove residuals (misfit, (T, n)) to first order.

    NaN where slopes are singular. slopes (T, n, n): derivatives of the configuration over the unknowns, so that no
    sign is changed.
    """
    # numpy's solve raises for the whole batch where a single matrix is singular: such rows are left out.
    fine = np.asarray(np.isfinite(slopes).all(axis=(1, 2)) & (abs(np.linalg.det(slopes)) > 0))
    found = np.full(misfit.shape, np.nan)
    found[fine] = np.linalg.solve(slopes[fine], misfit[fine][..., None])[..., 0]
    return found
