"""Equilibria of a robot that leans on a wall that gives, and the branches that they are on.

Newton's method solves the equations of contact_rods.py; where pieces begin or cease to touch it is a semismooth
one (Qi and Sun, A nonsmooth version of Newton's method, Mathematical Programming 58, 1993). A step is halved until
the next one, by the same Jacobian, is smaller (Deuflhard, Newton Methods for Nonlinear Problems, 2004: a test that
does not depend on units).

The foundation is elastic and has no friction. Across a round lumen its energy is convex, so that it adds
stiffness: a robot that would snap under the same forces as dead loads may be stable on the wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ctr_nlp.loads.contact_rods import ContactBodies, ContactRods, ContactState, ContactStates
from ctr_nlp.loads.rod_pieces import piece_positions, unloaded_state
from ctr_nlp.loads.winkler_wall import WallPush
from ctr_nlp.models.elastic.compiled import (
    MAX_PREDICTED_TURN_RAD,
    MAX_PREDICTION_ERROR_RAD,
    MIN_PATH_STEP_FRACTION,
)
from ctr_nlp.models.loaded.equilibria import MAX_LOADED_NEWTON_TURN_RAD, LoadedEquilibria, States
from ctr_nlp.models.loaded.stability import known_smooth_margins, margins, smooth_margins
from ctr_nlp.typing import Array, Flags, Index

CONTACT_FORCE_TOLERANCE_N = 1e-4
"""Largest difference, N, between the forces on all pieces and the wall's pushes at their depths."""
CONTACT_TIP_TOLERANCE_RAD = 1e-7
"""Largest last Newton step of the tip, rad."""
MAX_CONTACT_NEWTON_STEPS, MAX_CONTACT_STEP_HALVINGS = 25, 6
"""Most Newton steps for one equilibrium, and most halvings of each."""
NEAR_WALL_MM = 2.0
"""Distance from the wall up to which the forces on a piece are unknowns, mm."""
TIP_SCALE_MM_PER_RAD, FORCE_SCALE_MM_PER_N = 50.0, 1.0
"""Scales of tip and forces in the size of a Newton step: about the lengths by which they move a robot."""
MIN_WALL_SHARE_STEP = 2.0**-20
"""Least step in which the wall is hardened around a robot without a history: one that would be 100 mm outside of
the lumen needs a wall that soft to begin with."""


