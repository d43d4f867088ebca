"""Runs through all frames of a problem, each frame from the one before it; and how work that goes on is told."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ctr_nlp.formulations.frames import FrameResult, FrameSolver, Restartable
from ctr_nlp.models import Model
from ctr_nlp.plan.metrics import rms_over_sigma
from ctr_nlp.simulation.forward import Simulator
from ctr_nlp.solvers import Iterate
from ctr_nlp.solvers.motion.banded import MOST_ITERATIONS, TOLERANCE
from ctr_nlp.steer.requests import Direction, checked_ends
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array

Progress = Callable[[int, int, str], None]
"""Called with (steps done, steps in all, what is being done)."""

CANDIDATES = 4
"""Distinct answers of the first frame from which a whole motion is tried, in each direction."""


WINDOW = 12
"""Iterations over which the fall of the KKT residual is looked at."""


@dataclass
class Pass:
    """One run through all frames; results and seconds by frame number."""

    direction: str
    order: Sequence[int]
    before: FrameResult | None = None
    results: dict[int, FrameResult] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)

    def run(self, solver: FrameSolver) -> Iterator[int]:
        """Solve the frames that have no result yet, in order, after those that have; yields how many have one."""
        known = [frame for frame in self.order if frame in self.results]
        left = [frame for frame in self.order if frame not in self.results]
        before = self.results[known[-1]] if known else self.before
        assert before is not None
        if known:
            yield len(known)
        for frame, (result, seconds) in zip(left, solver.run(left, before), strict=True):
            self.results[frame], self.seconds[frame] = result, seconds
            yield len(self.results)

    def motion(self, problem: Problem) -> Array:
        """Configurations (T, 2d + 2); NaN where a frame was not reached."""
        missing = np.full(2 * problem.robot.d + 2, np.nan)
        return np.array([self.results[j].q if j in self.results else missing for j in range(problem.frames)])

    def unknowns(self, problem: Problem) -> Array:
        """The model's unknowns (T, n), which are q itself unless results say otherwise; NaN as in motion."""
        found = self.motion(problem)
        for j, result in self.results.items():
            found[j] = found[j] if result.x is None else result.x
        return found

    def cost(self, problem: Problem) -> tuple[int, float]:
        """Frames not solved, then the mean objective of the others in mm^2."""
        solved = [result.objective for result in self.results.values() if result.success]
        return problem.frames - len(solved), float(np.mean(solved)) if solved else np.inf

    def planned(self, problem: Problem, model: Model) -> tuple[int, float]:
        """Frames not solved, then the mean square error in mm^2 of the others where the robot is as planned."""
        solved = self._solved()
        x = np.array([self.results[j].q if self.results[j].x is None else self.results[j].x for j in solved])
        return self._off(problem, solved, lambda: model.points(problem.robot, x, SIGMA))

    def badness(self, problem: Problem, simulator: Simulator) -> tuple[int, float]:
        """The same where the robot is when it has been moved there."""
        solved = self._solved()
        q = np.array([self.results[j].q for j in solved])
        return self._off(problem, solved, lambda: simulator(q).shape)

    def missed(self, problem: Problem, simulator: Simulator, tolerance: float) -> float:
        """Return by how much the robot's tip misses the target's last end, beyond a tolerance.

        Parameters
        ----------
        problem : Problem
            Robot and target.
        simulator : Simulator
            Of its robot; moves it through the frames that were solved.
        tolerance : float
            Distance that counts as arrived, mm.

        Returns
        -------
        float
            mm; inf where the last frame was not solved.
        """
        solved = self._solved()
        if not solved or solved[-1] != problem.frames - 1:
            return math.inf
        tip = simulator(np.array([self.results[j].q for j in solved])).shape[-1, -1]
        return max(0.0, float(np.linalg.norm(tip - problem.samples[-1].points[-1])) - tolerance)

    def _solved(self) -> list[int]:
        return sorted(j for j, result in self.results.items() if result.success)

    def _off(self, problem: Problem, solved: Sequence[int], shape: Callable[[], Array]) -> tuple[int, float]:
        if not solved:
            return problem.frames, np.inf
        wanted = np.array([problem.samples[j].points for j in solved])
        squares = rms_over_sigma(np.linalg.norm(shape() - wanted, axis=-1)) ** 2
        return problem.frames - len(solved), float(squares.mean())


