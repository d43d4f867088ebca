"""Airways one after another: plans without and with clearance, and the least contact that there could be."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.anatomy import synthetic_airway
from ctr_nlp.anatomy.problem_files import problem_from_file
from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.frames import starts
from ctr_nlp.formulations.joint import joint
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.wall import ROUNDS, SETTLED, Wall
from ctr_nlp.models import MODELS
from ctr_nlp.plan.measures import depth
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import table_i_robot
from ctr_nlp.simulation.forward import shapes
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.steer import solve_horizon
from ctr_nlp.support.pool import side_by_side
from ctr_nlp.target.placing import placed
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import SIGMA, Frame, growing
from ctr_nlp.typing import Array

WEIGHT = 1e3
"""mm^2 a mm of contact: so much that the shape hardly counts beside it."""
STARTS = 40
"""Sobol points that a frame is solved from."""
CLEAR = 1e-3
"""Contact of less, mm, is none."""


class Alone:
    """Frames of a problem in which the robot is out to its target's full length and contact is all that counts.

    Frames count from 0. Neither speed limits nor neighbours bind them.
    """

    def __init__(self, problem: Problem) -> None:
        """Build; the problem's lumen must be known. Raises OptionError where nothing can be compiled."""
        assert problem.sampled_lumen is not None
        robot = problem.robot
        self.problem, self._wall = (
            problem,
            Wall(robot, problem.sampled_lumen, MODELS["dominant"], WEIGHT, 0.0),
        )
        (self._stage,) = joint(robot, Settings(), MODELS["dominant"], walled=True)
        self._nlp = self._stage.nlp
        self._program = Program(self._nlp, wait=True)

    def least(self, motions: Sequence[Array], frames: Iterable[int]) -> Array:
        """The least contact found in each of some frames, mm; 0 where it is below CLEAR.

        From what each of motions (T, 2d + 2) has there, from the answer of the frame asked for before, and from
        Sobol points, until one is clear.
        """
        found, best = list[float](), list[Array]()
        for frame in frames:
            sample = self.problem.samples[frame]
            sobol = starts(self.problem.robot, sample, STARTS)
            depth, q = self._least(sample, [*(motion[frame] for motion in motions), *best, *sobol])
            found.append(depth)
            best = [q]
        return np.array(found)

    def _least(self, frame: Frame, guesses: Iterable[Array]) -> tuple[float, Array]:
        """Depth of contact in mm and the configuration that has it."""
        depth, best = np.inf, np.zeros(0)
        for guess in guesses:
            for q in self._around(frame, guess):
                tried = self._depth(q)
                if tried < CLEAR:
                    return 0.0, q
                if tried < depth:
                    depth, best = tried, q
        return depth, best

    def _around(self, frame: Frame, q: Array) -> Iterator[Array]:
        """What comes of a guess, solved again around itself until that needs no more slack."""
        at, n = self._program, len(q)
        fixed = self._stage.fill(frame, q)
        at.lower[:n], at.upper[:n] = self._out(frame.length)
        for _ in range(ROUNDS):
            q = np.clip(q, at.lower[:n], at.upper[:n])
            wall, slack = self._wall.surroundings(q[None])
            at.p[:] = self._nlp.pack({**fixed, **{name: value[0] for name, value in wall.items()}})
            at.x[:], at.multipliers[:] = np.append(q, slack), 0.0
            at.run()
            q = np.clip(at.x[:n], at.lower[:n], at.upper[:n])
            yield q
            if self._wall.surroundings(q[None])[1][0] <= at.x[n] + SETTLED:
                break

    def _out(self, length: float) -> tuple[Array, Array]:
        """Limits of q of the robot that is out to a length in mm, or as far as it reaches."""
        robot = self.problem.robot
        bounds = robot.lower.copy(), robot.upper.copy()
        for bound in bounds:
            robot.split(bound)[1][-1] = min(length, robot.reach)
        return bounds

    def _depth(self, q: Array) -> float:
        """By how much the robot at q is beyond the wall at most, mm, at the samples that plans are measured at."""
        robot = self.problem.robot
        left = self._wall.lumen.clearance(robot, robot.split(q[None])[1], SIGMA, shapes(robot, q[None]))
        return max(0.0, -float(left.min()))


Source = Path | int
"""A centreline file with radii, or the seed of a synthetic airway."""
FOLLOWED_MM = 150.0
"""mm of a synthetic airway that are followed, its last."""
WITHOUT, WITH, FIRST = Settings(contact_weight=0.0), Settings(), Settings(clearance_cost=math.inf)
"""No wall; the default; clearance whatever it costs."""


