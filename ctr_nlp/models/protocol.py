"""The interface of a kinematic model: one frame in symbols for nonlinear programs, batches of numbers for the
rest.

A frame's shape is a sum of lengths times directions, written in layers of inner quantities (models/inner.py), so
that programs can differentiate it cheaply. Symbols: q = (alpha, beta, theta) of eq. (5), rad and mm; x (n_x,): the
model's unknowns, which are q itself or determine it; sigma = s / beta_d in [0, 1]; numbers (d, 8) of the tubes, in
the order of robot.structure.TUBE_NUMBER_NAMES; load (17 + 3d,), in the order of loads.Load.numbers. T counts
frames, n and m count robots or samples.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models.inner import Inner
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.models.loads.load import FIRST_WEIGHT_COLUMN
from ctr_nlp.models.walker import ConfigurationWalker, Walker
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure, Tubes, tubes_of
from ctr_nlp.typing import Array, Flags, Index, Vector

STABILITY_SUBSTEPS_PER_FRAME = 10
"""Steps from frame to frame in which stability margins are evaluated."""
SampleArcLengths = Callable[[Sequence[ca.SX]], ca.SX]
"""A function from beta to the arc lengths (n, 1) of samples, mm."""


@dataclass(frozen=True)
class SymbolicShape:
    """The shape of a robot at some samples, in symbols; everything but x is written in the symbols of inner.

    Attributes
    ----------
    x : ca.SX
        The unknowns (n, 1).
    alpha : ca.SX
        The motors' angles (d, 1), rad.
    beta : tuple of ca.SX
        The d extensions, mm.
    points : tuple of ca.SX
        x, y, z of the samples, each (n, 1) mm, in axes whose directions are `base`.
    inner : Inner
        Quantities between x and the shape; an empty one, ``Inner()``, where the shape is written in x.
    tangents : tuple of ca.SX, optional
        x, y, z of the unit tangents at the samples, in the axes of `points`; None where not requested.
    base : tuple, optional
        The three axes in which points and tangents are written; None for the base frame itself.
    stability : ca.SX, optional
        Determinants (k, 1) that are positive where the stability margin is at least the one required.
    picks : tuple of int, optional
        Positions of alpha, beta and theta among the entries of x followed by `rows`, and after them of further
        entries that identify the equilibrium branch; None where x is q.
    theta : ca.SX, optional
        The tilt (2, 1), rad, where x does not contain it.
    aside : ca.SX, optional
        Where x contains the tilt beside unknowns that determine it, the angles (2, 1) in rad between the base's
        direction and that tilt; they must be 0.
    """

    x: ca.SX
    alpha: ca.SX
    beta: tuple[ca.SX, ...]
    points: Vector
    inner: Inner
    tangents: Vector | None = None
    base: tuple[Vector, Vector, Vector] | None = None
    stability: ca.SX | None = None
    picks: tuple[int, ...] | None = None
    theta: ca.SX | None = None
    aside: ca.SX | None = None

    @property
    def rows(self) -> dict[str, ca.SX]:
        """Functions of x that belong to the configuration or must be 0, by name, in the order of picks."""
        found = {"alpha": self.alpha, "theta": self.theta, "aside": self.aside}
        return {name: value for name, value in found.items() if value is not None}

    def to_shape_axes(self, vectors: ca.SX) -> Vector:
        """Express vectors (n, 3), given in the base frame, in the axes of `points`."""
        if self.base is None:
            return columns_of(vectors)
        # Axes are orthonormal: the components along them are dot products. Turning the target's constant
        # points once is cheaper than turning the robot's, which have derivatives.
        x, y, z = (sum(vectors[:, i] * axis[i] for i in range(3)) for axis in self.base)
        return x, y, z

    def to_base_frame(self, vectors: Vector) -> Vector:
        """Express vectors, given in the axes of `points`, in the base frame.

        vectors: x, y, z of points in mm, or of tangents.
        """
        # None means that the model computes in the base frame: turning by the identity would cost
        # operations.
        return vectors if self.base is None else combination(vectors, self.base)


class Snap(NamedTuple):
    """A loss of stability during a motion.

    frame: the frame before which it happens, from 1. tubes: tubes whose tips jump, from 1. jump: largest jump of a
    tip, rad; None where the equilibrium after the snap is not known.
    """

    frame: int
    tubes: tuple[int, ...]
    jump: float | None


class EquilibriumPath(NamedTuple):
    """Equilibria of a robot along a motion: x (T, n), NaN where its configuration is, or where none are found.

    stability (T,): margins at frames; stability_between (T,): least margins between a frame and the one before, at
    most 0 where the robot snaps; NaN where nothing can be unstable.
    """

    x: Array
    stability: Array
    stability_between: Array
    snaps: tuple[Snap, ...] = ()


class RestStates(NamedTuple):
    """Equilibria of robots at rest without a history, NaN where none is found.

    x (T, n): unknowns. points (T, m, 3) mm; tips (T, 3): directions of tips; margins (T,): stability margins, NaN
    where nothing can be unstable.
    """

    x: Array
    points: Array
    tips: Array
    margins: Array

    @property
    def is_solved(self) -> Flags:
        """Whether an equilibrium was found, (T,)."""
        return np.asarray(np.isfinite(self.x).all(axis=1))


class MotionSubsteps(NamedTuple):
    """Sub-steps q (M, 2d + 2) of a motion through `total` frames; frames that are NaN have none.

    frames (M,): the frame that a sub-step is in or leads to, from 0; a frame's last sub-step is the frame itself.
    fresh (M,): whether a robot settles there without a history, in the first frame and after frames that are NaN.
    """

    q: Array
    frames: Index
    fresh: Flags
    total: int

    @property
    def elapsed_fractions(self) -> Array:
        """Fraction of the whole motion that has passed at every sub-step, (M,), from 0 in the first frame to 1."""
        places = np.bincount(self.frames, minlength=self.total)[self.frames]
        # frames is sorted: searchsorted finds the first sub-step of each frame, so number counts within it
        # from 1.
        number = 1 + np.arange(len(self.frames)) - np.searchsorted(self.frames, self.frames)
        return np.asarray((self.frames - 1 + number / places) / max(self.total - 1, 1))


def subdivide_motion(q: Array, substeps: int) -> MotionSubsteps:
    """Divide a motion through frames q (T, 2d + 2) linearly, with so many substeps between neighbours."""
    known = np.asarray(np.isfinite(q).all(axis=1))
    # Only a frame whose predecessor is known is reached in sub-steps; any other known frame is a single fresh
    # start.
    joined = known & np.concatenate([[False], known[:-1]])
    steps = np.where(joined, substeps, known.astype(int))
    frames = np.repeat(np.arange(len(q)), steps)
    part = (np.arange(len(frames)) - (np.cumsum(steps) - steps)[frames] + 1) / steps[frames]
    before = q[frames - joined[frames]]
    after = q[frames]
    # The last sub-step is the frame itself, without rounding: states are compared with goals for equality.
    places = np.where((part == 1)[:, None], after, before + part[:, None] * (after - before))
    return MotionSubsteps(places, frames, ~joined[frames], len(q))


class Model(ABC):
    """A map from configuration to backbone.

    A new model defines name and frame; `register` makes it available by name. The defaults suit a model whose
    unknowns are the configuration q (2d + 2,) itself, with one shape for each.

    Attributes
    ----------
    name : str
        Name by which options and files call the model. It must differ from every string that code
        compares with, such as the kinds of tubes.
    several_equilibria : bool
        Whether q alone does not determine the unknowns x; then x has d tip angles first, and `rest`, `guess`,
        `configuration` and `follow` must be defined.
    can_snap : bool
        Whether an equilibrium can become unstable.
    bends_by_extension : bool
        Whether curvatures depend on beta alone, which two-stage formulations need.

    Examples
    --------
    >>> from ctr_nlp import table_i_robot
    >>> from ctr_nlp.models import model_named
    >>> robot = table_i_robot()
    >>> q = np.array([[0.0, 0.0, 0.0, 20.0, 50.0, 90.0, 0.0, 0.0]])
    >>> model_named("dominant").points(robot, q, np.array([0.0, 1.0])).shape
    (1, 2, 3)
    """

    name: str
    several_equilibria = False
    can_snap = False
    bends_by_extension = False

    def check(self, robot: Robot) -> None:  # noqa: B027 - most models describe any robot
        """Raise OptionError unless the model can describe the robot."""

    def check_planning(self, robot: Robot) -> None:
        """Raise OptionError unless the model is accurate enough for the robot to be planned on it.

        By default this is `check`. A stricter model overrides it: shapes of a given configuration are computed
        wherever `check` passes.
        """
        self.check(robot)

    def fast(self, structure: Structure) -> bool:
        """Return whether shapes and margins are computed by fast code by now: in microseconds, not milliseconds.

        structure: kinds of the tubes. Where speed needs compiled code, the first call begins to compile it in the
        background.
        """
        return True

    def batches_in_threads(self, structure: Structure) -> bool:
        """Return whether several threads may follow robots of a structure, each with robots of its own."""
        return False

    @abstractmethod
    def frame(
        self,
        structure: Structure,
        tubes: Tubes,
        sample_lengths: SampleArcLengths,
        margin: ca.SX | None = None,
        tangents: bool = False,
    ) -> SymbolicShape:
        """Build the shape of one frame in symbols.

        Parameters
        ----------
        structure : Structure
            Kinds of the tubes.
        tubes : Tubes
            Their numbers, as symbols, outermost first.
        sample_lengths : callable
            Maps the d extensions beta to the arc lengths (n, 1) of the samples, mm.
        margin : ca.SX, optional
            Least stability margin for which `SymbolicShape.stability` is built; None for none.
        tangents : bool
            Whether tangents at the samples are needed, too.

        Returns
        -------
        SymbolicShape
            Its `x` are new symbols.
        """

    @property
    def applied_load(self) -> Load | LoadOverTime | None:
        """The load on the robot, absent at the beginning and the end of a motion; None for none.

        With a load, frame_with_load must be defined.
        """
        return None

    @property
    def metadata(self) -> dict[str, Any]:
        """Metadata of plans made on this model (Plan.meta): its name, and its load if it has one."""
        found: dict[str, Any] = {"model": self.name}
        return found if self.applied_load is None else found | {"planned_load": self.applied_load.to_dict()}

    @property
    def program_model(self) -> Model:
        """The model from which programs are built: one for all models that differ in numbers alone."""
        return self

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
        """Build the shape of one frame in symbols under a load whose numbers (17 + 3d, 1) are symbols.

        load: these symbols. structure, tubes, sample_lengths, margin, tangents: as in `frame`. tilted: whether x
        contains the tilt, too, after unknowns that determine it. Raises OptionError on models without loads.
        """
        raise OptionError(f"model is {self.name!r}, which does not support loads")

    def points(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """Return points (T, n, 3) in mm of a robot at unknowns x (T, n_x) and sigma (n,) or (T, n)."""
        return self._sample_curve(robot, x, sigma)[0]

    def tangents(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """Return unit tangents (T, n, 3) of a robot at unknowns x (T, n_x) and sigma (n,) or (T, n)."""
        return self._sample_curve(robot, x, sigma)[1]

    def _sample_curve(self, robot: Robot, x: Array, sigma: Array) -> tuple[Array, Array]:
        """Return points and tangents (T, n, 3), frame by frame, by CasADi's interpreter.

        Arguments as in `points`.
        """
        sigma = np.broadcast_to(sigma, (len(x), np.shape(sigma)[-1]))
        function = build_sample_function(self, robot.structure, sigma.shape[1])
        numbers = robot.numbers
        # The empty argument is the load: models without one have no numbers there.
        found = [function(row, at, numbers, []) for row, at in zip(x, sigma, strict=True)]
        points, tangents = (np.array([each[k].full() for each in found]) for k in range(2))
        return points, tangents

    def points_batch(self, structure: Structure, numbers: Array, x: Array, sigma: Array) -> Array:
        """Return points (n, T, m, 3) in mm of robots that differ in numbers (n, d, 8), each at x (n, T, n_x).

        structure: what the robots share. sigma: (m,) or (T, m).
        """
        tubes, each, at = flatten_batch(numbers, x, sigma)
        # One sigma for all rows, or one a row: both as (n T, m).
        rows = zip(each, np.broadcast_to(at, (len(each), np.shape(at)[-1])), tubes, strict=True)
        function = build_sample_function(self, structure, np.shape(sigma)[-1])
        return np.reshape([function(*row, [])[0].full() for row in rows], (*x.shape[:2], -1, 3))

    def points_with_loads(
        self, loads: Array, structure: Structure, numbers: Array, x: Array, sigma: Array
    ) -> Array:
        """Return points (T, m, 3) in mm of robots at x (T, n_x), each under a load of its own.

        loads (T, 17 + 3d). structure: what the robots share. numbers (T or 1, d, 8): of the tubes. sigma: (m,) or
        (T, m). Raises OptionError on models without loads.
        """
        raise OptionError(f"model is {self.name!r}, which does not support loads")

    def margins(self, robot: Robot, x: Array) -> Array:
        """Return the stability margins (T,) of a robot at unknowns x (T, n_x), from 1 down to 0 at the snap.

        NaN where nothing can be unstable.
        """
        return np.full(len(x), np.nan)

    def rest(self, robot: Robot, q: Array) -> Array:
        """Return the unknowns (n_x,) of a robot at rest at q (2d + 2,) without a history."""
        return np.copy(q)

    def rest_states(self, robot: Robot, q: Array, sigma: Array) -> RestStates:
        """Return the equilibria of a robot at rest at each q (T, 2d + 2) without a history.

        sigma (m,): where points are computed.
        """
        x = np.array([self.rest(robot, each) for each in q])
        # sigma = 1 is the tip.
        tips = self.tangents(robot, x, np.ones(1))[:, 0]
        return RestStates(x, self.points(robot, x, sigma), tips, self.margins(robot, x))

    def rest_batch(
        self, structure: Structure, numbers: Array, q: Array, sigma: Array, threads: int = 1
    ) -> RestStates:
        """Return the equilibria at rest without a history, of robots that differ in numbers (T or 1, d, 8).

        structure: what the robots share. q (T, 2d + 2): a configuration for each. sigma (m,): where points are
        computed. threads: number of threads that may share the rows. Raises OptionError where the model does not
        find perturbed robots at rest.
        """
        raise OptionError(
            f"model is {self.name!r}, and does not find robots at rest in a batch; give 'elastic', without a load"
        )

    def guess(self, robot: Robot, q: Array) -> Array:
        """Estimate the unknowns (.., n_x) of a robot at q (.., 2d + 2) quickly, as a solver's initial guess."""
        return np.copy(q)

    def configuration(self, robot: Robot, x: Array) -> Array:
        """Return the configurations q (T, 2d + 2) of a robot at unknowns x (T, n_x)."""
        return np.copy(x)

    def extensions(self, robot: Robot, x: Array) -> Array:
        """Return the extensions beta (T, d) in mm of a robot at unknowns x (T, n_x)."""
        return self.configuration(robot, x)[:, robot.d : 2 * robot.d]

    def follow(
        self, robot: Robot, q: Array, x0: Array | None = None, substeps: int = STABILITY_SUBSTEPS_PER_FRAME
    ) -> EquilibriumPath:
        """Return the equilibria of a robot moved linearly through frames q (T, 2d + 2).

        x0 (n_x,): its equilibrium in the first frame; None for a robot that settles there. substeps: between
        frames. After frames that are NaN it settles again without a history.
        """
        unknown = np.full(len(q), np.nan)
        return EquilibriumPath(np.array(q, dtype=float), unknown, unknown)

    def follow_with_loads(
        self,
        loads: Array,
        structure: Structure,
        numbers: Array,
        motion: MotionSubsteps,
        q: Array,
        margins: bool = True,
    ) -> list[EquilibriumPath]:
        """Follow robots under loads (n, M, 17 + 3d), given at the sub-steps of a motion.

        structure, numbers, motion, q, margins and the result: as in follow_batch. Raises OptionError on models
        without loads.
        """
        raise OptionError(f"model is {self.name!r}, which does not support loads")

    def walker(self, structure: Structure, numbers: Array, q: Array) -> Walker:
        """Return a robot at rest at q (2d + 2,) without a history, to be moved step by step.

        structure: kinds of its tubes. numbers (d, 8): of its tubes.
        """
        if self.several_equilibria:
            raise OptionError(f"model is {self.name!r}, and does not tell how robots move step by step")
        return ConfigurationWalker(q)

    def follow_batch(
        self, structure: Structure, numbers: Array, motion: MotionSubsteps, q: Array, margins: bool = True
    ) -> list[EquilibriumPath]:
        """Follow robots that differ in numbers (n, d, 8), each through its own q (n, M, 2d + 2) at the sub-steps.

        structure: what the robots share. motion: which frames the M sub-steps belong to, and where robots settle
        without a history. margins: whether stability margins are computed, which takes longer than the unknowns;
        NaN otherwise. Raises OptionError where the model has several equilibria and cannot follow perturbed
        robots.
        """
        if self.several_equilibria:
            raise OptionError(
                f"model is {self.name!r}, and does not follow robots that differ from the one described"
            )
        # The last sub-step of each frame is the frame itself; with one shape for each q, the others do not
        # matter.
        ends = np.flatnonzero(np.diff(motion.frames, append=-1))
        unknown = np.full(motion.total, np.nan)
        x = np.full((len(q), motion.total, q.shape[2]), np.nan)
        x[:, motion.frames[ends]] = q[:, ends]
        return [EquilibriumPath(each, unknown, unknown) for each in x]