class ContactEquilibria(ContactRods):
    """Solver of equilibria of one robot on a wall. Not to be used from several threads at once."""

    def place(self, q: Array, load: Array) -> ContactState | None:
        """Return the equilibrium of a robot without a history at q (2d + 2,) under a load (17 + 3d,).

        Free of the wall it is turned there from aligned tubes; then the load grows and the wall hardens. None
        where a branch ends on the way.
        """
        d = self.robot.d
        free = unloaded_state(self.equilibria, self.robot, q[None])
        if not np.isfinite(free.determinant).all():
            return None
        pieces = piece_positions(self.robot, self.kind, q[None, d : 2 * d])[0].shape[1]
        # Of d + 2 rows each, dF/dz has the misfit's derivatives, and the determinant those of the base: minus
        # them.
        sign = float(np.sign(free.determinant[0])) * (-1) ** d
        state = ContactState(q.copy(), 0 * load, free.angles[0], free.axes[0], np.zeros((pieces, 2, 3)), sign)
        done = 0.0
        step = 1.0
        while done < 1.0:
            ahead = min(done + step, 1.0)
            found = self._solve(state._replace(load=ahead * load), ahead)
            if found is not None:
                state, done, step = found, ahead, 2 * step
            elif step < MIN_WALL_SHARE_STEP:
                return None
            else:
                step /= 2
        return state._replace(load=load)

    def follow(
        self, state: ContactState, q: Array, load: Array, smallest: float = MIN_PATH_STEP_FRACTION
    ) -> tuple[ContactState, float]:
        """Follow the branch of an equilibrium towards q (2d + 2,) and a load (17 + 3d,), on a line in both.

        Returns the last equilibrium on the branch and the fraction of the line that was covered: 1 for all of it.
        smallest: least fraction in a step.
        """
        start = state
        done = 0.0
        step = 1.0
        while done < 1.0 and step >= smallest:
            ahead = min(done + step, 1.0)
            goal = q if ahead == 1.0 else start.q + ahead * (q - start.q)
            pull = load if ahead == 1.0 else start.load + ahead * (load - start.load)
            found = self._solve(state._replace(q=goal, load=pull), turned=goal - state.q)
            if found is None:
                step /= 2
            else:
                state, done, step = found, ahead, 2 * step
        return state, done

    def follow_motion(self, q: Array, loads: Array) -> list[ContactState]:
        """Return the equilibria along a motion q (M, 2d + 2) under loads (M, 17 + 3d), as far as its branch leads.

        The first is reached without a history; none where that fails.
        """
        states = list[ContactState]()
        for place, load in zip(q, loads, strict=True):
            if not states:
                first = self.place(place, load)
                if first is None:
                    break
                states.append(first)
                continue
            there, done = self.follow(states[-1], place, load)
            if done < 1:
                break
            states.append(there)
        return states

    def shape(self, state: ContactState, sigma: Array) -> Array:
        """Return points (n, 3), mm, of a state at sigma (n,), parts of the robot's length."""
        return self.shapes(ContactStates.stack([state]), sigma)[0]

    def contact(self, state: ContactState) -> WallPush:
        """Return what the wall does to a state at the points (K, M) of its pieces."""
        return WallPush(*(each[0] for each in self.contacts(self.bodies(ContactStates.stack([state])))))

    def find_narrow_pieces(self, state: ContactState) -> Flags:
        """Return the pieces (K,) of a state around which the lumen is narrower than the robot, at any point."""
        samples, radius = self.samples(self.bodies(ContactStates.stack([state])))
        return np.asarray(self.wall.is_narrower(samples[0], radius[0]).any(axis=1))

    def force_mismatch(self, state: ContactState) -> float:
        """Return the sum over pieces of the difference between force and push, N."""
        bodies = self.bodies(ContactStates.stack([state]))
        return self._mismatch(state, bodies, self.contacts(bodies), 1.0)

    def margins(self, states: ContactStates, bending: bool = False) -> Array:
        """Return the stability margins (T,) of equilibria, where the wall's forces change as the robot moves.

        As of models/loaded/stability.py, with the foundation's part of the second variation beside the bending
        one: 0 at a snap, 1 where no tube acts on another. NaN under a load that has no energy. bending: margins to
        buckling instead.
        """
        if not self.load.conservative:
            return np.full(len(states.q), np.nan)
        return margins(self._foundation_rods, self._founded_states(states), bending)

    def smooth_margins(self, states: ContactStates, at: Array, near: Sequence[Index] | None = None) -> Array:
        """Return stability margins (T,) of equilibria that are smooth functions of them.

        See models/loaded/stability.py. at (T,): margins at which they are tested. near: pieces of each state that
        may touch; by default all of them.
        """
        return smooth_margins(self._foundation_rods, self._founded_states(states, near), at)

    def known_margins(self, states: ContactStates, at: Array) -> Array:
        """Return smooth margins (T,) as above, NaN where the robot is so far below them that they are wrong."""
        return known_smooth_margins(self._foundation_rods, self._founded_states(states), at)

    @cached_property
    def _foundation_rods(self) -> LoadedEquilibria:
        """Rods whose responses contain the wall's stiffness."""
        return LoadedEquilibria(self.robot.structure, self.kind._replace(founded=True))

    def _founded_states(self, states: ContactStates, near: Sequence[Index] | None = None) -> States:
        """Return T states whose load numbers have the wall's stiffness on every piece.

        near: pieces of each state that may touch; by default all of them.
        """
        bodies = self.bodies(states)
        count, pieces = bodies.lengths.shape
        near = [np.arange(pieces)] * count if near is None else near
        which = np.repeat(np.arange(count), [len(each) for each in near]), np.concatenate(near)
        slope = np.zeros((count, pieces, 3, 3))
        push = self.contacts_of(bodies, *which)
        of_points = push.flat_slope if self.searched else push.slope
        slope[which] = np.tensordot(of_points, self.rule.weights, (1, 0))
        # An energy has a symmetric second derivative; a lumen that tapers presses towards its path all the same.
        slope = (slope + np.swapaxes(slope, 2, 3)) / 2
        forces = np.concatenate([states.pushes.reshape(count, pieces, 6), slope.reshape(count, pieces, 9)], axis=2)
        load = np.hstack([states.load, forces.reshape(count, -1)])
        numbers = np.repeat(self.robot.numbers[None], count, axis=0)
        unknown = States.unknown_states(numbers, states.q, load)
        return unknown._replace(angles=states.angles, axes=states.axes)

    def _solve(self, start: ContactState, share: float = 1.0, turned: Array | None = None) -> ContactState | None:
        """Return the equilibrium at q and load of `start`, near its tip and pushes; None where none is found.

        share: part of the wall's stiffness. turned (2d + 2,): change of q since the equilibrium that gave tip and
        pushes, which may be on another branch if the tip turns much more than the motors.
        """
        state = start
        first: ContactState | None = None
        d = self.robot.d
        contact = self.contacts(self.bodies(ContactStates.stack([state])))
        for _ in range(MAX_CONTACT_NEWTON_STEPS):
            here = ContactStates.stack([state])
            (near,) = self.find_near(here, contact, NEAR_WALL_MM)
            (system,), _ = self.systems(here, [near], contact, share)
            (step,) = newton_steps(system.jacobian, system.residual[None])
            if not abs(step[: d + 2]).max() <= MAX_LOADED_NEWTON_TURN_RAD:
                return None
            if first is None:
                first = self._apply_step(state, step, near)
                if _turns_too_far(step, turned, d):
                    return None
            lengths = system.lengths[0]
            size = step_size(step, near, lengths, d)
            part = 1.0
            for _ in range(MAX_CONTACT_STEP_HALVINGS):
                tried = self._apply_step(state, part * step, near)
                there = ContactStates.stack([tried])
                bodies = self.bodies(there)
                contact = self.contacts(bodies)
                (residual,) = self.residuals(there, bodies, [near], contact, share)
                (ahead,) = newton_steps(system.jacobian, residual)
                if step_size(ahead, near, lengths, d) <= (1 - part / 4) * size + 1e-9:
                    break
                part /= 2
            else:
                return None
            state = tried
            if abs(step[: d + 2]).max() < CONTACT_TIP_TOLERANCE_RAD and (
                self._mismatch(state, bodies, contact, share) < CONTACT_FORCE_TOLERANCE_N
            ):
                sign = float(np.linalg.slogdet(system.jacobian)[0])
                away = max(abs(state.angles - first.angles).max(), abs(state.axes - first.axes).max())
                # Another sign: another branch, or past the end of this one.
                same_branch = sign == start.sign and away < MAX_PREDICTION_ERROR_RAD
                return state._replace(sign=sign) if same_branch else None
        return None

    def _mismatch(self, state: ContactState, bodies: ContactBodies, contact: WallPush, share: float) -> float:
        """Return the sum over pieces of the difference between force and push, N."""
        apart = state.pushes - share * self.rule.projection @ contact.push[0]
        return float((np.linalg.norm(apart, axis=2).sum(axis=1) * bodies.lengths[0]).sum())

    def _apply_step(self, state: ContactState, step: Array, near: Index) -> ContactState:
        """Return a state after a step (n,) of its tip and of the pushes on pieces near the wall."""
        d = self.robot.d
        pushes = np.zeros_like(state.pushes)
        pushes[near] = step[d + 2 :].reshape(-1, 2, 3)
        moved = ContactStates.stack([state]).apply_changes(step[None, : d + 2], pushes, 0 * state.q)
        return moved.row(0)._replace(sign=state.sign)


