"""The tip forces that a plan bears: in every frame and many directions, before it snaps or leaves its lumen."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import LoadError, OptionError
from ctr_nlp.formulations.around import Beside
from ctr_nlp.loads import Load, LoadOverTime
from ctr_nlp.loads.load import FORCE
from ctr_nlp.models import MODELS
from ctr_nlp.models.loaded.acting import RodKind
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.models.loaded.tips import tip_angles
from ctr_nlp.plan.plan import Plan
from ctr_nlp.simulation.bearing import Question, borne, compliance, shapes, unstable
from ctr_nlp.support.equal import Kept
from ctr_nlp.support.values import instance, number, whole_number
from ctr_nlp.target.lumen import Lumen
from ctr_nlp.typing import Array, Flags, Index

COUNTS = 6, 14, 26
"""Numbers of directions: along the axes; also towards corners of a cube; also towards the middles of its edges."""
MOST = 5.0
"""N up to which forces are raised."""
SIGMA = np.linspace(0.0, 1.0, 34)
"""Places along the robot whose clearance is looked at."""


class Worst(NamedTuple):
    """The least of some forces: N, infinity where all are more than was looked for; frame, from 1; direction."""

    force: float
    frame: int
    direction: Array


@dataclass(frozen=True, eq=False)
class Forces(Kept):
    """What F frames of a plan bear at the tip, beside what the plan's robot bears already.

    frames (F,): from 1. directions (n, 3), of length 1, in the base frame. snaps (F, n): the force in N under
    which the robot snaps; leaves (F, n): under which it is further beyond its lumen's wall than off, mm; both
    infinity where that is more than most, N, and leaves also where no wall counts. compliance (F, 3, 3): mm/N, by
    how much the tip gives in (rows) to small forces (columns).
    """

    frames: Index
    directions: Array
    snaps: Array
    leaves: Array
    compliance: Array
    most: float
    off: float | None

    @property
    def bears(self) -> Array:
        """What every frame bears in every direction, (F, n) N."""
        return np.minimum(self.snaps, self.leaves)

    @cached_property
    def snap(self) -> Worst:
        """The least force that snaps the plan."""
        return self._least(self.snaps)

    @cached_property
    def leave(self) -> Worst | None:
        """The least force under which it leaves its lumen; None where no wall counts."""
        return None if self.off is None else self._least(self.leaves)

    def _least(self, forces: Array) -> Worst:
        frame, direction = np.unravel_index(forces.argmin(), forces.shape)
        return Worst(float(forces[frame, direction]), int(self.frames[frame]), self.directions[direction])

    @property
    def softest(self) -> Array:
        """By how much the tip gives in to a small force in the worst direction, (F,) mm/N."""
        return np.asarray(np.linalg.norm(self.compliance, 2, axis=(1, 2)))

    def summary(self) -> dict[str, Any]:
        """Numbers for strict JSON; None where a force is more than most_N."""
        told = {"snap": self.snap} | ({} if self.leave is None else {"leave": self.leave})
        worst = {
            f"least_to_{name}": {
                "force_N": _finite(each.force),
                "frame": each.frame,
                "direction": each.direction.tolist(),
            }
            for name, each in told.items()
        }
        return worst | {
            "most_N": self.most,
            "off_mm": self.off,
            "frames": self.frames.tolist(),
            "directions": self.directions.tolist(),
            "snaps_N": [[_finite(force) for force in row] for row in self.snaps.tolist()],
            "leaves_N": [[_finite(force) for force in row] for row in self.leaves.tolist()],
            "compliance_mm_per_N": self.compliance.tolist(),
        }

    def rows(self) -> list[dict[str, Any]]:
        """A row a frame: the least forces over all directions, the direction of the least, and compliance."""
        found = []
        for k, frame in enumerate(self.frames.tolist()):
            x, y, z = self.directions[self.bears[k].argmin()].round(4).tolist()
            least = {"snaps_N": self.snaps[k].min(), "leaves_N": self.leaves[k].min()}
            told = {name: "" if math.isinf(force) else round(float(force), 5) for name, force in least.items()}
            soft = {"softest_mm_per_N": round(float(self.softest[k]), 4)}
            found.append({"frame": frame, **told, "x": x, "y": y, "z": z, **soft})
        return found


def forces(
    plan: Plan, *, every: int = 1, directions: int = 26, most: float = MOST, off: float | None = None
) -> Forces:
    """The tip forces that a plan bears on the elastic model, raised in many directions of the base frame.

    every: which of the frames, from the first; directions: 6, 14 or 26; most: N up to which forces are raised;
    off: mm beyond its lumen's wall from which on a robot has left it, None where only snaps count. Forces act
    beside the load that the plan is evaluated under. Frames in which the robot has no shape are left out. Raises
    LoadError, and OptionError where off is asked for and no lumen is known.
    """
    instance(OptionError, "plan", plan, Plan)
    if directions not in COUNTS:
        raise OptionError(f"directions is {directions!r}; it must be one of {', '.join(map(str, COUNTS))}")
    number(OptionError, "most", most, lambda x: 0 < x <= FORCE, f"lie in (0, {FORCE:g}]", " N")
    if off is not None:
        number(OptionError, "off", off, lambda x: 0 <= x < math.inf, "be a finite number >= 0", " mm")
    load, way = plan.bears or Load(), directions_of(directions)
    load.check(plan.robot)
    equilibria = LoadedEquilibria(plan.robot.structure, RodKind.of(load))
    which, states = _standing(plan, load, equilibria, whole_number(OptionError, "every", every))
    if not len(which):
        raise LoadError("the plan has no frame in which its robot stands under its load; no more can be borne")
    asked = [] if off is None else [_left(plan, off, equilibria.rods.kind)]
    snaps, found = borne(equilibria, states, way, most, asked + [unstable(equilibria)] * load.conservative)
    if load.conservative:
        snaps = np.minimum(snaps, found.pop())
    leaves = found[0] if found else np.full(snaps.shape, np.inf)
    soft = compliance(plan.robot, equilibria, states)
    return Forces(which + 1, way, snaps, leaves, soft, float(most), off)


def directions_of(count: int) -> Array:
    """So many of the directions from a cube's middle to its faces, then its corners, then its edges, (n, 3)."""
    steps = np.array([step for step in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(step)])
    parts = abs(steps).sum(axis=1)
    order = np.concatenate([np.flatnonzero(parts == size) for size in (1, 3, 2)])
    found = steps[order[:count]]
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _standing(
    plan: Plan, load: Load | LoadOverTime, equilibria: LoadedEquilibria, every: int
) -> tuple[Index, States]:
    """Which frames, from 0, the robot stands in under its load, and its states there."""
    x, d = MODELS[Loaded.name].follow(plan.robot, plan.q).x, plan.robot.d
    which = np.flatnonzero(np.isfinite(x).all(axis=1))
    which = which[which % every == 0]
    of_robot = np.repeat(plan.robot.numbers[None], len(which), axis=0)
    states = equilibria.unloaded(of_robot, plan.q[which], tip_angles(x[which], d))
    acting = load.over(d, np.linspace(0.0, 1.0, len(x)))
    loaded, done = equilibria.along(states, states.q, acting[which])
    return which[done == 1], loaded.rows(done == 1)


def _left(plan: Plan, off: float, kind: RodKind) -> Question:
    """Whether states (T,) are further beyond the wall of a plan's lumen than off, mm."""
    if plan.lumen is None:
        raise OptionError("off is asked for, and the plan knows no wall of a lumen")
    beside, robot = Beside(Lumen(plan.lumen)), plan.robot

    def left(states: States) -> Flags:
        shape = shapes(robot, states, SIGMA, kind)
        return np.asarray(beside.clearances(robot, robot.split(states.q)[1], shape, SIGMA).min(axis=1) < -off)

    return left


def _finite(force: float) -> float | None:
    return None if math.isinf(force) else force
