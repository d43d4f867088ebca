"""The least contact that there could be in a frame, where contact is all that counts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from ctr_nlp.formulations.frames import starts
from ctr_nlp.formulations.joint import joint
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.wall import ROUNDS, SETTLED, Wall
from ctr_nlp.models import MODELS
from ctr_nlp.simulation.forward import shapes
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import SIGMA, Frame
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
