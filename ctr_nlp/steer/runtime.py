"""Steering while the target moves: one configuration for one target, as they come."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.formulations.joint import joint, tip_steps
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.terms import ShapeDistance
from ctr_nlp.formulations.terms.shape import STRIDE
from ctr_nlp.models import Model, model_named
from ctr_nlp.robot import Robot
from ctr_nlp.solvers.frame.adapter import FEASIBLE, OPTIMAL
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.support.values import instance, number
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array


class Steerer:
    """The joint formulation in a loop at run time: everything is built once, and a step solves one frame.

    A step is a few tens of microseconds of compiled code, and at most sqp.c's MOST_ITERATIONS of some ten
    microseconds each. It never leaves limits of position and speed: where no better configuration is found, the
    robot stays where it is. Not for two threads at once: one for each.

    q (2d + 2,): where the robot stands. solved: whether the last step ended at a KKT point; objective: mm^2;
    kkt: residual; iterations.
    """

    def __init__(
        self,
        robot: Robot,
        q: npt.ArrayLike,
        dt: float,
        settings: Settings = DEFAULTS,
        model: str | Model = "dominant",
    ) -> None:
        """Build for a robot that stands at q and moves every dt s; raises OptionError, RobotError.

        OptionError also where nothing can be compiled. On the elastic model the robot is taken to have been turned
        to q from where all its tubes were aligned.
        """
        instance(RobotError, "robot", robot, Robot)
        instance(OptionError, "settings", settings, Settings)
        number(OptionError, "dt", dt, lambda x: 0 < x < math.inf, "be a finite number > 0", " s")
        described = model_named(model)
        described.check(robot)
        self.q = robot.check(q).copy()
        (stage,) = joint(robot, settings, described)
        self._program = Program(stage.nlp, wait=True)
        self._picks, self._x = stage.nlp.configuration, described.rest(robot, self.q)
        self._tips = len(self._picks) - len(self.q)
        free, most = np.full(self._tips, np.inf), np.append(robot.speed * dt, tip_steps(robot, dt)[: self._tips])
        self._limits = np.append(robot.lower, -free), np.append(robot.upper, free), most
        places = {name: self._program.p[stage.nlp.place(name)] for name in stage.nlp.parameters}
        places["tubes"][:] = robot.numbers.ravel(order="F")
        places["shape_roots"][:] = ShapeDistance().roots
        if "gap" in places:
            places["gap"][:] = robot.carriage_gap
        self._target = places["target"].reshape(3, -1)
        self._previous = places["previous"]
        places["motion_root"][:] = math.sqrt(settings.motion_weight) / dt
        if "margin" in places:
            places["margin"][:] = settings.stability_margin
        self.solved, self.objective, self.kkt, self.iterations = False, math.nan, math.nan, 0

    def step(self, target: Array) -> Array:
        """The configuration (2d + 2,) dt s later, for a target (101, 3) in mm at uniform sigma.

        Raises OptionError where the target has another shape or numbers that are not finite.
        """
        if np.shape(target) != (len(SIGMA), 3):
            raise OptionError(f"target has shape {np.shape(target)}; it must be {(len(SIGMA), 3)}")
        if not np.isfinite(target).all():
            raise OptionError(f"target has {target[~np.isfinite(target)][0]} mm; all of it must be finite")
        at, (lower, upper, most), n = self._program, self._limits, len(self._x)
        self._target[:] = target[::STRIDE].T
        self._previous[:], at.x[:] = self.q, self._x
        here = np.append(self.q, self._x[: self._tips])
        low, high = np.maximum(lower, here - most), np.minimum(upper, here + most)
        at.lower[self._picks], at.upper[self._picks] = low, high
        found = at.run()
        self.solved = found.kkt <= OPTIMAL and found.violation <= FEASIBLE
        self.objective, self.kkt, self.iterations = found.objective, found.kkt, found.iterations
        if found.violation <= FEASIBLE:
            self._x = np.clip(at.x, at.lower[:n], at.upper[:n])
            values = np.append(self._x, at.rows[n:])[self._picks]
            self.q = np.clip(values, low, high)[: len(self.q)]
        else:
            at.multipliers[:] = 0.0
        return self.q.copy()
