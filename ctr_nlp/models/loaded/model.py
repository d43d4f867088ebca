"""The elastic model of a robot that bears a load, as a Model; its unknowns are x = (phi, beta, w) of tips.py."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ctr_nlp.loads import Load, LoadOverTime, steady
from ctr_nlp.models.dominant.shape import columns_of
from ctr_nlp.models.elastic import shape
from ctr_nlp.models.elastic.torsion import sections
from ctr_nlp.models.loaded.acting import RodKind, check_kinds, loading
from ctr_nlp.models.loaded.compiled import Rods
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.following.follower import Follower
from ctr_nlp.models.loaded.following.walking import LoadedWalker
from ctr_nlp.models.loaded.shape import shape_under
from ctr_nlp.models.loaded.stability import margins
from ctr_nlp.models.loaded.tips import tips, unknowns
from ctr_nlp.models.protocol import (
    SUBSTEPS,
    Followed,
    Model,
    Passage,
    Places,
    Shape,
    combination,
    of_rows,
    passage,
)
from ctr_nlp.models.walker import Walker
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import Structure, Tubes, tubes_in_columns
from ctr_nlp.typing import Array, Vector

PIECE = 6
"""Steps of integration through whose tangents one polynomial goes: through more, evenly spaced, it swings between
them."""
TOGETHER = 128
"""Robots that are followed side by side: of more, all places would need too much memory."""


@dataclass(frozen=True)
class Loaded(Model):
    """Torsionally compliant tubes under a load; without one the elastic model, to 0.001 mm.

    Under a load over time the rows of x and q are the frames of the whole motion; rest is that of its first one.
    """

    load: Load | LoadOverTime

    name = "elastic"
    several_equilibria = True
    can_snap = True

    @property
    def bears(self) -> Load | LoadOverTime:
        """The load."""
        return self.load

    @property
    def form(self) -> Loaded:
        """As Model.form: one for each kind of rod."""
        return FORMS[self.kind]

    @property
    def kind(self) -> RodKind:
        """What kind of rods it makes of robots."""
        return RodKind.of(self.load)

    def check(self, robot: Robot) -> None:
        """Raise LoadError unless the robot tells its moduli, has no helix, and the load fits it."""
        check_kinds(robot.structure.kinds)
        self.load.check(robot)

    def frame(
        self,
        structure: Structure,
        tubes: Tubes,
        places: Places,
        margin: ca.SX | None = None,
        tangents: bool = False,
    ) -> Shape:
        """As Model.frame, with the load's numbers in it; raises LoadError where these change over time."""
        acting = steady(self.load, "a shape without a time").numbers(structure.d)
        return self.frame_under(ca.SX(ca.DM(acting)), structure, tubes, places, margin, tangents)

    def frame_under(
        self,
        load: ca.SX,
        structure: Structure,
        tubes: Tubes,
        places: Places,
        margin: ca.SX | None = None,
        tangents: bool = False,
        tilted: bool = False,
    ) -> Shape:
        """As Model.frame_under."""
        acting = loading(ca.vertsplit(load))
        return shape_under(acting, self.kind, structure, tubes, places, margin, tangents, tilted)

    def points(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """As Model.points."""
        return self._curves(robot, x, sigma)[0]

    def tangents(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """As Model.tangents."""
        return self._curves(robot, x, sigma)[1]

    def _over(self, d: int, rows: int) -> Array:
        """Numbers (rows, 17 + 3d) of what acts on robots of d tubes in every frame of a motion."""
        return self.load.over(d, np.linspace(0.0, 1.0, rows))

    def _curves(self, robot: Robot, x: Array, sigma: Array) -> tuple[Array, Array]:
        acting = self._over(robot.d, len(x))
        return curves(robot.structure, robot.numbers[None], acting, x, sigma, self.kind)

    def points_apart(self, structure: Structure, numbers: Array, x: Array, sigma: Array) -> Array:
        """As Model.points_apart."""
        acting = self.acting_apart(len(x), self._over(structure.d, x.shape[1]))
        rows = of_rows(numbers, x, sigma)
        found = self.points_under(acting.reshape(len(rows[1]), -1), structure, *rows)
        return found.reshape(*x.shape[:2], *found.shape[1:])

    def points_under(self, loads: Array, structure: Structure, numbers: Array, x: Array, sigma: Array) -> Array:
        """As Model.points_under."""
        return curves(structure, numbers, loads, x, sigma, self.kind)[0]

    def acting_apart(self, count: int, acting: Array) -> Array:
        """Numbers (count, M, 17 + 3d) of what acts on so many robots; acting (M, 17 + 3d): those of the load."""
        return np.broadcast_to(acting, (count, *acting.shape))

    def margins(self, robot: Robot, x: Array) -> Array:
        """As Model.margins; NaN under a load that has no energy."""
        found, known = np.full(len(x), np.nan), np.isfinite(x).all(axis=1)
        if self.load.conservative and known.any():
            equilibria = self._equilibria(robot)
            acting = self._over(robot.d, len(x))
            found[known] = margins(equilibria, self._states(equilibria, robot, x[known], acting[known]))
        return found

    def states(self, robot: Robot, x: Array) -> States:
        """The states of unknowns x (T, 2d + 2), each an equilibrium of its own configuration."""
        return self._states(self._equilibria(robot), robot, x, self._over(robot.d, len(x)))

    def _states(self, equilibria: LoadedEquilibria, robot: Robot, x: Array, acting: Array) -> States:
        of_robot = np.repeat(robot.numbers[None], len(x), axis=0)
        return equilibria.states(of_robot, *tips(x, robot.d), x[:, robot.d : 2 * robot.d], acting)

    def _equilibria(self, robot: Robot) -> LoadedEquilibria:
        return LoadedEquilibria(robot.structure, self.kind)

    def rest(self, robot: Robot, q: Array) -> Array:
        """Where all tubes are turned to together from alpha_d, and then loaded; NaN where it snaps on the way."""
        found: Array = self._follower(robot, self._over(robot.d, 1)).rest(np.asarray(q, dtype=float)[None])[0]
        return found

    def guess(self, robot: Robot, q: Array) -> Array:
        """As if tubes had their motors' angles all along, and bore nothing."""
        rows = np.reshape(q, (-1, np.shape(q)[-1]))
        return np.reshape(self.unloaded(robot, rows, rows[:, : robot.d]), np.shape(q))

    def unloaded(self, robot: Robot, q: Array, angles: Array) -> Array:
        """The unknowns (T, 2d + 2) of a robot that stands at q (T, 2d + 2) and bears nothing.

        angles (T, d): of its tubes' tips, against each other.
        """
        of_robot = np.repeat(robot.numbers[None], len(q), axis=0)
        return unknowns(*self._equilibria(robot).placed(of_robot, q, angles), q)

    def loaded(self, robot: Robot, q: Array, angles: Array) -> Array:
        """The unknowns (T, 2d + 2) after the load has come at each q (T, 2d + 2), as far as the robot bears it.

        angles (T, d): as for unloaded. Where the robot snaps on the way, these are of the equilibrium before that.
        """
        equilibria, of_robot = self._equilibria(robot), np.repeat(robot.numbers[None], len(q), axis=0)
        free = equilibria.unloaded(of_robot, q, angles)
        return equilibria.along(free, q, self._over(robot.d, len(q)))[0].unknowns

    def configuration(self, robot: Robot, x: Array) -> Array:
        """As Model.configuration; alpha up to whole turns of all tubes together, theta_x within a quarter turn."""
        return self.states(robot, x).q

    def extensions(self, robot: Robot, x: Array) -> Array:
        """As Model.extensions; x holds them where q does."""
        return x[:, robot.d : 2 * robot.d]

    def follow(self, robot: Robot, q: Array, x0: Array | None = None, substeps: int = SUBSTEPS) -> Followed:
        """As Model.follow: the load comes in the first frame, and is taken away in the last one.

        x0 is not looked at: a robot is where the load has brought it.
        """
        way = passage(np.asarray(q, dtype=float), substeps)
        return self._follower(robot, self.load.over(robot.d, way.parts)).followed(way, way.q[None])[0]

    def follow_apart(
        self, structure: Structure, numbers: Array, way: Passage, q: Array, margins: bool = True
    ) -> list[Followed]:
        """As Model.follow_apart."""
        acting = self.acting_apart(len(numbers), self.load.over(structure.d, way.parts))
        return self.follow_under(acting, structure, numbers, way, q, margins)

    def follow_under(
        self, loads: Array, structure: Structure, numbers: Array, way: Passage, q: Array, margins: bool = True
    ) -> list[Followed]:
        """As Model.follow_under, of loads of its kind."""
        found = list[Followed]()
        for some in (slice(first, first + TOGETHER) for first in range(0, len(numbers), TOGETHER)):
            follower = Follower(structure, numbers[some], self.load, loads[some])
            found += follower.followed(way, q[some], margins)
        return found

    def walker(self, structure: Structure, numbers: Array, q: Array) -> Walker:
        """As Model.walker; raises LoadError under a load that changes over time."""
        return LoadedWalker(structure, numbers, q, steady(self.load, "a robot that moves step by step"))

    def _follower(self, robot: Robot, acting: Array) -> Follower:
        """The follower of one robot; acting (M, 17 + 3d): at every place of a way."""
        return Follower(robot.structure, robot.numbers[None], self.load, acting[None])


@dataclass(frozen=True, eq=False)
class Pushed(Loaded):
    """The same of n robots, each of which bears one of forces (n, 3), N, beside the load.

    The forces are in the directions of the base. Only robots apart bear them: follow_apart, points_apart.
    """

    forces: Array

    def acting_apart(self, count: int, acting: Array) -> Array:
        """As Loaded.acting_apart, of the n robots."""
        found = np.array(super().acting_apart(count, acting))
        found[..., :3] += self.forces[:, None]
        return found


UNIT = (0.0, 0.0, 1.0)
_KINDS = itertools.product(("base", "tool"), ((0.0, 0.0, 0.0), UNIT), (None, UNIT), (None, 1.0))
_LOADS = [
    Load(
        UNIT,
        axes,
        moment=moment,
        distributed_force=along,
        between=None if along is None else (0.0, 1.0),
        densities=density,
        down=None if density is None else UNIT,
    )
    for axes, moment, along, density in _KINDS
]
FORMS = {RodKind.of(load): Loaded(load) for load in _LOADS}
"""What programs are made of."""


def curves(
    structure: Structure, numbers: Array, acting: Array, x: Array, sigma: Array, kind: RodKind
) -> tuple[Array, Array]:
    """Points and tangents (T, n, 3) of robots of numbers (T or 1, d, 8) under loads (T or 1, l) of such rods."""
    d, rows = structure.d, len(x)
    of_robots = np.broadcast_to(numbers, (rows, *numbers.shape[1:]))
    beta, load = x[:, d : 2 * d], np.broadcast_to(acting, (rows, acting.shape[1]))
    ends = Rods(structure, kind)(of_robots, *tips(x, d), beta, load, np.ones((rows, 2)))
    tubes, out, steps = tubes_in_columns(structure, numbers), columns_of(beta), min(kind.steps, PIECE)
    curved = [
        vector
        for nodes in np.moveaxis(ends.tangents, 0, 2)
        for first in range(0, kind.steps, steps)
        for vector in shape.powers([_vector(tangent) for tangent in nodes[first : first + steps + 1]])
    ]
    parts = kind.divided(sections(tubes, out, np, planes=False))
    pieces = [piece for part in parts for piece in part.divided(kind.steps // steps)]
    lengths, turns = shape.travels(tubes, out, pieces, sigma * out[-1], np, steps // 2)
    like = np.zeros((rows, np.shape(sigma)[-1]))
    base = _vector(ends.axes[:, 2])
    points, tangents = combination(lengths, curved), combination([1.0, *turns], [base, *curved])
    return _stacked(points, like), _stacked(tangents, like)


def _vector(rows: Array) -> Vector:
    x, y, z = columns_of(rows)
    return x, y, z


def _stacked(vector: Vector, like: Array) -> Array:
    return np.stack([part + like for part in vector], axis=-1)