@dataclass(frozen=True)
class Case:
    """An airway: plans without clearance, with it, with clearance first; and clearance alone.

    length: of the target, mm. solved: every frame of all three plans was. weight: what a mm of contact costs with
    clearance, mm^2. e3_*: mm. contact_*: depth beyond the wall summed over frames, mm. frames_*: in contact.
    short_*: by how much the robot is shorter than its target at most, mm. alone: what is left of contact_with
    where contact is all that counts and the robot is out to the target's full length, mm; alone_clear: in how
    many of frames_with that is none.
    """

    name: str
    synthetic: bool
    frames: int
    length: float
    solved: bool
    weight: float
    e3_without: float
    e3_with: float
    e3_first: float
    contact_without: float
    contact_with: float
    contact_first: float
    frames_without: int
    frames_with: int
    frames_first: int
    short_without: float
    short_with: float
    short_first: float
    alone: float
    alone_clear: int

    @property
    def growth(self) -> float:
        """Of e3 with clearance, in %."""
        return 100 * (self.e3_with / self.e3_without - 1)

    @property
    def growth_first(self) -> float:
        """Of e3 with clearance first, in %."""
        return 100 * (self.e3_first / self.e3_without - 1)

    @property
    def clearable(self) -> bool:
        """Whether clearance alone leaves no contact in any frame."""
        return self.alone_clear == self.frames_with


def study(
    sources: Sequence[Source],
    frames: int = 100,
    jobs: int = 1,
    progress: Callable[[int, str], None] | None = None,
) -> list[Case]:
    """A case for every source, in their order; progress: (number done, name of the last).

    jobs: in how many processes. Ctrl-C leaves the cases that were done. Raises CtrError for files that are no
    problem, before any is solved.
    """
    for source in sources:
        if not isinstance(source, int) and problem_of(source, frames).lumen is None:
            raise OptionError(f"{source} has no radii, so no wall is known; give a file with radius_mm")
    found: dict[int, Case] = {}
    for number, case in side_by_side(partial(measured, frames=frames), sources, jobs):
        if case is not None:
            found[number] = case
            if progress is not None:
                progress(len(found), case.name)
    return [found[number] for number in sorted(found)]


def problem_of(source: Source, frames: int = 100) -> Problem:
    """The paper's robot advancing into an airway: a file's, trimmed at its end, or the last of a synthetic one."""
    if not isinstance(source, int):
        return problem_from_file(source, frames=frames, trim="end")
    airway = synthetic_airway(seed=source)
    path, to_robot = placed(airway.part(airway.length - FOLLOWED_MM, airway.length))
    lumen = airway.moved(to_robot)
    return Problem(f"synthetic {source}", table_i_robot(), growing(path, frames), to_robot=to_robot, lumen=lumen)


def measured(source: Source, frames: int = 100) -> Case | None:
    """The case of a source; None where Ctrl-C ended it."""
    problem = problem_of(source, frames)
    plans = plans_of(problem)
    if any(plan.meta["interrupted"] for plan in plans):
        return None
    touching = np.flatnonzero(depth(plans[1]) > 0)
    left = Alone(problem).least([plans[2].q, plans[1].q], touching) if len(touching) else np.zeros(0)
    numbers: dict[str, Any] = {}
    for name, plan in zip(("without", "with", "first"), plans, strict=True):
        numbers |= {f"{key}_{name}": value for key, value in _numbers(plan, problem).items()}
    return Case(
        name=problem.name,
        synthetic=isinstance(source, int),
        frames=frames,
        length=max(problem.target.lengths),
        solved=all(plan.complete for plan in plans),
        weight=plans[1].meta["contact_weight"],
        alone=float(left.sum()),
        alone_clear=int((left == 0).sum()),
        **numbers,
    )


def _numbers(plan: Plan, problem: Problem) -> dict[str, Any]:
    """What a case says of each plan."""
    deep, out = depth(plan), np.minimum(problem.target.lengths, problem.robot.reach)
    return {
        "e3": summary(plan)["e3"],
        "contact": float(deep.sum()),
        "frames": int((deep > 0).sum()),
        "short": max(0.0, float((out - plan.beta[:, -1]).max())),
    }


def plans_of(problem: Problem) -> tuple[Plan, Plan, Plan]:
    """Plans without clearance, with it, and with clearance first."""
    without, kept = (solve_horizon(problem, settings=settings) for settings in (WITHOUT, WITH))
    whole = kept.meta["contact_weight"] == WITH.contact_weight
    # Where clearance was affordable whole, that is what comes first too.
    return without, kept, kept if whole else solve_horizon(problem, settings=FIRST)