def flatten_batch(numbers: Array, x: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Flatten a batch of separate robots: numbers (n, d, 8), x (n, T, n_x) and sigma (T, m), as rows (n T, ..).

    A sigma (m,), common to all of them, is returned unchanged.
    """
    count, frames = x.shape[:2]
    # Robot by robot, all frames of each: the order of x.reshape.
    at = sigma if np.ndim(sigma) == 1 else np.tile(sigma, (count, 1))
    return np.repeat(numbers, frames, axis=0), x.reshape(count * frames, -1), at


@functools.lru_cache(maxsize=64)
def build_sample_function(model: Model, structure: Structure, count: int) -> ca.Function:
    """Build the function (x, sigma (count,), numbers (d, 8), load) -> points and tangents (count, 3).

    Points are in mm, both in the base frame. structure: kinds of the tubes. count: samples along the robot. load:
    its numbers; empty for a model without one. The result is cached: one function for each model, structure and
    count.
    """
    sigma = ca.SX.sym("sigma", count)
    numbers = ca.SX.sym("numbers", structure.d, len(TUBE_NUMBER_NAMES))
    tubes = symbolic_tubes(structure, numbers)
    # sigma is relative to the robot's length beta_d: s = sigma beta_d.
    shape, load = frame_and_load_symbol(model, structure, tubes, lambda beta: sigma * beta[-1], tangents=True)
    assert shape.tangents is not None
    # Points and tangents are written in inner symbols, which a plain function must not contain: substitute
    # their values.
    written = [ca.SX(ca.horzcat(*shape.to_base_frame(vectors))) for vectors in (shape.points, shape.tangents)]
    symbols, values = shape.inner.columns
    found = ca.substitute(written, [symbols], [values])
    return ca.Function("samples", [shape.x, sigma, numbers, load], found, {"cse": True})


def frame_and_load_symbol(
    model: Model,
    structure: Structure,
    tubes: Tubes,
    sample_lengths: SampleArcLengths,
    margin: ca.SX | None = None,
    tangents: bool = False,
) -> tuple[SymbolicShape, ca.SX]:
    """Build the frame of a model, and a symbol for its load's numbers, empty for a model without one.

    structure, tubes, sample_lengths, margin, tangents: as in Model.frame.
    """
    if model.applied_load is None:
        return model.frame(structure, tubes, sample_lengths, margin, tangents), ca.SX(0, 1)
    load = ca.SX.sym("load", FIRST_WEIGHT_COLUMN + 3 * structure.d)
    return model.frame_with_load(load, structure, tubes, sample_lengths, margin, tangents), load


def symbolic_tubes(structure: Structure, numbers: ca.SX) -> Tubes:
    """Return tubes of a structure whose numbers are the entries of a symbol (d, 8)."""
    return tubes_of(
        structure, [[numbers[i, k] for k in range(len(TUBE_NUMBER_NAMES))] for i in range(structure.d)]
    )


def combination(weights: Sequence[object], vectors: Sequence[Vector]) -> Vector:
    """Return the sum of weights times vectors, component by component."""
    x, y, z = (sum(w * v[i] for w, v in zip(weights, vectors, strict=True)) for i in range(3))
    return x, y, z


def columns_of(vectors: ca.SX) -> Vector:
    """Split vectors (n, 3) into x, y and z, each (n, 1)."""
    x, y, z = ca.horzsplit(vectors)
    return x, y, z


def matrix_of(vectors: Sequence[Vector]) -> ca.SX:
    """Join vectors as the columns of a matrix (3, n)."""
    return ca.horzcat(*(ca.vertcat(ca.SX(0, 1), *vector) for vector in vectors))


def vectors_of(matrix: ca.SX) -> list[Vector]:
    """Split a matrix (3, n) into its columns, as vectors."""
    columns = (ca.vertsplit(column) for column in ca.horzsplit(matrix))
    return [(x, y, z) for x, y, z in columns]
