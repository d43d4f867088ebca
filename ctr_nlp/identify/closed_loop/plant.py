"""A simulated plant: a robot with tubes, motor zeros and backlash of its own, observed only through sensors."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

from ctr_nlp.codegen.batch_evaluator import BatchEvaluator
from ctr_nlp.codegen.vector import SHARED_INPUT_PREFIX, VECTOR_LANES
from ctr_nlp.exceptions import LoadError, RobotError
from ctr_nlp.identify.closed_loop.compilation import compile_function
from ctr_nlp.identify.closed_loop.sensors import SensedShape
from ctr_nlp.models import Model, model_named, model_with_load
from ctr_nlp.models.loads import require_constant_load
from ctr_nlp.models.protocol import build_sample_function
from ctr_nlp.models.walker import Walker
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.backlash import BacklashAndDrag, against_outer
from ctr_nlp.plan.sample_motions import SAMPLE_SUBSTEPS_PER_FRAME
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import RobotSamples, apply_backlash
from ctr_nlp.robot.structure import Structure
from ctr_nlp.support.value_checks import floats
from ctr_nlp.typing import Array

SAMPLES_PER_LANE = -(-len(SIGMA_GRID) // VECTOR_LANES)
"""Number of points of the shape in each of the lanes in which it is evaluated."""


class PlantState(NamedTuple):
    """State of a plant at a time, s: motors q (2d + 2,), unknowns x (n_x,), shape (101, 3) mm at uniform sigma.

    jumps: of its tips (d,), rad, in the motion to it, an entry a snap.
    """

    time: float
    q: Array
    x: Array
    shape: Array
    jumps: tuple[Array, ...]


class Plant:
    """One sampled robot, moved by its motors; the first q is reached from aligned tubes.

    Tubes have the sample's backlash, as in RobotSamples.tube_configurations, or a given backlash with drag. The
    same calls give the same motion.
    """

    def __init__(
        self,
        robot: Robot,
        sample: RobotSamples,
        model: str | Model = "elastic",
        steps: npt.ArrayLike = 0.0,
        bending: Sequence[float] = (0.0, 0.0),
        lag: BacklashAndDrag | None = None,
    ) -> None:
        """Build the plant from one sample of a nominal robot.

        model: kinematic model. steps: resolution of the motors, rad and mm, one or (2d + 2,), 0 for none. bending:
        unmodelled deflection of the tip along x and y, mm, of the fully extended robot; along the robot it grows
        with the square of arc length. lag: backlash and drag instead of the sample's; tubes then stand at their
        motors' angles at the first q. A force of the sample acts at its tip all the time, in addition to the
        model's load. Raises LoadError, OptionError, RobotError.
        """
        if len(sample) != 1:
            raise RobotError(f"a plant simulates one robot; sample has {len(sample)}")
        self._model = _with_tip_force(model_named(model), sample.forces[0])
        self._model.check(robot)
        if lag is not None:
            lag.check(robot)
        self._robot = robot
        self._lag = lag
        self._structure = sample.structure
        self._numbers = sample.numbers[0]
        self._offsets = sample.offsets[0]
        self._lags = sample.backlash[0]
        self._reach = robot.reach
        size = 2 * robot.d + 2
        self._steps = np.broadcast_to(np.asarray(steps, dtype=float), (size,))
        self._bent = floats(RobotError, "bending", bending, (2,))
        load = (
            np.zeros(0)
            if self._model.applied_load is None
            else require_constant_load(self._model.applied_load, "a plant").numbers(robot.d)
        )
        self._given = np.concatenate([self._numbers.ravel("F"), load])
        self._view = _view(self._model, self._structure)
        self._walker: Walker | None = None
        self.history = list[PlantState]()
        """States after every command, in order."""

    @property
    def has_snapped(self) -> bool:
        """Whether it has ever jumped from one equilibrium into another, or has none."""
        return any(moved.jumps or not np.isfinite(moved.x).all() for moved in self.history)

    def move_to(self, q: Array, time: float) -> PlantState:
        """Move the motors linearly to q (2d + 2,), reached at a time, s; return the state there."""
        q = self._round_to_steps(np.asarray(q, dtype=float))
        jumps = list[Array]()
        if self._walker is None:
            aligned = np.full_like(self._lags, q[len(self._lags) - 1])
            self._alpha = (
                self._robot.split(q)[0]
                if self._lag
                else apply_backlash(aligned, self._robot.split(q)[0], self._lags)
            )
            self._walker = self._model.walker(self._structure, self._numbers, self._tube_configuration(q))
        else:
            before = self.history[-1].q
            passed = (time - self.history[-1].time) / SAMPLE_SUBSTEPS_PER_FRAME
            places = (
                before
                + (q - before) * (np.arange(SAMPLE_SUBSTEPS_PER_FRAME + 1) / SAMPLE_SUBSTEPS_PER_FRAME)[:, None]
            )
            for there, place in itertools.pairwise(places):
                self._alpha = self._tube_angles_after(there, place, passed)
                jumps += self._walker.move_to(self._tube_configuration(place))
        found = PlantState(time, q, self._walker.x, self._at(SIGMA_GRID)[0], tuple(jumps))
        self.history.append(found)
        return found

    def _round_to_steps(self, q: Array) -> Array:
        """Return q (2d + 2,) rounded to multiples of the motors' steps."""
        size = np.where(self._steps > 0, self._steps, 1.0)
        return np.where(self._steps > 0, np.round(q / size) * size, q)

    def _tube_angles_after(self, before: Array, q: Array, time: float) -> Array:
        """Return the tubes' angles (d,), rad, without zeros, after motors have moved from `before` to q.

        before, q: (2d + 2,). time: duration of the motion, s.
        """
        motors = self._robot.split(q)[0]
        if self._lag is None:
            return apply_backlash(self._alpha, motors, self._lags)
        turn = against_outer(self._robot, q) - against_outer(self._robot, before)
        ahead = self._alpha - self._robot.split(before)[0]
        return motors + self._lag.advance_offset(
            ahead, turn, self._lag.play_at(self._robot, q[None])[..., 0, :], time
        )

    def _tube_configuration(self, q: Array) -> Array:
        """Return the configuration (2d + 2,) of the tubes, with their lags and zeros, where motors are at q."""
        found = q.copy()
        found[: len(self._lags)] = self._alpha + self._offsets
        return found

    def sample_shape(self, sigma: Array) -> SensedShape:
        """Return the shape at sigma (n,), at most 101 points, without slopes."""
        points, tangents = self._at(sigma)
        none = np.zeros((0, len(sigma), 3))
        return SensedShape(points, tangents, none, none, self._length)

    @property
    def _length(self) -> float:
        """Length of the robot, mm."""
        return float(self.history[-1].q[2 * len(self._lags) - 1]) if self.history else 0.0

    def _at(self, sigma: Array) -> tuple[Array, Array]:
        """Return points and tangents (n, 3) at sigma (n,), mm and unit vectors."""
        assert self._walker is not None
        x = self._walker.x
        d = len(self._lags)
        count = len(sigma)
        self._view.inputs[1][0] = np.resize(sigma, VECTOR_LANES * SAMPLES_PER_LANE)
        points, tangents = (
            found.reshape(VECTOR_LANES, 3, SAMPLES_PER_LANE).swapaxes(1, 2).reshape(-1, 3)[:count]
            for found in self._view(x, self._given)
        )
        if self._bent.any():
            # A parabola from the base, whose slope is added to tangents: a bend that no tube's number explains.
            s = sigma * x[2 * d - 1]
            aside = np.append(self._bent, 0.0) / self._reach**2
            points += np.multiply.outer(s**2, aside)
            tangents += np.multiply.outer(2 * s, aside)
            tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        return points, tangents


