"""Steering while the target moves: one configuration for one target after another, eq. (9) frame by frame.

A step minimises the distance (8) from the robot to the target plus the motion term of eq. (9) from the present
configuration, subject to the limits (2), (3) and the speeds. Future targets are unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.models import DEFAULT_MODEL, Model, model_named
from ctr_nlp.models.loads import require_constant_load
from ctr_nlp.ocp.joint import joint
from ctr_nlp.ocp.local_parameters import LocalParameterSource
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.stage import Stage
from ctr_nlp.ocp.terms.arrival import ArrivalTerm, find_arrival, with_frame_arrival
from ctr_nlp.ocp.terms.shape import TARGET_SAMPLE_STRIDE, ShapeDistance
from ctr_nlp.ocp.wall import MAX_WALL_RELINEARISATIONS, WALL_SLACK_TOLERANCE_MM, Wall, make_wall
from ctr_nlp.paths.curve import Curve, curve_from_formula
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID, growing
from ctr_nlp.paths.walls import Body, WallGeometry, nearest_of
from ctr_nlp.planning.compiled_frames import reach_of
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.robot import Robot
from ctr_nlp.solvers.compiled_functions import library
from ctr_nlp.solvers.frame.adapter import KKT_TOLERANCE
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.solvers.frame.run import FrameSequence
from ctr_nlp.support.value_checks import check_instance, number
from ctr_nlp.typing import Array

MAX_STEERING_ITERATIONS = 60
"""Most SQP iterations of a step: a target that needs more is not waited for, since the next one comes soon."""


class Steerer:
    """Solve the joint formulation again and again while the target moves.

    Everything is built once, and each step solves one frame: a few tens of microseconds of compiled code, and at
    most `MAX_STEERING_ITERATIONS` of some ten to forty microseconds each. A step satisfies the limits of position
    and speed: where no better configuration is found, the robot stays where it is. Give each thread a steerer of
    its own.

    Parameters
    ----------
    robot : Robot
        The robot to steer.
    q : array_like
        Configuration (2d + 2,) in which the robot stands, in rad and mm. On the elastic model the robot is taken
        to have been turned to it from where all its tubes were aligned.
    dt : float
        Time from one step to the next, s.
    settings : Settings, optional
        Weights of motion, contact and arrival.
    model : str or Model, optional
        Kinematic model: ``"elastic"``, ``"dominant"`` or ``Loaded(load)`` with a load that stays the same.
    lumen : Curve, optional
        Path with a radius, within whose wall the robot is kept; no wall by default.
    walls : sequence of Body
        Surfaces that the robot stays inside of, or keeps away from. Where it stays inside of one, the lumen's
        radius is no wall.
    wait : bool
        Whether to wait until the program is compiled. Otherwise steps are interpreted, and take a millisecond or
        more, until it was compiled in the background. The parameters of a wall are always waited for.

    Raises
    ------
    OptionError, RobotError
        An argument is not what it must be, or nothing can be compiled.
    LoadError
        The load changes over time, or does not fit the robot.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> problem = named_problem("arc", frames=5)
    >>> steerer = ctr.Steerer(problem.robot, [0, 0, 0, 20, 40, 60, 0, 0], dt=0.1, wait=False)
    >>> q = steerer.step(problem.target_frames[2].points)
    >>> q.shape, steerer.is_solved
    ((8,), True)
    """

    def __init__(
        self,
        robot: Robot,
        q: npt.ArrayLike,
        dt: float,
        settings: Settings = DEFAULT_PLANNER_SETTINGS,
        model: str | Model = DEFAULT_MODEL,
        lumen: Curve | None = None,
        walls: Sequence[Body] = (),
        wait: bool = True,
    ) -> None:
        check_instance(RobotError, "robot", robot, Robot)
        check_instance(OptionError, "settings", settings, Settings)
        number(OptionError, "dt", dt, lambda x: 0 < x < math.inf, "be a finite number > 0", " s")
        described = model_named(model)
        described.check(robot)
        require_constant_load(described.applied_load, "a Steerer")
        q = robot.check(q)
        self._wall = make_wall(robot, _geometry(lumen, walls), described, settings)
        stage, arrival = _stage(robot, settings, described, self._wall)
        reach = reach_of(robot, dt, described.several_equilibria)
        # Parameters that never change are filled once, with any target; the real one is written in place by every
        # step.
        straight = growing(curve_from_formula(lambda u: (0.0, 0.0, u), 0.0, 1.0), 1).sample()[0]
        # The program squares residuals: root^2 |W (q - q_before)|^2 = lambda |W (q - q_before)|^2 / dt^2, eq. (9).
        root = math.sqrt(settings.motion_weight) / dt
        # Every feasible step that is found is taken (a KKT residual of up to infinity): a late optimum is worth
        # less than a timely step. `solved` says whether it was one.
        self._run = run = FrameSequence(
            Program(stage.nlp, wait, MAX_STEERING_ITERATIONS), 1, math.inf, extrapolate=True
        )
        values = {**stage.fill(straight, q), "motion_root": root}
        if self._wall is not None:
            run.set_local_parameters(_compile_wall_parameters(self._wall))
            values |= {"contact_weight": self._wall.weight, "contact_allowed": self._wall.contact_threshold}
        run.p[0] = stage.nlp.pack(values)
        run.low[:], run.high[:], run.most[:] = reach
        self._size = len(q)
        self._robot = robot
        self._model = described
        self.set_configuration(q)
        self._target = run.p[0, stage.nlp.parameter_slice("target")].reshape(3, -1)
        # `_none` stays 0: its scalar product with a target is 0 unless that has a NaN or an infinity.
        self._whole, self._none = np.zeros((2, len(SIGMA_GRID), 3))
        # A view: writing the whole target also writes the samples that the program takes.
        self._sampled = self._whole[::TARGET_SAMPLE_STRIDE].T
        self._arrival = arrival
        self._part = 0.0
        if arrival is not None:
            self._arrives = {
                name: stage.nlp.parameter_slice(name) for name in arrival.values(self._whole[-1:], 0.0)
            }
        self._done, run.objective[:], run.kkt[:] = False, math.nan, math.nan

    @classmethod
    def create_if_compiled(
        cls,
        robot: Robot,
        q: npt.ArrayLike,
        dt: float,
        settings: Settings = DEFAULT_PLANNER_SETTINGS,
        model: str | Model = DEFAULT_MODEL,
        lumen: Curve | None = None,
        walls: Sequence[Body] = (),
    ) -> Steerer | None:
        """Return a steerer once everything is compiled, and None before.

        The first call starts to compile in the background; call it again until it returns a steerer.

        Parameters
        ----------
        robot : Robot
            The robot to steer.
        q : array_like
            Configuration (2d + 2,) in which the robot stands, rad and mm.
        dt : float
            Time from one step to the next, s.
        settings : Settings, optional
            Weights of motion, contact and arrival.
        model : str or Model, optional
            Kinematic model.
        lumen : Curve, optional
            Path with a radius, within whose wall the robot is kept.
        walls : sequence of Body
            Other walls.

        Returns
        -------
        Steerer or None
            None while programs are compiled.

        Raises
        ------
        OptionError, RobotError, LoadError
            As :class:`Steerer` itself.
        """
        described = model_named(model)
        wall = make_wall(robot, _geometry(lumen, walls), described, settings)
        stage, _ = _stage(robot, settings, described, wall)
        # Each of these starts a compilation and says whether it is done: all are started, before any is waited
        # for.
        begun = [described.fast(robot.structure), library(stage.nlp, 1).path_if_ready() is not None]
        if wall is not None and wall.compiled_wall is not None:
            begun.append(wall.compiled_wall.ready())
        return cls(robot, q, dt, settings, model, lumen, walls) if all(begun) else None

    def set_configuration(self, q: npt.ArrayLike, x: Array | None = None) -> None:
        """Set the configuration in which the robot stands, wherever it was before.

        Parameters
        ----------
        q : array_like
            Configuration (2d + 2,), rad and mm.
        x : ndarray, optional
            Unknowns (n_x,) of the model's equilibrium there. By default the equilibrium to which the robot is
            turned from where all its tubes are aligned.

        Raises
        ------
        RobotError
            q violates the robot's limits.
        """
        q = self._robot.check(q)
        x = self._model.rest(self._robot, q) if x is None else x
        # On the elastic model the tips' angles follow after q: they say in which of several equilibria the robot
        # is.
        self._run.set_start(np.append(q, x[: len(self._run.here) - len(q)]), x)

    def set_shape_weights(self, distance: ShapeDistance) -> None:
        """Set the weights of distances along the robot for the next steps.

        Parameters
        ----------
        distance : ShapeDistance
            Term of the shape error, with weights along the robot and the default stride.

        Raises
        ------
        OptionError
            Its stride is another than the default, which the program was built for.

        Examples
        --------
        >>> import numpy as np
        >>> import ctr_nlp as ctr
        >>> from ctr_nlp.ocp.terms import ShapeDistance
        >>> steerer = ctr.Steerer(ctr.table_i_robot(), [0, 0, 0, 20, 40, 60, 0, 0], dt=0.1, wait=False)
        >>> steerer.set_shape_weights(ShapeDistance(np.linspace(0, 2, 101)))
        """
        if distance.stride != TARGET_SAMPLE_STRIDE:
            raise OptionError(
                f"stride of a Steerer's distance is {distance.stride}; it must be {TARGET_SAMPLE_STRIDE}"
            )
        self._run.p[0, self._run.program.nlp.parameter_slice("shape_roots")] = distance.roots

    @property
    def q(self) -> Array:
        """Configuration (2d + 2,) in which the robot stands, rad and mm; a copy."""
        return self._run.here[: self._size].copy()

    @property
    def objective(self) -> float:
        """Objective of the last step, mm^2; NaN before the first."""
        return float(self._run.objective[0])

    @property
    def kkt(self) -> float:
        """KKT residual of the last step; NaN before the first."""
        return float(self._run.kkt[0])

    @property
    def iterations(self) -> int:
        """SQP iterations of the last step."""
        return int(self._run.iterations[0])

    @property
    def is_solved(self) -> bool:
        """Whether the last step ended at a KKT point."""
        return self._done and self.kkt <= KKT_TOLERANCE

    def step(self, target: Array, part: float = 0.0) -> Array:
        """Find the configuration dt s later.

        Parameters
        ----------
        target : ndarray
            Shape (101, 3) to follow, mm, at uniform sigma.
        part : float
            Part of the motion that has passed, from 0 to 1, where its end is known. In the last tenth of a motion
            the tip is pulled to the target's end, as in plans (ocp/terms/arrival.py), unless there is a load.
            0, the default, follows the shape alone.

        Returns
        -------
        ndarray
            Configuration q (2d + 2,), rad and mm; where no better one was found, that in which the robot stands.

        Raises
        ------
        OptionError
            The target has another shape or numbers that are not finite, or `part` is not in [0, 1].
        """
        if not 0.0 <= part <= 1.0:
            raise OptionError(f"part of a motion is {part!r}; it must be a number from 0 to 1")
        if np.shape(target) != self._whole.shape:
            raise OptionError(f"target has shape {np.shape(target)}; it must be {self._whole.shape}")
        self._whole[:] = target
        if np.vdot(self._whole, self._none) != 0.0:  # NaN, where a number is not finite: the quickest way to know
            bad = self._whole[~np.isfinite(self._whole)][0]
            raise OptionError(f"target has {bad} mm; all of it must be finite")
        self._target[:] = self._sampled
        if self._arrival is not None and (part or self._part):  # its weight is 0 until it was first set
            self._part = part
            for name, value in self._arrival.values(target[-1:], part).items():
                self._run.p[0, self._arrives[name]] = np.ravel(value)
        self._done = self._run(1) == 1
        return self.q


def _stage(robot: Robot, settings: Settings, model: Model, wall: Wall | None) -> tuple[Stage, ArrivalTerm | None]:
    """Return the one stage of the joint formulation, and its term of arrival where there is one."""
    terms = with_frame_arrival((), settings, model)
    (stage,) = joint(robot, settings, model, terms, walled=wall is not None)
    return stage, find_arrival(terms)


def _compile_wall_parameters(wall: Wall) -> LocalParameterSource:
    """Return the local parameters of a wall, compiled if needed; raise OptionError where that fails."""
    around = wall.compiled_wall
    if around is None:
        raise OptionError(f"a lumen is given, and nothing can be compiled: {cache.unavailable_reason()}")
    around.ready(wait=True)
    return around.local_parameter_source(WALL_SLACK_TOLERANCE_MM, MAX_WALL_RELINEARISATIONS)


def _geometry(lumen: Curve | None, walls: Sequence[Body]) -> WallGeometry | None:
    """Return the wall of a lumen and bodies, None for none; raise OptionError where they are something else."""
    if lumen is not None and (not isinstance(lumen, Curve) or lumen.radius is None):
        raise OptionError(f"lumen is {lumen!r:.80}; it must be a curve with a radius, or None for no wall")
    for body in walls:
        check_instance(OptionError, "a wall", body, Body)
    return nearest_of(None if lumen is None else Lumen.from_curve(lumen), tuple(walls))
