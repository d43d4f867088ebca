"""A plan: configurations over time with their shapes and targets, and its file plan.npz."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.exceptions import CtrError, LoadError, OutputError, RobotError
from ctr_nlp.models import Model, model_named, model_with_load
from ctr_nlp.models.loads import Load, LoadOverTime, with_modulus
from ctr_nlp.ocp.settings import THRESHOLDS, Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.monte_carlo import DEFAULT_PLAN_SAMPLE_SEED, DEFAULT_PLAN_SAMPLES, robustness
from ctr_nlp.plan.motion_evaluation import (
    clearances_between,
    describe_branch_failures,
    evaluate_motion,
    find_off_branch_frames,
    name_clearances,
    wall_clearances,
)
from ctr_nlp.plan.plan_data import (
    DIGEST,
    FORMAT,
    SAMPLE_ARRAY_NAMES,
    PlanData,
    check_arrays,
    check_meta,
    count_walls,
    digest,
    pack_walls,
    planned_model,
    read_plan_file,
    take_walls,
)
from ctr_nlp.plan.plan_transforms import join_plans, per_frame_arrays, resample_plan, reverse_plan, slice_plan
from ctr_nlp.plan.robustness import Robustness, robustness_from_arrays
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.plan.verdicts import Verdicts, verdicts
from ctr_nlp.robot import Robot
from ctr_nlp.support.atomic_write import write_atomically
from ctr_nlp.support.mistaken_files import PLAN, name_other_kind, suggest_file
from ctr_nlp.support.notebook_card import CardLine, notebook_card_html
from ctr_nlp.support.value_checks import check_choice, check_instance, checked_path, whole_number
from ctr_nlp.typing import Array, Flags

META_PROBLEM_ATTRIBUTES = "name", "frames", "duration", "deviation", "deviation_share", "space", "space_assumed"
"""Attributes of the problem that are saved in meta."""
PHYSICAL_MODEL = "elastic"
"""The model on which every plan is checked: it predicts how tubes twist each other."""
PLAN_PICTURE_FRAMES = 5
"""Frames in a notebook's picture."""