def _with_tip_force(model: Model, force: Array) -> Model:
    """Return a model with a further force (3,), N, at the tip.

    Raises LoadError where the model's load changes over time or turns with the tool, or moduli are not known.
    """
    if not force.any():
        return model
    load = require_constant_load(model.applied_load, "a plant")
    if load.axes == "tool" and any((*load.force, *load.moment)):
        raise LoadError("the sample has a tip force, which cannot be combined with a load in the axes of the tool")
    pushed = replace(load, axes="base", force=tuple(np.add(load.force, force)))
    return model_with_load(model, pushed)


def _view(model: Model, structure: Structure) -> BatchEvaluator:
    """Return the evaluator of (x, sigma, numbers (d, 8) and load) -> points and tangents, in parallel lanes."""
    return BatchEvaluator(_compiled_view(model.program_model, structure), 1)


@functools.lru_cache(maxsize=16)
def _compiled_view(model: Model, structure: Structure) -> ca.Function:
    of = build_sample_function(model, structure, SAMPLES_PER_LANE)
    x, sigma, *given = (ca.SX.sym(of.name_in(i), *of.size_in(i)) for i in range(4))
    found = of(x, sigma, *given)
    names = ([f"{SHARED_INPUT_PREFIX}x", "sigma", f"{SHARED_INPUT_PREFIX}given"], ["points", "tangents"])
    inputs = [x, sigma, ca.vertcat(*(ca.vec(each) for each in given))]
    return compile_function(
        ca.Function("view", inputs, [ca.densify(each) for each in found], *names), VECTOR_LANES
    )