def newton_steps(matrix: Array, residuals: Array) -> Array:
    """Return the steps (P, n) that remove residuals (P, n) to first order; NaN where none is known.

    matrix (n, n): derivatives of the residuals by the unknowns.
    """
    if not np.isfinite(matrix).all():
        return np.full(residuals.shape, np.nan)
    residuals = np.where(np.isfinite(residuals).all(axis=1, keepdims=True), residuals, np.nan)
    try:
        return np.asarray(-np.linalg.solve(matrix, residuals.T).T)
    except np.linalg.LinAlgError:
        return np.full(residuals.shape, np.nan)


def step_size(step: Array, near: Index, lengths: Array, d: int) -> float:
    """Return the size of a Newton step (n,), mm: how far it moves the robot, and the forces that it adds.

    Its first d + 2 entries are angles; then come the pushes on the pieces `near`. lengths (K,): of all pieces, mm.
    d: number of tubes.
    """
    pushes = step[d + 2 :].reshape(-1, 2, 3) * lengths[near, None, None]
    turned, pushed = np.linalg.norm(step[: d + 2]), np.linalg.norm(pushes)
    return float(np.hypot(TIP_SCALE_MM_PER_RAD * turned, FORCE_SCALE_MM_PER_N * pushed))


def _turns_too_far(step: Array, turned: Array | None, d: int) -> bool:
    """Return whether a step of the tip turns tubes against each other much farther than their motors (turned)."""
    if turned is None or d == 1:
        return False
    motors = turned[:d]
    allowed = MAX_PREDICTED_TURN_RAD + abs(motors[:-1] - motors[-1]).max()
    return bool(abs(step[2 : d + 1] - step[d + 1]).max() > allowed)