class Plan(PlanData):
    """A motion of T frames of a robot with d tubes, with its shapes, errors and margins.

    ``plan[first:stop]`` are some of its frames, counted from 0; ``plan + other`` is one plan after the other.
    Arrays are read-only; frames that were never reached hold NaN. They are saved under these names in plan.npz.

    Attributes
    ----------
    time : ndarray
        (T,), s.
    alpha, beta, theta : ndarray
        Rotations (T, d), rad, extensions (T, d), mm, and tilt of the base (T, 2), rad; together :attr:`q`.
    target, shape : ndarray
        Target and robot (T, 101, 3), mm, at uniform sigma.
    target_direction, tip_direction : ndarray
        Unit tangents (T, 3) at the ends of both.
    solve_time : ndarray
        Seconds (T,) that the frames took.
    success : ndarray of bool
        Frames (T,) that are solutions of their optimisation problem.
    objective, kkt : ndarray
        Objective (T,), mm^2, and KKT residual (T,).
    stability, stability_between : ndarray
        Stability margin (T,) at each frame, and the least one in the sub-steps to it; NaN where nothing can be
        unstable.
    to_robot : ndarray
        Rigid transform (4, 4) from the axes of the target's file to the robot's frame, mm.
    meta : dict
        How the plan was made: robot, problem, model, options, failures, snaps and versions.
    lumen_radius : ndarray or None
        Radius of the lumen (T, 101), mm, at the target's points.
    truth : ndarray or None
        Configurations (T, 2d + 2) that the target was made with.
    lumen : ndarray or None
        Points and radii (N, 4) of the whole lumen, mm.
    clearance, clearance_between : ndarray or None
        Clearance (T, 101), mm, negative in contact, in each frame, and the least one in the sub-steps to it.
    wall_clearance, wall_clearance_between : ndarray or None
        The same for each of W walls (T, W, 101), mm, where there are several: the lumen, if it is one, and
        :attr:`walls`.
    free : ndarray or None
        The motion (T, 2d + 2) that was found without the wall.
    wall_force, wall_force_along, wall_force_direction : ndarray or None
        Where the robot leans on a wall: the wall's force on each of K pieces of the robot (T, K), N, the middle of
        the piece (T, K), mm, and the force's direction (T, K, 3).
    place_force, place_force_between : ndarray or None
        Largest force at one place, 10 mm of the robot, in each frame (T,), N, and in the sub-steps to it.
    stability_without_wall : ndarray or None
        Stability margin (T,) of the same motion if the wall gave way; NaN from a snap on.
    drawn : Robustness or None
        Results on simulated robots within the tolerances.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> plan = ctr.solve_per_frame(named_problem("arc", frames=3), model="dominant")
    >>> plan.q.shape, plan[:2].shape.shape, len((plan + plan.reversed()).time)
    ((3, 8), (2, 101, 3), 6)
    """

    @cached_property
    def verdicts(self) -> Verdicts:
        """Whether the plan does what a motion is for, one verdict for each check; see :func:`verdicts`.

        Computed from the data of the plan: what was not evaluated is NOT CHECKED. :meth:`check` evaluates.
        """
        return verdicts(self)

    def check(self, samples: int = DEFAULT_PLAN_SAMPLES, seed: int = DEFAULT_PLAN_SAMPLE_SEED) -> Plan:
        """Evaluate the plan on the elastic model and on simulated robots within the tolerances.

        Parameters
        ----------
        samples : int
            How many robots are simulated; none with 0, and verdicts that need them are then not checked.
        seed : int
            Of these robots; the same seed gives the same robots.

        Returns
        -------
        Plan
            The same motion. Its shapes, margins and clearances are those of the elastic model where the model
            that it was on cannot predict snapping; its verdicts are all checked, unless the plan was interrupted
            or no frame was reached, where there is nothing to simulate. A plan whose robot leans on a wall stays
            as it is: simulated robots would pass through the wall.

        Raises
        ------
        RobotError
            `samples` or `seed` is out of range.
        OptionError, LoadError
            The model cannot simulate robots that differ from the nominal one, or its load does not fit them.

        Examples
        --------
        >>> import ctr_nlp as ctr
        >>> from ctr_nlp.problems import named_problem
        >>> problem = named_problem("arc", frames=5)
        >>> plan = ctr.solve_per_frame(problem, model="dominant").check(samples=5)
        >>> plan.evaluated_model_name, plan.verdicts.unchecked_names
        ('elastic', ('within the wall',))
        """
        samples = whole_number(RobotError, "samples", samples, 0)
        if self.leans_on_wall:
            # Simulated robots have no wall to lean on: they would pass through it.
            return self
        looked = self if self.can_snap else self.evaluate_on(PHYSICAL_MODEL)
        if samples == 0 or self.meta.get("interrupted", False) or not looked.reached_frames.any():
            return looked
        return looked.with_samples(samples, seed)

    def with_thresholds(self, **thresholds: float) -> Plan:
        """Apply other thresholds to the plan.

        Parameters
        ----------
        **thresholds : float
            ``arrival_tolerance``, ``error_allowed``, ``contact_allowed`` in mm, and ``share``; see
            :class:`Settings`.

        Returns
        -------
        Plan
            The same plan with these among its options.

        Raises
        ------
        OptionError
            A threshold is unknown or out of its range.
        """
        for name in thresholds:
            check_choice("a threshold", name, THRESHOLDS)
        Settings(**dict[str, Any](thresholds))
        return replace(self, meta=self.meta | {"options": self.options | thresholds})

    def evaluate_on(self, model: str) -> Plan:
        """Evaluate the same motion on another model.

        The motion is simulated on that model, without a load; shapes, tip directions, margins and clearances are
        replaced. Results on simulated robots are dropped.

        Parameters
        ----------
        model : str
            ``"elastic"`` or ``"dominant"``.

        Returns
        -------
        Plan
            The same configurations with the shapes of that model.

        Raises
        ------
        OptionError
            The model is unknown.

        Examples
        --------
        >>> import ctr_nlp as ctr
        >>> from ctr_nlp.problems import named_problem
        >>> plan = ctr.solve_per_frame(named_problem("arc", frames=3), model="dominant")
        >>> plan.evaluate_on("elastic").evaluated_model_name
        'elastic'
        """
        return self._evaluate_on_model(model_named(model), {"evaluated": model, "load": None})

    def with_load(self, load: Load | LoadOverTime) -> Plan:
        """Evaluate the same motion on the elastic model with the robot under a load.

        The load is applied while the robot stands in the first frame, and taken away in the last one.

        Parameters
        ----------
        load : Load or LoadOverTime
            Forces, moments and weight; N, N mm, N/mm.

        Returns
        -------
        Plan
            The same configurations with the shapes of the loaded robot.

        Raises
        ------
        LoadError
            The load does not fit the robot, or the robot has no moduli in MPa; see :meth:`with_modulus`.

        Examples
        --------
        >>> import ctr_nlp as ctr
        >>> from ctr_nlp.problems import named_problem
        >>> plan = ctr.solve_per_frame(named_problem("arc", frames=3), model="dominant").with_modulus(60_000)
        >>> loaded = plan.with_load(ctr.Load(force=(0.05, 0, 0)))  # doctest: +SKIP
        >>> loaded.evaluated_model_name  # doctest: +SKIP
        'elastic'
        """
        check_instance(LoadError, "load", load, Load, LoadOverTime)
        model = model_with_load(PHYSICAL_MODEL, load)
        return self._evaluate_on_model(model, {"evaluated": model.name, "load": load.to_dict()})

    def with_modulus(self, modulus: float) -> Plan:
        """Give the tubes of the plan's robot Young's moduli in MPa, where they have only ratios.

        Parameters
        ----------
        modulus : float
            Young's modulus of a tube whose ratio is 1, MPa; about 60,000 for nitinol. The others keep their ratio
            to it.

        Returns
        -------
        Plan
            The same plan; shapes and margins without a load stay the same.

        Raises
        ------
        LoadError
            The modulus is out of range, the tubes have other moduli in MPa already, or the plan is evaluated under
            a load.

        Examples
        --------
        >>> import ctr_nlp as ctr
        >>> from ctr_nlp.problems import named_problem
        >>> plan = ctr.solve_per_frame(named_problem("arc", frames=2), model="dominant")
        >>> plan.with_modulus(60_000).robot.tubes[0].youngs_modulus
        60000.0
        """
        if self.evaluated_load is not None:
            raise LoadError(
                f"the plan is evaluated under {self.evaluated_load}; give its robot a modulus before the load"
            )
        return replace(self, meta=self.meta | {"robot": with_modulus(self.robot, modulus).to_dict()})

    def _with_clearance_between(self) -> Plan:
        """Return the plan with its clearance between frames, which files of older versions do not have."""
        wall = self.wall
        if wall is None or self.clearance is None or self.clearance_between is not None:
            return self
        of_walls = wall_clearances(self.robot, wall, self.beta, self.shape)
        between = clearances_between(self.robot, self.q, self.evaluated_model, wall)
        return replace(self, **name_clearances(of_walls, between) | {"clearance": self.clearance})

    def _evaluate_on_model(self, model: Model, metadata: dict[str, Any]) -> Plan:
        """Return the plan with its motion simulated on `model`, and with `metadata` in its meta."""
        simulator = Simulator(self.robot, model)
        found = evaluate_motion(simulator, self.q, target=self.target, wall=self.wall, free=self.free)
        # Results on samples belong to the model before.
        return replace(self, **found.arrays, meta=self.meta | found.metadata | metadata, drawn=None)

    def robustness(self, samples: int = DEFAULT_PLAN_SAMPLES, seed: int = DEFAULT_PLAN_SAMPLE_SEED) -> Robustness:
        """Simulate the motion on robots within the tolerances, on the model that the plan is evaluated on.

        Parameters
        ----------
        samples : int
            Number of robots, at least 1.
        seed : int
            Their seed; the same seed gives the same robots.

        Returns
        -------
        Robustness
            Which robots snap or leave the branch, their errors, margins and clearances, and what each tolerance
            costs.

        Raises
        ------
        RobotError
            `samples` or `seed` is out of range.
        OptionError
            The model cannot follow robots that differ from the nominal one.

        Examples
        --------
        >>> import ctr_nlp as ctr
        >>> from ctr_nlp.problems import named_problem
        >>> plan = ctr.solve_per_frame(named_problem("arc", frames=3), model="dominant").evaluate_on("elastic")
        >>> found = plan.robustness(samples=5)
        >>> len(found), found.e2.shape
        (5, (5, 3))
        """
        return robustness(self, samples, seed)

    def with_samples(self, samples: int = DEFAULT_PLAN_SAMPLES, seed: int = DEFAULT_PLAN_SAMPLE_SEED) -> Plan:
        """Return the plan with results on simulated robots; see :meth:`robustness`.

        Parameters
        ----------
        samples : int
            Number of robots, at least 1.
        seed : int
            Their seed; the same seed gives the same robots.

        Returns
        -------
        Plan
            The same plan, with the results in ``plan.drawn``, which verdicts use and files contain.

        Raises
        ------
        RobotError
            `samples` or `seed` is out of range.
        OptionError
            The model cannot follow robots that differ from the nominal one.
        """
        return replace(self, drawn=self.robustness(samples, seed))

    __getitem__ = slice_plan
    reversed = reverse_plan
    joined = __add__ = join_plans
    resampled = resample_plan

    def __repr__(self) -> str:
        failed = int((~self.success).sum())
        error = e3(self)
        on = "" if self.evaluated_model_name == self.meta["model"] else f" on the {self.evaluated_model_name} one"
        on += "" if self.evaluated_load is None else f" under {self.evaluated_load}"
        return (
            f"Plan({self.meta['problem']['name']}: {len(self.time)} frames in {self.time[-1]:g} s, "
            f"{'all' if not failed else len(self.time) - failed} solved, {self.robot.d} tubes, "
            f"{self.meta['model']} model{on}{'' if error is None else f', e3 {error:.3g} mm'})"
        )

    def _repr_html_(self) -> str:
        frames = np.unique(np.linspace(0, len(self.time) - 1, PLAN_PICTURE_FRAMES).round().astype(int))
        lines = [CardLine(self.target[j], "#999999", 4.0) for j in frames]
        lines += [CardLine(self.shape[j], "#0072b2" if self.success[j] else "#d55e00") for j in frames]
        told = [(f"{each.matter}: {each.word}", each.value) for each in self.verdicts]
        return notebook_card_html(repr(self), lines, told)

    def save(self, path: str | Path) -> None:
        """Write the plan to a file, whole or not at all.

        Parameters
        ----------
        path : str or Path
            The file (plan.npz); it is read without pickle.

        Raises
        ------
        OutputError
            The file cannot be written, or meta cannot be written as JSON.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> import ctr_nlp as ctr
        >>> from ctr_nlp.problems import named_problem
        >>> plan = ctr.solve_per_frame(named_problem("arc", frames=2), model="dominant")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plan.save(Path(folder) / "plan.npz")
        ...     ctr.Plan.load(Path(folder) / "plan.npz") == plan
        True
        """
        present = (
            per_frame_arrays(self)
            | {"to_robot": self.to_robot}
            | ({} if self.lumen is None else {"lumen": self.lumen})
        )
        present |= {} if self.drawn is None else self.drawn.arrays()
        walls, wall_arrays = pack_walls(self.walls)
        present |= wall_arrays
        target = checked_path(OutputError, path)
        told = self._meta_as_json(walls)
        saved: dict[str, Any] = {DIGEST: np.array(digest(present, told)), "meta": np.array(told), **present}
        try:
            with write_atomically(target) as partial, open(partial, "wb") as file:
                np.savez_compressed(file, **saved)
        except OSError as error:
            raise OutputError(f"plan cannot be written to {target}: {error}") from error

    def _meta_as_json(self, walls: dict[str, Any]) -> str:
        """Return meta as strict JSON, with the seed of simulated robots and the entry for walls; raise OutputError
        where that is impossible.
        """
        try:
            seed = {} if self.drawn is None else {"draws": {"seed": self.drawn.seed}}
            return json.dumps(self.meta | seed | walls, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise OutputError(f"meta of the plan cannot be written as JSON: {error}") from error

    @classmethod
    def load(cls, path: str | Path) -> Plan:
        """Read a plan from a file without pickle.

        Parameters
        ----------
        path : str or Path
            A file that :meth:`save` has written.

        Returns
        -------
        Plan
            The plan that was saved.

        Raises
        ------
        OutputError
            The file cannot be read, is not a plan, or was changed after it was saved. Changes are not detected in
            files of versions without a digest.
        """
        path = checked_path(OutputError, path)
        try:
            arrays, meta, changed = read_plan_file(path)
            check_meta(meta)
            walls = take_walls(meta, arrays)
            check_arrays(arrays, Robot.from_dict(meta["robot"]).d, count_walls("lumen" in arrays, walls))
            drawn = None
            if set(SAMPLE_ARRAY_NAMES) <= set(arrays):
                seed = whole_number(OutputError, "seed of meta's draws", meta.pop("draws", {}).get("seed"), 0)
                drawn = robustness_from_arrays({name: arrays.pop(name) for name in SAMPLE_ARRAY_NAMES}, seed)
            plan = cls(meta=meta, drawn=drawn, walls=walls, **arrays)._with_clearance_between()
        except OSError as error:
            raise OutputError(f"plan {path} cannot be read: {error.strerror}{suggest_file(path)}") from error
        except CtrError as error:
            other = name_other_kind(path, PLAN)
            raise OutputError(f"plan {path}: {other}" if other else f"{path} is not a plan: {error}") from error
        # Last, since a damaged file is changed as well, and other errors say more.
        if changed:
            raise OutputError(
                f"plan {path} was changed after it was saved; make a new plan, or change it in Python"
            )
        return plan


def plan_from_configurations(
    problem: Problem,
    q: Array,
    meta: dict[str, Any],
    *,
    success: Flags,
    solve_time: Array,
    objective: Array,
    kkt: Array,
    planned: Array | None = None,
    free: Array | None = None,
    simulator: Simulator | None = None,
) -> Plan:
    """Build a plan by simulating a problem's robot through configurations.

    Parameters
    ----------
    problem : Problem
        Robot and target.
    q : ndarray
        Configurations (T, 2d + 2), rad and mm; NaN in frames that were not reached.
    meta : dict
        How q was found, with the model and ``failures``.
    success : ndarray of bool
        Frames (T,) that were solved.
    solve_time : ndarray
        Seconds (T,).
    objective : ndarray
        Objective (T,), mm^2.
    kkt : ndarray
        KKT residual (T,).
    planned : ndarray, optional
        Unknowns (T, n) that were planned, where q does not determine them. Frames in which the robot, moved
        through q, comes to another equilibrium are marked as not solved.
    free : ndarray, optional
        The motion (T, 2d + 2) that was found without the wall.
    simulator : Simulator, optional
        Simulator of the problem's robot, which may have q in its cache.

    Returns
    -------
    Plan
        The plan, with the shapes of the simulated robot.
    """
    robot = problem.robot
    frames = problem.target_frames
    target = np.array([frame.points for frame in frames])
    radii = [frame.radius for frame in frames]
    simulator = simulator or Simulator(robot, planned_model(meta))
    # Shapes are simulated and not taken from the solver: its stationary point may be an equilibrium that the
    # motion does not reach.
    found = evaluate_motion(simulator, q, target=target, wall=problem.wall, free=free)
    if planned is not None:
        snaps = found.simulation.snaps
        # On the elastic model q does not determine the equilibrium. Where the motion reaches another one than was
        # planned, the frame is not a solution, however small its residual.
        away = success & find_off_branch_frames(found.simulation.x, planned, snaps, robot.d)
        success = success & ~away
        meta = meta | {"failures": meta["failures"] | describe_branch_failures(away, snaps)}
    alpha, beta, theta = robot.split(q)
    return Plan(
        time=np.arange(1.0, problem.frames + 1) * problem.dt,
        alpha=alpha,
        beta=beta,
        theta=theta,
        target=target,
        target_direction=np.array([frame.tangents[-1] for frame in frames]),
        solve_time=solve_time,
        success=success,
        objective=objective,
        kkt=kkt,
        to_robot=np.eye(4) if problem.to_robot is None else problem.to_robot,
        meta=meta
        | found.metadata
        | {
            "problem": {key: getattr(problem, key) for key in META_PROBLEM_ATTRIBUTES},
            "robot": robot.to_dict(),
            "versions": dict(versions()),
            "format": FORMAT,
        },
        lumen_radius=None if any(radius is None for radius in radii) else np.array(radii),
        truth=problem.truth,
        lumen=None if problem.sampled_lumen is None else problem.sampled_lumen.table,
        free=free,
        walls=problem.walls,
        **found.arrays,
    )


@cache
def versions() -> dict[str, str]:
    """Return the versions of this package and of what it computes with."""
    return {
        "ctr_nlp": importlib.metadata.version("ctr_nlp"),
        "casadi": ca.CasadiMeta.version(),
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
