"""The elastic model of a robot under a load, as a :class:`~ctr_nlp.models.protocol.Model`.

Force and moment are known at the tip, and so the rod is integrated from there to the base (Rucker, Jones, Webster,
A Geometrically Exact Model for Externally Loaded Concentric-Tube Continuum Robots, IEEE Transactions on Robotics
26(5), 2010; rod.py). Every tip is then the equilibrium of some configuration q, and the unknowns are those of the
tip (tips.py):

    x = (psi_1 - psi_d, .., psi_(d-1) - psi_d, psi_d, beta_1, .., beta_d, w_1, w_2)        (2d + 2,)

psi_i, rad, is the angle of tube i at its own tip; beta_i, mm, its extension; and (w_1, w_2, 0), rad, the rotation
vector of the tip's frame. The motors' angles alpha and the tilt theta of q, eq. (5) of the paper, follow from x.

A load enters as a row of 17 + 3d numbers (:meth:`ctr_nlp.models.loads.Load.numbers`), never as an object, so that
one compiled program serves all loads of a kind (:class:`~ctr_nlp.models.loaded.rod_loads.RodKind`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ctr_nlp.models.dominant.shape import columns_of
from ctr_nlp.models.elastic import shape
from ctr_nlp.models.elastic.torsion import sections
from ctr_nlp.models.loaded.compiled import Rods
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.following.follower import Follower
from ctr_nlp.models.loaded.following.walking import LoadedWalker
from ctr_nlp.models.loaded.rod_loads import RodKind, check_kinds, loading
from ctr_nlp.models.loaded.shape import build_loaded_shape
from ctr_nlp.models.loaded.stability import margins
from ctr_nlp.models.loaded.tips import tips, unknowns
from ctr_nlp.models.loads import Load, LoadOverTime, require_constant_load
from ctr_nlp.models.protocol import (
    STABILITY_SUBSTEPS_PER_FRAME,
    EquilibriumPath,
    Model,
    MotionSubsteps,
    SampleArcLengths,
    SymbolicShape,
    combination,
    flatten_batch,
    subdivide_motion,
)
from ctr_nlp.models.walker import Walker
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import Structure, Tubes, tubes_of_batch
from ctr_nlp.typing import Array, Vector

PIECE = 6
"""Steps of integration whose tangents one polynomial interpolates. Through more, evenly spaced nodes it would
oscillate between them.
"""
MAX_FOLLOWED_ROBOTS_PER_BATCH = 128
"""Robots in one batch that is followed; with more, the states at all places would need too much memory."""


@dataclass(frozen=True)
class Loaded(Model):
    """Torsionally compliant tubes under a load.

    Without a load (``Load()``) the shapes are those of the elastic model to 0.001 mm. Configurations q are
    (2d + 2,) rows: alpha in rad, beta in mm, theta in rad, eq. (5) of the paper; the unknowns x (2d + 2,) are
    explained at the top of this module.

    Parameters
    ----------
    load : Load or LoadOverTime
        The load. One that changes over time is spread over a whole motion: methods that take x or q of T frames
        take the first row for its beginning and the last row for its end, and :meth:`rest` uses its first load.

    Examples
    --------
    A rod of 100 mm is bent by 0.01 N at its tip; beam theory has F L^3 / (3 E I) = 0.279 mm.

    >>> import ctr_nlp as ctr
    >>> rod = ctr.Robot((ctr.Tube(200, 150, 0.0, 1.5, 1.0, youngs_modulus=60_000),))
    >>> model = ctr.Loaded(ctr.Load(force=(0.0, 0.01, 0.0)))
    >>> x = model.rest(rod, np.array([0.0, 100.0, 0.0, 0.0]))
    >>> float(model.points(rod, x[None], np.ones(1))[0, 0, 1].round(3))
    0.279
    """

    load: Load | LoadOverTime

    name = "elastic"
    several_equilibria = True
    can_snap = True

    @property
    def applied_load(self) -> Load | LoadOverTime:
        """The load that acts on the robot."""
        return self.load

    @property
    def program_model(self) -> Loaded:
        """The model from which programs are built, one for each kind of rod: the load's numbers are parameters."""
        return LOADED_PROGRAM_MODELS[self.kind]

    @property
    def kind(self) -> RodKind:
        """Kind of rod that the load makes of a robot: which of the load's terms its equations contain."""
        return RodKind.of(self.load)

    def check(self, robot: Robot) -> None:
        """Raise LoadError unless the equations of a loaded rod can describe the robot.

        Parameters
        ----------
        robot : Robot
            The robot.

        Raises
        ------
        LoadError
            A tube is a helix, a Young's modulus is not in MPa, or the load has densities of another number of
            tubes.
        """
        check_kinds(robot.structure.kinds)
        self.load.check(robot)

    def frame(
        self,
        structure: Structure,
        tubes: Tubes,
        sample_lengths: SampleArcLengths,
        margin: ca.SX | None = None,
        tangents: bool = False,
    ) -> SymbolicShape:
        """Build the shape of one frame in symbols, with the load's numbers written in as constants.

        Parameters
        ----------
        structure : Structure
            What is compiled of the robot: kinds of its tubes.
        tubes : Tubes
            The tubes, outermost first, with numbers or symbols for lengths (mm), curvatures (1/mm) and
            stiffnesses.
        sample_lengths : callable
            ``sample_lengths(beta)`` returns the arc lengths (n, 1) of the samples in mm for the extensions beta in
            mm.
        margin : SX, optional
            Least stability margin; with it the shape has determinants that are positive where it is kept.
        tangents : bool
            Whether tangents at the samples are wanted, too.

        Returns
        -------
        SymbolicShape
            Points in mm and the rest of the frame, as symbols of x.

        Raises
        ------
        LoadError
            The load changes over time, or the robot has a helix.
        """
        acting = require_constant_load(self.load, "a shape without a time").numbers(structure.d)
        return self.frame_with_load(ca.SX(ca.DM(acting)), structure, tubes, sample_lengths, margin, tangents)

    def frame_with_load(
        self,
        load: ca.SX,
        structure: Structure,
        tubes: Tubes,
        sample_lengths: SampleArcLengths,
        margin: ca.SX | None = None,
        tangents: bool = False,
        tilted: bool = False,
    ) -> SymbolicShape:
        """Build the shape of one frame in symbols, under a load whose numbers are symbols, too.

        Parameters
        ----------
        load : SX
            The load's numbers (17 + 3d, 1), in the order of :meth:`ctr_nlp.models.loads.Load.numbers`. Of them
            only those count that this model's kind of rod has.
        structure : Structure
            What is compiled of the robot: kinds of its tubes.
        tubes : Tubes
            The tubes, outermost first, with numbers or symbols for lengths (mm), curvatures (1/mm) and
            stiffnesses.
        sample_lengths : callable
            ``sample_lengths(beta)`` returns the arc lengths (n, 1) of the samples in mm for the extensions beta in
            mm.
        margin : SX, optional
            Least stability margin; with it the shape has determinants that are positive where it is kept.
        tangents : bool
            Whether tangents at the samples are wanted, too.
        tilted : bool
            Whether x has the tilt theta (2,) as further unknowns behind it. Two equations then say that the base
            points where theta has it, and nothing is singular at theta_x = 90 degrees, where theta as a function
            of x is.

        Returns
        -------
        SymbolicShape
            Points in mm and the rest of the frame, as symbols of x.

        Raises
        ------
        LoadError
            The robot has a helix.
        """
        acting = loading(ca.vertsplit(load))
        return build_loaded_shape(acting, self.kind, structure, tubes, sample_lengths, margin, tangents, tilted)

    def points(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """Compute points of the backbone at given unknowns.

        Parameters
        ----------
        robot : Robot
            The robot.
        x : (T, 2d + 2) array
            Unknowns, one row a frame; rad and mm.
        sigma : (n,) or (T, n) array
            Arc lengths as parts of beta_d, in [0, 1].

        Returns
        -------
        (T, n, 3) array
            Points in the robot's base frame, mm; NaN where x is.
        """
        return self._curves(robot, x, sigma)[0]

    def tangents(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """Compute unit tangents of the backbone at given unknowns.

        Parameters
        ----------
        robot : Robot
            The robot.
        x : (T, 2d + 2) array
            Unknowns, one row a frame; rad and mm.
        sigma : (n,) or (T, n) array
            Arc lengths as parts of beta_d, in [0, 1].

        Returns
        -------
        (T, n, 3) array
            Tangents in the robot's base frame, towards the tip, of length 1 to the accuracy of the integration.
        """
        return self._curves(robot, x, sigma)[1]

    def _loads_over_frames(self, d: int, rows: int) -> Array:
        """Return the numbers (rows, 17 + 3d) of the load in every frame of a motion of that many frames (rows).

        d: number of tubes. Frames are evenly spaced in time, from 0, the beginning of the load, to 1, its end.
        """
        return self.load.numbers_at(d, np.linspace(0.0, 1.0, rows))

    def _curves(self, robot: Robot, x: Array, sigma: Array) -> tuple[Array, Array]:
        """Return points and tangents (T, n, 3) of a robot at unknowns x (T, 2d + 2) and sigma (n,) or (T, n)."""
        acting = self._loads_over_frames(robot.d, len(x))
        return curves(robot.structure, robot.numbers[None], acting, x, sigma, self.kind)

    def points_batch(self, structure: Structure, numbers: Array, x: Array, sigma: Array) -> Array:
        """Compute points of several robots that differ in their tubes' numbers, in one batch.

        Parameters
        ----------
        structure : Structure
            The structure that all robots share.
        numbers : (n, d, 8) array
            The tubes' numbers of every robot, in the order of ``robot.structure.TUBE_NUMBER_NAMES``.
        x : (n, T, 2d + 2) array
            Unknowns of every robot in every frame; rad and mm.
        sigma : (m,) or (T, m) array
            Arc lengths as parts of beta_d, in [0, 1].

        Returns
        -------
        (n, T, m, 3) array
            Points in the robots' base frames, mm.
        """
        acting = self.loads_of_batch(len(x), self._loads_over_frames(structure.d, x.shape[1]))
        # Robots and frames are one axis from here on: every row has its tubes and its load.
        rows = flatten_batch(numbers, x, sigma)
        found = self.points_with_loads(acting.reshape(len(rows[1]), -1), structure, *rows)
        return found.reshape(*x.shape[:2], *found.shape[1:])

    def points_with_loads(
        self, loads: Array, structure: Structure, numbers: Array, x: Array, sigma: Array
    ) -> Array:
        """Compute points of robots, each under a load of its own.

        Parameters
        ----------
        loads : (T, 17 + 3d) array
            The numbers of every row's load, in the order of :meth:`ctr_nlp.models.loads.Load.numbers`, used in
            place of this model's own load. Of them only those count that this model's kind of rod has.
        structure : Structure
            The structure that all robots share.
        numbers : (T, d, 8) or (1, d, 8) array
            The tubes' numbers, in the order of ``robot.structure.TUBE_NUMBER_NAMES``; one row serves all robots.
        x : (T, 2d + 2) array
            Unknowns; rad and mm.
        sigma : (m,) or (T, m) array
            Arc lengths as parts of beta_d, in [0, 1].

        Returns
        -------
        (T, m, 3) array
            Points in the robots' base frames, mm.
        """
        return curves(structure, numbers, loads, x, sigma, self.kind)[0]

    def loads_of_batch(self, count: int, acting: Array) -> Array:
        """Give each of several robots the load's numbers; a subclass may give every robot its own.

        Parameters
        ----------
        count : int
            Number n of robots.
        acting : (M, 17 + 3d) array
            The load's numbers at M places of a motion.

        Returns
        -------
        (n, M, 17 + 3d) array
            The numbers of what acts on every robot; a read-only view here.
        """
        return np.broadcast_to(acting, (count, *acting.shape))

    def margins(self, robot: Robot, x: Array) -> Array:
        """Compute stability margins of equilibria.

        The margin is the smallest mu at which (K + V) x = mu K x has a solution, with K the torsional part of the
        second variation of the energy and V the rest: 1 where no tube acts on another, 0 at the snap, negative
        where the equilibrium is unstable (stability.py).

        Parameters
        ----------
        robot : Robot
            The robot.
        x : (T, 2d + 2) array
            Unknowns, one row a frame; rad and mm.

        Returns
        -------
        (T,) array
            Margins. NaN where x is NaN, and everywhere under a load that has no energy.
        """
        found = np.full(len(x), np.nan)
        known = np.isfinite(x).all(axis=1)
        # A moment, or a force that turns with the tool, does work that depends on the path: there is no energy,
        # and so no second variation whose eigenvalues would be margins.
        if self.load.conservative and known.any():
            equilibria = self._equilibria(robot)
            acting = self._loads_over_frames(robot.d, len(x))
            found[known] = margins(equilibria, self._states(equilibria, robot, x[known], acting[known]))
        return found

    def states(self, robot: Robot, x: Array) -> States:
        """Describe the equilibria of unknowns x, each at the configuration that belongs to it.

        Parameters
        ----------
        robot : Robot
            The robot.
        x : (T, 2d + 2) array
            Unknowns, one row a frame; rad and mm.

        Returns
        -------
        States
            T equilibria with their configurations, tips, and derivatives of the motors' angles and the tilt.
        """
        return self._states(self._equilibria(robot), robot, x, self._loads_over_frames(robot.d, len(x)))

    def _states(self, equilibria: LoadedEquilibria, robot: Robot, x: Array, acting: Array) -> States:
        """Return the states of unknowns x (T, 2d + 2) of a robot, under loads acting (T, 17 + 3d)."""
        of_robot = np.repeat(robot.numbers[None], len(x), axis=0)
        return equilibria.states(of_robot, *tips(x, robot.d), x[:, robot.d : 2 * robot.d], acting)

    def _equilibria(self, robot: Robot) -> LoadedEquilibria:
        """Return the solver of equilibria of robots of this structure, under loads of this kind."""
        return LoadedEquilibria(robot.structure, self.kind)

    def rest(self, robot: Robot, q: Array) -> Array:
        """Find the equilibrium of a robot that has no history.

        Unloaded, all tubes are turned from where they are aligned at alpha_d to q; then the load grows from zero
        while q stays. Both motions are followed, so that the result is the equilibrium that a real robot reaches.

        Parameters
        ----------
        robot : Robot
            The robot.
        q : (2d + 2,) array
            Configuration; rad and mm.

        Returns
        -------
        (2d + 2,) array
            Unknowns x; NaN where the robot has no equilibrium there or snaps while the load grows.
        """
        # A load over time has its first value here: a robot at rest is at the beginning of its motion.
        found: Array = self._follower(robot, self._loads_over_frames(robot.d, 1)).rest(
            np.asarray(q, dtype=float)[None]
        )[0]
        return found

    def guess(self, robot: Robot, q: Array) -> Array:
        """Estimate unknowns without solving anything, to start a solver from.

        The tubes' tips get the angles of their motors, as if tubes did not twist, and the load is left out.

        Parameters
        ----------
        robot : Robot
            The robot.
        q : (.., 2d + 2) array
            Configurations; rad and mm.

        Returns
        -------
        (.., 2d + 2) array
            Approximate unknowns; no equilibria of q under the load.
        """
        # Untwisted tubes have their tips at their motors' angles; placed at q, they also have its tilt and
        # extensions.
        rows = np.reshape(q, (-1, np.shape(q)[-1]))
        return np.reshape(self.unloaded_unknowns(robot, rows, rows[:, : robot.d]), np.shape(q))

    def unloaded_unknowns(self, robot: Robot, q: Array, angles: Array) -> Array:
        """Compute unknowns of a robot without a load whose tubes have given angles at their tips.

        Such a tip is an equilibrium, with the extensions, the tilt and the alpha_d of q. The other motors' angles
        are those that belong to the tips: they are not looked at in q.

        Parameters
        ----------
        robot : Robot
            The robot.
        q : (T, 2d + 2) array
            Configurations; rad and mm.
        angles : (T, d) array
            Angles of the tubes at their tips, rad. Only differences from that of the innermost tube count.

        Returns
        -------
        (T, 2d + 2) array
            Unknowns.
        """
        of_robot = np.repeat(robot.numbers[None], len(q), axis=0)
        return unknowns(*self._equilibria(robot).place_unloaded_tips(of_robot, q, angles), q)

    def grow_load(self, robot: Robot, q: Array, angles: Array) -> Array:
        """Follow the equilibria of unloaded robots while the load grows from zero to its full size.

        Parameters
        ----------
        robot : Robot
            The robot.
        q : (T, 2d + 2) array
            Configurations, which stay as they are; rad and mm.
        angles : (T, d) array
            Angles of the tubes at their tips, rad, as of :meth:`unloaded_unknowns`: near the unloaded equilibrium
            at q, which is found from them by Newton's method.

        Returns
        -------
        (T, 2d + 2) array
            Unknowns under the load. Where the branch of equilibria ends before the load is complete, those of the
            last equilibrium that was found on it.
        """
        # Row by row, not along the motion: every frame is loaded by itself, from its own unloaded equilibrium.
        equilibria = self._equilibria(robot)
        of_robot = np.repeat(robot.numbers[None], len(q), axis=0)
        free = equilibria.solve_unloaded(of_robot, q, angles)
        return equilibria.follow_branches(free, q, self._loads_over_frames(robot.d, len(q)))[0].unknowns

    def configuration(self, robot: Robot, x: Array) -> Array:
        """Compute the configurations of unknowns.

        Parameters
        ----------
        robot : Robot
            The robot.
        x : (T, 2d + 2) array
            Unknowns, one row a frame; rad and mm.

        Returns
        -------
        (T, 2d + 2) array
            Configurations q. alpha is known up to whole turns of all tubes together, and theta_x is the one within
            a quarter turn; a tilt beyond it is returned as another q of the same shape.
        """
        return self.states(robot, x).q

    def extensions(self, robot: Robot, x: Array) -> Array:
        """Return the extensions beta, which x has in the same columns as q.

        Parameters
        ----------
        robot : Robot
            The robot.
        x : (T, 2d + 2) array
            Unknowns; rad and mm.

        Returns
        -------
        (T, d) array
            Extensions, mm.
        """
        return x[:, robot.d : 2 * robot.d]

    def follow(
        self, robot: Robot, q: Array, x0: Array | None = None, substeps: int = STABILITY_SUBSTEPS_PER_FRAME
    ) -> EquilibriumPath:
        """Follow the equilibria of the robot through a motion.

        The load grows from zero while the robot stands in the first frame, and is taken away in the last one: a
        real motion begins and ends without it. Between frames the robot moves linearly in q.

        Parameters
        ----------
        robot : Robot
            The robot.
        q : (T, 2d + 2) array
            Configurations of the frames; rad and mm. After rows that are NaN the robot comes to rest without a
            history.
        x0 : array, optional
            Ignored: the robot is where the load has brought it.
        substeps : int
            Steps from frame to frame at which margins are computed.

        Returns
        -------
        EquilibriumPath
            Unknowns and margins of the frames; NaN from a snap on, as nobody knows where a loaded robot then comes
            to rest.
        """
        # The load is a function of the fraction of the motion; a sub-step has the load of its own time.
        way = subdivide_motion(np.asarray(q, dtype=float), substeps)
        return self._follower(robot, self.load.numbers_at(robot.d, way.elapsed_fractions)).follow_motion(
            way, way.q[None]
        )[0]

    def follow_batch(
        self, structure: Structure, numbers: Array, motion: MotionSubsteps, q: Array, margins: bool = True
    ) -> list[EquilibriumPath]:
        """Follow the equilibria of several robots that differ in their tubes' numbers, in one batch.

        Parameters
        ----------
        structure : Structure
            The structure that all robots share.
        numbers : (n, d, 8) array
            The tubes' numbers of every robot, in the order of ``robot.structure.TUBE_NUMBER_NAMES``.
        motion : MotionSubsteps
            The sub-steps of the motion: which frames its M places belong to, and where robots begin without a
            history.
        q : (n, M, 2d + 2) array
            Configurations of every robot's tubes at these places; rad and mm.
        margins : bool
            Whether stability margins are computed, which takes longer than the unknowns; NaN otherwise.

        Returns
        -------
        list of EquilibriumPath
            Unknowns and margins of every robot.
        """
        acting = self.loads_of_batch(len(numbers), self.load.numbers_at(structure.d, motion.elapsed_fractions))
        return self.follow_with_loads(acting, structure, numbers, motion, q, margins)

    def follow_with_loads(
        self,
        loads: Array,
        structure: Structure,
        numbers: Array,
        motion: MotionSubsteps,
        q: Array,
        margins: bool = True,
    ) -> list[EquilibriumPath]:
        """Follow the equilibria of several robots, each under a load of its own.

        Parameters
        ----------
        loads : (n, M, 17 + 3d) array
            The numbers of every robot's load at the M places of the motion, used in place of this model's own
            load; of the same kind, and with an energy where that one has.
        structure : Structure
            The structure that all robots share.
        numbers : (n, d, 8) array
            The tubes' numbers of every robot, in the order of ``robot.structure.TUBE_NUMBER_NAMES``.
        motion : MotionSubsteps
            The sub-steps of the motion: which frames its M places belong to, and where robots begin without a
            history.
        q : (n, M, 2d + 2) array
            Configurations of every robot's tubes at these places; rad and mm.
        margins : bool
            Whether stability margins are computed, which takes longer than the unknowns; NaN otherwise.

        Returns
        -------
        list of EquilibriumPath
            Unknowns and margins of every robot.
        """
        found = list[EquilibriumPath]()
        # In batches: each holds the states of all its robots at all places.
        for some in (
            slice(first, first + MAX_FOLLOWED_ROBOTS_PER_BATCH)
            for first in range(0, len(numbers), MAX_FOLLOWED_ROBOTS_PER_BATCH)
        ):
            follower = Follower(structure, numbers[some], self.load, loads[some])
            found += follower.follow_motion(motion, q[some], margins)
        return found

    def walker(self, structure: Structure, numbers: Array, q: Array) -> Walker:
        """Place a robot that is moved step by step, as by its motors.

        Parameters
        ----------
        structure : Structure
            The robot's structure.
        numbers : (d, 8) array
            The tubes' numbers, in the order of ``robot.structure.TUBE_NUMBER_NAMES``.
        q : (2d + 2,) array
            The configuration at which it stands, without a history; rad and mm.

        Returns
        -------
        Walker
            The robot, under the load.

        Raises
        ------
        LoadError
            The load changes over time: a robot moved by hand has no end of the motion to relate it to.
        """
        return LoadedWalker(
            structure, numbers, q, require_constant_load(self.load, "a robot that moves step by step")
        )

    def _follower(self, robot: Robot, acting: Array) -> Follower:
        """Return the follower of a robot; acting (M, 17 + 3d): the load's numbers at every place of a motion."""
        return Follower(robot.structure, robot.numbers[None], self.load, acting[None])


# Equality and hash are inherited from Loaded and regard the load alone: arrays have neither, and functions that
# are cached by model do not depend on the forces.
@dataclass(frozen=True, eq=False)
class TipForceModel(Loaded):
    """A loaded model of n robots each of which has a tip force of its own beside the common load.

    Only the methods for several robots apply the forces: :meth:`follow_batch` and :meth:`points_batch`.

    Parameters
    ----------
    load : Load or LoadOverTime
        The load on all robots.
    forces : (n, 3) array
        Tip forces in the directions of the base frame, N.
    """

    forces: Array

    def loads_of_batch(self, count: int, acting: Array) -> Array:
        """Return the load's numbers acting (M, 17 + 3d) plus every robot's own tip force, (count, M, 17 + 3d).

        count must be the number n of forces.
        """
        found = np.array(super().loads_of_batch(count, acting))
        found[..., :3] += self.forces[:, None]  # the first three numbers are the tip force in base directions
        return found


# One load for each of the 16 kinds that a user's load can make. Which numbers it has is of no importance: programs
# take them as parameters, and only which of them are not zero decides which terms are compiled.
UNIT_LOAD_VECTOR = (0.0, 0.0, 1.0)
_LOAD_KIND_COMBINATIONS = itertools.product(
    ("base", "tool"), ((0.0, 0.0, 0.0), UNIT_LOAD_VECTOR), (None, UNIT_LOAD_VECTOR), (None, 1.0)
)
_LOADS = [
    Load(
        UNIT_LOAD_VECTOR,
        axes,
        moment=moment,
        distributed_force=along,
        between=None if along is None else (0.0, 1.0),
        densities=density,
        down=None if density is None else UNIT_LOAD_VECTOR,
    )
    for axes, moment, along, density in _LOAD_KIND_COMBINATIONS
]
LOADED_PROGRAM_MODELS = {RodKind.of(load): Loaded(load) for load in _LOADS}
"""The loaded model from which programs are built, by the kind of rod."""


def curves(
    structure: Structure, numbers: Array, acting: Array, x: Array, sigma: Array, kind: RodKind
) -> tuple[Array, Array]:
    """Compute points and tangents of the backbone from the tangents at the integration's nodes.

    Within a piece of :data:`PIECE` steps the tangent is the polynomial through its nodes; points are that
    polynomial's exact integral, so that points and tangents belong to the same curve.

    Parameters
    ----------
    structure : Structure
        The structure that all robots share.
    numbers : (T, d, 8) or (1, d, 8) array
        The tubes' numbers, in the order of ``robot.structure.TUBE_NUMBER_NAMES``: of every row, or once for all.
    acting : (T, l) or (1, l) array
        The numbers of what acts: 17 + 3d of a load, and further ones where forces act on pieces of the rod.
    x : (T, 2d + 2) array
        Unknowns; rad and mm.
    sigma : (n,) or (T, n) array
        Arc lengths as parts of beta_d, in [0, 1].
    kind : RodKind
        Which of the numbers the rod's equations contain.

    Returns
    -------
    points, tangents : (T, n, 3) array
        In mm, and unit vectors; in the robots' base frames.
    """
    d = structure.d
    rows = len(x)
    of_robots = np.broadcast_to(numbers, (rows, *numbers.shape[1:]))
    beta = x[:, d : 2 * d]
    load = np.broadcast_to(acting, (rows, acting.shape[1]))
    ends = Rods(structure, kind)(of_robots, *tips(x, d), beta, load, np.ones((rows, 2)))
    # Powers of one polynomial through all of a section's nodes, which are evenly spaced, would swing between them
    # (Runge's phenomenon); of PIECE steps they do not.
    tubes = tubes_of_batch(structure, numbers)
    out = columns_of(beta)
    steps = min(kind.steps, PIECE)
    curved = [
        vector
        for nodes in np.moveaxis(ends.tangents, 0, 2)
        for first in range(0, kind.steps, steps)
        for vector in shape.powers([_vector(tangent) for tangent in nodes[first : first + steps + 1]])
    ]
    parts = kind.split_sections(sections(tubes, out, np, planes=False))
    pieces = [piece for part in parts for piece in part.split_evenly(kind.steps // steps)]
    # travels counts steps of two intervals: a piece of `steps` intervals has steps + 1 nodes and powers.
    lengths, turns = shape.travels(tubes, out, pieces, sigma * out[-1], np, steps // 2)
    like = np.zeros((rows, np.shape(sigma)[-1]))
    base = _vector(ends.axes[:, 2])  # the tangent at the opening, to which all gains are added
    points = combination(lengths, curved)
    tangents = combination([1.0, *turns], [base, *curved])
    return _stack_components(points, like), _stack_components(tangents, like)


def _vector(rows: Array) -> Vector:
    """Split rows (T, 3) into their x, y and z, each a column (T, 1) that broadcasts over samples."""
    x, y, z = columns_of(rows)
    return x, y, z


def _stack_components(vector: Vector, like: Array) -> Array:
    """Join x, y and z as the last axis, broadcast to the shape (T, n) of an array of zeros."""
    return np.stack([part + like for part in vector], axis=-1)
