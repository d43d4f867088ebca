"""Critical tip forces of a plan: in every frame and direction, the force that snaps the robot or moves it out.

Forces are dead loads in the axes of the base, added to the load that the plan is evaluated under. A force is
critical where the branch of equilibria ends (a fold) or becomes unstable on the way up from zero, or where the
body leaves its lumen.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import LoadError, OptionError
from ctr_nlp.loads.tip_force_limits import (
    StateCondition,
    compliance,
    find_tip_force_limits,
    instability_condition,
    loaded_shapes,
)
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.models.loaded.rod_loads import RodKind
from ctr_nlp.models.loaded.tips import tip_angles
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.models.loads.load import MAX_LOAD_FORCE_N
from ctr_nlp.ocp.compiled_wall import WallDistance
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.value_checks import check_instance, number, whole_number
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags, Index

FORCE_DIRECTION_COUNTS = 6, 14, 26
"""Numbers of directions: along the axes; also towards corners of a cube; also towards the middles of its edges."""
DEFAULT_MAX_TIP_FORCE_N = 5.0
"""Default largest force that is tested, N."""
TIP_FORCE_CLEARANCE_SIGMA = np.linspace(0.0, 1.0, 34)
"""Sample points along the robot, as parts of its length, at which the clearance from the wall is computed."""


class WorstForce(NamedTuple):
    """The least of several forces.

    Attributes
    ----------
    force : float
        Its size, N; infinity where all are larger than what was tested.
    frame : int
        The frame, from 1.
    direction : (3,) array
        Its direction in the base frame.
    """

    force: float
    frame: int
    direction: Array


@dataclass(frozen=True, eq=False)
class Forces(ReadOnlyValue):
    """Critical tip forces in F frames of a plan, in addition to the load that the plan is evaluated under.

    Attributes
    ----------
    frames : (F,) array of int
        The frames, from 1.
    directions : (n, 3) array
        Unit vectors in the base frame.
    snapping_forces : (F, n) array
        Forces under which the robot snaps, N; infinity where that is more than `max_force`.
    lumen_exit_forces : (F, n) array
        Forces under which the robot is further than `allowed_depth` beyond its lumen's wall, N; infinity where
        that is more than `max_force`, and everywhere where no wall counts.
    compliance : (F, 3, 3) array
        Displacements of the tip (rows) per small force (columns), mm/N.
    max_force : float
        Largest force that was tested, N.
    allowed_depth : float or None
        Depth beyond the wall from which on the robot has left its lumen, mm; None where no wall counts.
    """

    frames: Index
    directions: Array
    snapping_forces: Array
    lumen_exit_forces: Array
    compliance: Array
    max_force: float
    allowed_depth: float | None

    @property
    def critical_forces(self) -> Array:
        """Forces (F, n) in N at which the robot snaps or leaves its lumen, whichever is first."""
        return np.minimum(self.snapping_forces, self.lumen_exit_forces)

    @cached_property
    def least_snapping_force(self) -> WorstForce:
        """The least force that snaps the robot."""
        return self._least(self.snapping_forces)

    @cached_property
    def least_lumen_exit_force(self) -> WorstForce | None:
        """The least force under which the robot leaves its lumen; None where no wall counts."""
        return None if self.allowed_depth is None else self._least(self.lumen_exit_forces)

    def _least(self, forces: Array) -> WorstForce:
        """Return the least of forces (F, n), N, with its frame and direction."""
        frame, direction = np.unravel_index(forces.argmin(), forces.shape)
        return WorstForce(float(forces[frame, direction]), int(self.frames[frame]), self.directions[direction])

    @property
    def largest_compliance(self) -> Array:
        """Largest displacement of the tip per small force over all directions, (F,) mm/N."""
        # The spectral norm: the largest displacement of any force of 1 N.
        return np.asarray(np.linalg.norm(self.compliance, 2, axis=(1, 2)))

    def summary(self) -> dict[str, Any]:
        """Return all numbers by name, with their units in the names.

        Returns
        -------
        dict
            Fit for strict JSON; None stands for forces of more than ``most_N``.
        """
        told = {"snap": self.least_snapping_force} | (
            {} if self.least_lumen_exit_force is None else {"leave": self.least_lumen_exit_force}
        )
        worst = {
            f"least_to_{name}": {
                "force_N": _finite(each.force),
                "frame": each.frame,
                "direction": each.direction.tolist(),
            }
            for name, each in told.items()
        }
        return worst | {
            "most_N": self.max_force,
            "off_mm": self.allowed_depth,
            "frames": self.frames.tolist(),
            "directions": self.directions.tolist(),
            "snaps_N": [[_finite(force) for force in row] for row in self.snapping_forces.tolist()],
            "leaves_N": [[_finite(force) for force in row] for row in self.lumen_exit_forces.tolist()],
            "compliance_mm_per_N": self.compliance.tolist(),
        }

    def rows(self) -> list[dict[str, Any]]:
        """Return a table with one row a frame.

        Returns
        -------
        list of dict
            The least forces over all directions, N, empty where they are more than was tested; the direction x, y,
            z of the smaller one; and the largest compliance, mm/N.
        """
        found = []
        for k, frame in enumerate(self.frames.tolist()):
            x, y, z = self.directions[self.critical_forces[k].argmin()].round(4).tolist()
            least = {"snaps_N": self.snapping_forces[k].min(), "leaves_N": self.lumen_exit_forces[k].min()}
            told = {name: "" if math.isinf(force) else round(float(force), 5) for name, force in least.items()}
            soft = {"softest_mm_per_N": round(float(self.largest_compliance[k]), 4)}
            found.append({"frame": frame, **told, "x": x, "y": y, "z": z, **soft})
        return found


def forces(
    plan: Plan,
    *,
    every: int = 1,
    directions: int = 26,
    most: float = DEFAULT_MAX_TIP_FORCE_N,
    off: float | None = None,
) -> Forces:
    """Find the critical tip forces of a plan, on the elastic model.

    In every frame forces are raised along many directions of the base frame, in addition to the load that the plan
    is evaluated under, until the branch of equilibria ends or becomes unstable, as at Euler's buckling load.

    Parameters
    ----------
    plan : Plan
        The plan; its robot needs Young's moduli in MPa (:meth:`Plan.with_modulus`).
    every : int
        Stride of the frames that are tested, from the first on.
    directions : int
        Number of directions: 6 along the axes, 14 with the corners of a cube, or 26 with the middles of its edges.
    most : float
        Largest force that is tested, N.
    off : float, optional
        Depth beyond the lumen's wall from which on the robot has left its lumen, mm; by default only snaps count.

    Returns
    -------
    Forces
        Without frames in which the robot has no shape, or no equilibrium under the plan's own load.

    Raises
    ------
    LoadError
        A tube has no Young's modulus in MPa, or no frame is left.
    OptionError
        An option is out of its range, or `off` is given and the plan knows no lumen.

    Examples
    --------
    A straight rod has the compliance of a cantilever, L^3 / (3 E I), and buckles under Euler's load, which is
    pi^2 E I / (4 L^2) = 2.95 N:

    >>> import ctr_nlp as ctr
    >>> rod = ctr.Robot((ctr.Tube(200, 150, 0.0, 1.5, 1.0, youngs_modulus=60_000),))
    >>> line = ctr.curve_from_points([[0, 0, z] for z in range(0, 101, 5)])
    >>> problem = ctr.Problem("rod", rod, ctr.growing(line, 2))
    >>> found = ctr.forces(ctr.plan_through(problem, np.array([[0, 50, 0, 0], [0, 100, 0, 0]])), directions=6)
    >>> found.largest_compliance.round(1).tolist()
    [3.5, 27.9]
    >>> least = found.least_snapping_force
    >>> round(least.force, 1), least.frame, least.direction.tolist()
    (3.0, 2, [0.0, 0.0, -1.0])
    """
    check_instance(OptionError, "plan", plan, Plan)
    if directions not in FORCE_DIRECTION_COUNTS:
        raise OptionError(
            f"directions is {directions!r}; it must be one of {', '.join(map(str, FORCE_DIRECTION_COUNTS))}"
        )
    number(
        OptionError, "most", most, lambda x: 0 < x <= MAX_LOAD_FORCE_N, f"lie in (0, {MAX_LOAD_FORCE_N:g}]", " N"
    )
    if off is not None:
        number(OptionError, "off", off, lambda x: 0 <= x < math.inf, "be a finite number >= 0", " mm")
    load = plan.evaluated_load or Load()
    way = cube_directions(directions)
    load.check(plan.robot)
    equilibria = LoadedEquilibria(plan.robot.structure, RodKind.of(load))
    which, states = _loaded_states(plan, load, equilibria, whole_number(OptionError, "every", every))
    if not len(which):
        raise LoadError("under its load, the robot has no equilibrium in any frame of the plan; reduce the load")
    asked = [] if off is None else [_left_lumen_criterion(plan, off, equilibria.rods.kind)]
    snaps, found = find_tip_force_limits(
        equilibria, states, way, most, asked + [instability_condition(equilibria)] * load.conservative
    )
    # A branch may continue beyond the point where it becomes unstable, as a straight rod does beyond Euler's load:
    # it is followed, but no robot stays on it. A load without an energy has no such criterion (flutter is
    # possible), and only the ends of branches count.
    if load.conservative:
        snaps = np.minimum(snaps, found.pop())
    leaves = found[0] if found else np.full(snaps.shape, np.inf)
    soft = compliance(plan.robot, equilibria, states)
    return Forces(which + 1, way, snaps, leaves, soft, float(most), off)


def cube_directions(count: int) -> Array:
    """Return evenly spread directions: from a cube's centre to its faces, then its vertices, then its edges.

    Parameters
    ----------
    count : int
        Number n of directions: 6, 14 or 26.

    Returns
    -------
    (n, 3) array
        Unit vectors.
    """
    steps = np.array([step for step in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(step)])
    parts = abs(steps).sum(axis=1)
    # 1, 2 or 3 entries other than 0: towards a face, an edge or a corner. 6, 14 and 26 are the first of one list.
    order = np.concatenate([np.flatnonzero(parts == size) for size in (1, 3, 2)])
    found = steps[order[:count]]
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _loaded_states(
    plan: Plan, load: Load | LoadOverTime, equilibria: LoadedEquilibria, every: int
) -> tuple[Index, States]:
    """Return the frames (F,), from 0, in which a plan's robot has an equilibrium under its load, and the states.

    load: of the plan. equilibria: solver of the loaded robot. every: stride of the frames that are tested.
    """
    # The branch is that of the motion without a load; in each frame the load of its time then grows from zero.
    x = KINEMATIC_MODELS[Loaded.name].follow(plan.robot, plan.q).x
    d = plan.robot.d
    which = np.flatnonzero(np.isfinite(x).all(axis=1))
    which = which[which % every == 0]
    of_robot = np.repeat(plan.robot.numbers[None], len(which), axis=0)
    states = equilibria.solve_unloaded(of_robot, plan.q[which], tip_angles(x[which], d))
    # A load over time is evaluated for all frames and then indexed, so that each frame has the load of its time.
    acting = load.numbers_at(d, np.linspace(0.0, 1.0, len(x)))
    loaded, done = equilibria.follow_branches(states, states.q, acting[which])
    return which[done == 1], loaded.rows(done == 1)


def _left_lumen_criterion(plan: Plan, off: float, kind: RodKind) -> StateCondition:
    """Return the condition that a robot is further than `off`, mm, beyond the wall of the plan's lumen."""
    if plan.wall is None:
        raise OptionError("off needs a wall, and the plan has none; leave off out")
    beside = WallDistance(plan.wall)
    robot = plan.robot

    def left(states: States) -> Flags:
        # Clearance is negative beyond the wall.
        shape = loaded_shapes(robot, states, TIP_FORCE_CLEARANCE_SIGMA, kind)
        return np.asarray(
            beside.clearances(robot, robot.split(states.q)[1], shape, TIP_FORCE_CLEARANCE_SIGMA).min(axis=1) < -off
        )

    return left


def _finite(force: float) -> float | None:
    """Return a force, or None for an infinite one, which strict JSON does not have."""
    return None if math.isinf(force) else force
