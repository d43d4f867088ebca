"""Many frames in one call, where all of q is decided by one program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctr_nlp.formulations import Stage
from ctr_nlp.formulations.frame import packed
from ctr_nlp.formulations.frames import FrameResult
from ctr_nlp.formulations.joint import tip_steps
from ctr_nlp.robot import Robot
from ctr_nlp.solvers import NlpSolver, Solution
from ctr_nlp.solvers.frame.adapter import Reach, Surroundings
from ctr_nlp.typing import Array


def reach_of(robot: Robot, dt: float, several_equilibria: bool) -> Reach:
    """Limits of q and, where q does not determine the unknowns, of the tips' angles, and how they may change."""
    free = np.full(robot.d * several_equilibria, np.inf)
    own, more = (robot.lower, robot.upper, robot.speed * dt), (-free, free, tip_steps(robot, dt)[: len(free)])
    return Reach(*(np.append(*pair) for pair in zip(own, more, strict=True)))


@dataclass(frozen=True)
class AtOnce:
    """One program for all frames: p (T, n_p) are its parameters, within a reach.

    tips: how many of the unknowns are tips' angles, which only so change from frame to frame; 0 where q is all.
    near: what gives parameters that hold near a robot only, None where there are none.
    """

    stage: Stage
    solver: NlpSolver
    p: Array
    reach: Reach
    tips: int
    near: Surroundings | None = None

    @classmethod
    def of(cls, stage: Stage, solver: NlpSolver, values: Sequence[Mapping[str, Any]], reach: Reach) -> AtOnce:
        """With values of all parameters, by name, for every frame; there may be others among them."""
        own = [{name: each[name] for name in stage.nlp.parameters} for each in values]
        return cls(stage, solver, packed(stage.nlp, own), reach, len(reach.low) - len(stage.decides))

    def given(self, values: Mapping[str, Array | float], near: Surroundings | None = None) -> AtOnce:
        """The same with other values of parameters that are numbers, of all frames or of each (T,).

        Those that the program does not have are left out. near: as the attribute.
        """
        nlp, p = self.stage.nlp, self.p.copy()
        for name, value in values.items():
            if name in nlp.parameters:
                p[:, nlp.place(name).start] = value
        return replace(self, p=p, near=near)

    def search(self, frame: int, x0: Array) -> list[FrameResult]:
        """Answers for a frame without a past from starts x0 (n, n_x), as many as are found."""
        p = self.p[frame].copy()
        p[self.stage.nlp.place("motion_root")] = 0.0
        return [self._result(solution) for solution in self.solver.each(x0, p, self.reach)]

    def follow(self, frames: Sequence[int], before: FrameResult) -> list[tuple[FrameResult, float]]:
        """Answers for frames, each from the one before, up to the first that is not found; and their seconds."""
        warm = before.warm[0] if before.warm else None
        known = before.q if before.x is None else before.x
        x0 = np.append(known, np.zeros(self.stage.nlp.slacks)) if warm is None else warm.x
        here = np.append(before.q, known[: self.tips])
        found = self.solver.follow(x0, self.p[list(frames)], self.reach, here, warm, self.near)
        return [(self._result(each.solution), each.seconds) for each in found]

    def _result(self, solution: Solution) -> FrameResult:
        return FrameResult(
            solution.q[: len(self.stage.decides)],
            True,
            solution.objective,
            solution.kkt,
            solution.iterations,
            solution.status,
            (solution,),
            solution.x[: len(solution.x) - self.stage.nlp.slacks] if self.tips else None,
        )