def run_passes(
    problem: Problem,
    solver: FrameSolver,
    direction: Direction = "best",
    start: npt.ArrayLike | None = None,
    end: npt.ArrayLike | None = None,
    progress: Progress | None = None,
) -> tuple[list[Pass], float]:
    """Runs through all frames from every promising first one, and the seconds that their search took.

    start: q at time 0; end: q of the last frame. A motion leads from the first forward, from the second
    backward. Ctrl-C, held back by the caller, ends each run after its next frame.
    """
    q0, q1 = checked_ends(problem, direction, start, end)
    begin = time.perf_counter()
    with deferred_interrupt() as interrupted:
        passes = _first_frames(problem, solver, direction, q0, q1)
        seconds = time.perf_counter() - begin
        for number, one in enumerate(passes):
            for done in one.run(solver):
                if interrupted():
                    break
                if progress is not None:
                    note = f"{one.direction}, try {number + 1} of {len(passes)}"
                    progress(number * problem.frames + done, len(passes) * problem.frames, note)
    return passes, seconds


def run_again(known: Pass, solver: Restartable, stop: Callable[[], bool]) -> Pass:
    """A run of another solver through the same frames, from what it finds near to a known one's first answer."""
    first, begin = known.order[0], time.perf_counter()
    results = {} if known.before else {first: solver.again(first, known.results[first])}
    seconds = dict.fromkeys(results, time.perf_counter() - begin)
    one = Pass(known.direction, known.order, known.before, results, seconds)
    for _ in one.run(solver):
        if stop():
            break
    return one


def _first_frames(
    problem: Problem, solver: FrameSolver, direction: Direction, q0: Array | None, q1: Array | None
) -> list[Pass]:
    forward = range(problem.frames)
    given = []
    if q0 is not None:
        given.append(Pass("forward", forward, FrameResult(q0)))
    if q1 is not None:
        given.append(Pass("backward", forward[::-1], None, {forward[-1]: FrameResult(q1)}))
    if given:
        return given
    orders: dict[str, range] = {"forward": forward, "backward": forward[::-1]}
    wanted = orders if direction == "best" and problem.frames > 1 else {direction: orders.get(direction, forward)}
    passes = []
    for name, order in wanted.items():
        for first in solver.search(order[0])[:CANDIDATES]:
            begin = time.perf_counter()
            again = solver.step(order[0], first) if first.success else first
            seconds = time.perf_counter() - begin
            passes.append(
                Pass(name, order, None, {order[0]: again if again.success else first}, {order[0]: seconds})
            )
    return passes


class Forecast:
    """Tells progress how far a solver is: iterations done, and how many its KKT residual's fall lets expect."""

    def __init__(self, progress: Progress, frames: int, number: int, count: int) -> None:
        self._progress = progress
        self._frames = frames
        self._which = f"start {number} of {count}, " if count > 1 else ""
        self._best: list[float] = []

    def __call__(self, iterate: Iterate) -> None:
        """Tell of one more iterate."""
        error = math.log(max(iterate.error, TOLERANCE))
        self._best.append(min([error, *self._best[-1:]]))
        recent = self._best[-WINDOW:]
        fall = (recent[0] - recent[-1]) / max(len(recent) - 1, 1)
        left = (recent[-1] - math.log(TOLERANCE)) / fall if fall > 0 else WINDOW
        total = iterate.number + max(1, min(math.ceil(left), MOST_ITERATIONS - iterate.number))
        objective, violation = iterate.objective / self._frames, max(iterate.violation, 0.0)
        note = f"{self._which}objective {objective:.4g} mm², violation {violation:.0e}"
        self._progress(iterate.number, total, note)
