"""Many frames in one call of compiled code: the joint formulation, eq. (9), frame after frame without Python.

All of q = (alpha, beta, theta), rad and mm, is decided by one program, whose parameters p differ from frame to
frame. A frame starts from the solution of the one before it and may move away from it by speed times dt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctr_nlp.ocp import Stage
from ctr_nlp.ocp.frame import pack_frames
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.ocp.joint import tip_step_limits
from ctr_nlp.ocp.local_parameters import LocalParameterSource
from ctr_nlp.robot import Robot
from ctr_nlp.solvers import NlpSolver, Solution
from ctr_nlp.solvers.frame.adapter import ConfigurationLimits
from ctr_nlp.typing import Array


def reach_of(robot: Robot, dt: float, several_equilibria: bool) -> ConfigurationLimits:
    """Return limits of q and, where q does not determine the unknowns, of the tips' angles, and of their steps.

    robot: with limits and speeds. dt: time between frames, s. several_equilibria: whether the model has tips as
    unknowns besides q.
    """
    # The model's unknowns have no bounds of their own where they are not q. The tips' angles are still limited
    # from frame to frame: a larger turn would be a jump to another branch of equilibria.
    free = np.full(robot.d * several_equilibria, np.inf)
    own = (robot.lower, robot.upper, robot.speed * dt)
    more = (-free, free, tip_step_limits(robot, dt)[: len(free)])
    return ConfigurationLimits(*(np.append(*pair) for pair in zip(own, more, strict=True)))


@dataclass(frozen=True)
class CompiledFrames:
    """One program for all frames of a problem.

    p (T, n_p): its parameters in each frame. reach: bounds of q and of its change from frame to frame. tips:
    number of unknowns that are tips' angles, which may also change only so much between frames; 0 where the
    unknowns are q itself. local_parameters: gives parameters that are valid near one configuration only, such as
    those of a wall; None where there are none.
    """

    stage: Stage
    solver: NlpSolver
    p: Array
    reach: ConfigurationLimits
    tips: int
    local_parameters: LocalParameterSource | None = None

    @classmethod
    def of(
        cls, stage: Stage, solver: NlpSolver, values: Sequence[Mapping[str, Any]], reach: ConfigurationLimits
    ) -> CompiledFrames:
        """Pack the parameters of every frame for the program of a stage.

        stage: with its program. solver: of that program. values: parameters of each frame, by name; names that the
        program does not have are left out. reach: limits of q and of its steps, from reach_of.
        """
        # A formulation fills parameters of all its stages; the program of one stage has some of them.
        own = [{name: each[name] for name in stage.nlp.parameters} for each in values]
        return cls(stage, solver, pack_frames(stage.nlp, own), reach, len(reach.low) - len(stage.decides))

    def with_parameters(
        self, values: Mapping[str, Array | float], local_parameters: LocalParameterSource | None = None
    ) -> CompiledFrames:
        """Return these frames with other values of some parameters, by name; each is a number or (T,) numbers.

        Names that the program does not have are left out. local_parameters: what gives parameters that are valid
        near one configuration only, or None.
        """
        nlp = self.stage.nlp
        p = self.p.copy()
        for name, value in values.items():
            if name in nlp.parameters:
                # A number has one column; `start` picks it, and broadcasts over frames.
                p[:, nlp.parameter_slice(name).start] = value
        return replace(self, p=p, local_parameters=local_parameters)

    def search(self, frame: int, x0: Array) -> list[FrameResult]:
        """Solve a frame, from 0, that has no frame before it, from starts x0 (n, n_x); return all solutions."""
        p = self.p[frame].copy()
        # Without a frame before, there is no motion to pay for: the root of its weight is 0.
        p[self.stage.nlp.parameter_slice("motion_root")] = 0.0
        return [self._result(solution) for solution in self.solver.solve_from_starts(x0, p, self.reach)]

    def follow(self, frames: Sequence[int], before: FrameResult) -> list[tuple[FrameResult, float]]:
        """Solve frames, from 0, each from the one before; return results and the seconds that each took.

        before: result of the frame before the first one. The list ends before the first frame that is not solved:
        the caller decides how to continue there.
        """
        warm = before.warm[0] if before.warm else None
        known = before.q if before.x is None else before.x
        # A slack is the depth by which the clearance is missed, mm; 0 is its value far from the wall.
        x0 = np.append(known, np.zeros(self.stage.nlp.slacks)) if warm is None else warm.x
        # Limits of speed are relative to `here`: q, and after it the tips where their steps are limited, too.
        here = np.append(before.q, known[: self.tips])
        found = self.solver.solve_sequence(x0, self.p[list(frames)], self.reach, here, warm, self.local_parameters)
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
            # Slacks come last among the unknowns, and are no part of the robot's state.
            solution.x[: len(solution.x) - self.stage.nlp.slacks] if self.tips else None,
        )
