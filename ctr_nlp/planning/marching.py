"""Passes through all frames of a problem, each frame from the one before it, and their progress.

Each target alone has several good configurations, and only the motion shows which of them can be continued to the
end. Passes therefore start from several solutions of the first frame, forwards, and of the last frame, backwards:
the best configuration of the last frame need not be reachable from the first.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ctr_nlp.models import Model
from ctr_nlp.ocp.frame_solver import FrameResult, FrameSolver, Restartable
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.metrics import rms_over_sigma
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.planning.validation import Direction, checked_ends
from ctr_nlp.solvers import Iterate
from ctr_nlp.solvers.motion.banded import BANDED_KKT_TOLERANCE, MAX_BANDED_ITERATIONS
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.typing import Array

Progress = Callable[[int, int, str], None]
"""Called with (steps done, steps in all, what is being done)."""

MAX_FIRST_FRAME_CANDIDATES = 4
"""Largest number of solutions of the first frame from which a pass is made, in each direction."""


FORECAST_WINDOW_ITERATIONS = 12
"""Iterations over which the fall of the KKT residual is averaged for a forecast."""


@dataclass
class Pass:
    """One pass through all frames.

    direction: "forward" or "backward". order: frame numbers, from 0, as they are solved. before: the given start
    at time 0, which is no frame, or None. results, seconds: by frame number.
    """

    direction: str
    order: Sequence[int]
    before: FrameResult | None = None
    results: dict[int, FrameResult] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)

    def run(self, solver: FrameSolver) -> Iterator[int]:
        """Solve the frames that have no result yet, in order, with a solver; yield the number of results."""
        # A pass that was interrupted, or begins with a given frame, continues from its last result.
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
        """Return the configurations (T, 2d + 2) of a pass through a problem; NaN where a frame was not reached."""
        # NaN, so that a frame that was not reached shows as such in whatever is computed from it.
        missing = np.full(2 * problem.robot.d + 2, np.nan)
        return np.array([self.results[j].q if j in self.results else missing for j in range(problem.frames)])

    def unknowns(self, problem: Problem) -> Array:
        """Return the model's unknowns (T, n) in the frames of a problem, q on some models; NaN if not reached."""
        found = self.motion(problem)
        for j, result in self.results.items():
            found[j] = found[j] if result.x is None else result.x
        return found

    def cost(self, problem: Problem) -> tuple[int, float]:
        """Return the number of frames of a problem not solved, and the mean objective of the others in mm^2."""
        # Compared as a tuple: a pass with fewer failed frames is better, whatever its objective.
        solved = [result.objective for result in self.results.values() if result.success]
        return problem.frames - len(solved), float(np.mean(solved)) if solved else np.inf

    def planned_error(self, problem: Problem, model: Model) -> tuple[int, float]:
        """Return the number of frames not solved, and the mean square error of the others, mm^2, as planned.

        problem: robot and target. model: of the pass; the robot is taken to be in the equilibria that it found.
        """
        solved = self._solved_frames()
        x = np.array([self.results[j].q if self.results[j].x is None else self.results[j].x for j in solved])
        return self._mean_square_error(problem, solved, lambda: model.points(problem.robot, x, SIGMA_GRID))

    def simulated_error(self, problem: Problem, simulator: Simulator) -> tuple[int, float]:
        """Return the number of frames not solved, and the mean square error of the others, mm^2, as simulated.

        problem: robot and target. simulator: of its robot, which may reach other equilibria than those planned.
        """
        solved = self._solved_frames()
        q = np.array([self.results[j].q for j in solved])
        return self._mean_square_error(problem, solved, lambda: simulator(q).shape)

    def tip_miss_distance(self, problem: Problem, simulator: Simulator, tolerance: float) -> float:
        """Return the distance of the last tip from the target's end, beyond a tolerance.

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
        solved = self._solved_frames()
        if not solved or solved[-1] != problem.frames - 1:
            return math.inf
        # All solved frames are moved through: the last equilibrium depends on those before it.
        tip = simulator(np.array([self.results[j].q for j in solved])).shape[-1, -1]
        return max(0.0, float(np.linalg.norm(tip - problem.target_frames[-1].points[-1])) - tolerance)

    def _solved_frames(self) -> list[int]:
        return sorted(j for j, result in self.results.items() if result.success)

    def _mean_square_error(
        self, problem: Problem, solved: Sequence[int], shape: Callable[[], Array]
    ) -> tuple[int, float]:
        if not solved:
            return problem.frames, np.inf
        wanted = np.array([problem.target_frames[j].points for j in solved])
        # 101 samples with trapezoidal weights, as in reported errors; programs have 21.
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
    """Make a pass from every promising first frame; return the passes, and the seconds of the search for these.

    problem: robot and target. solver: of single frames. direction: order of frames, "best" for both. start: q (2d
    + 2,) at time 0, for a forward pass; end: q of the last frame, for a backward one. progress: callback. Ctrl-C,
    deferred by the caller, ends each pass after its next frame.
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
                    note = f"frame by frame {one.direction}, initial guess {number + 1} of {len(passes)}"
                    progress(number * problem.frames + done, len(passes) * problem.frames, note)
    return passes, seconds


def run_again(known: Pass, solver: Restartable, stop: Callable[[], bool]) -> Pass:
    """Make a pass with another solver, in the order of a known pass and starting near its first solution.

    stop: called after every frame, returns whether to end.
    """
    first = known.order[0]
    begin = time.perf_counter()
    # A pass from a given start has no first solution to be solved again: its start is no frame.
    results = {} if known.before else {first: solver.search_near(first, known.results[first])}
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
    # A given end is the last frame's result itself; a given start is the configuration before frame 0.
    given = []
    # With both ends given, both passes are made: each uses only one of them.
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
        for first in solver.search(order[0])[:MAX_FIRST_FRAME_CANDIDATES]:
            begin = time.perf_counter()
            # Solved once more as if the robot stood there already: the warm start then belongs to the program with
            # the motion term, and a twin, which was only written down, is solved at all.
            again = solver.step(order[0], first) if first.success else first
            seconds = time.perf_counter() - begin
            passes.append(
                Pass(name, order, None, {order[0]: again if again.success else first}, {order[0]: seconds})
            )
    return passes


class Forecast:
    """Callback that reports progress: iterations done, and their total as estimated from the KKT residual.

    frames: of the chain. number, count: number of this start, from 1, and of all starts.
    """

    def __init__(self, progress: Progress, frames: int, number: int, count: int) -> None:
        self._progress = progress
        self._frames = frames
        self._which = f"initial guess {number} of {count}, " if count > 1 else ""
        self._best: list[float] = []

    def __call__(self, iterate: Iterate) -> None:
        """Report one more iterate."""
        # The residual falls about linearly in its logarithm; the best one so far is taken, since it does not fall
        # monotonically.
        error = math.log(max(iterate.error, BANDED_KKT_TOLERANCE))
        self._best.append(min([error, *self._best[-1:]]))
        recent = self._best[-FORECAST_WINDOW_ITERATIONS:]
        fall = (recent[0] - recent[-1]) / max(len(recent) - 1, 1)
        # Iterations left at the recent rate; where there is no fall, as many as the window is long.
        left = (recent[-1] - math.log(BANDED_KKT_TOLERANCE)) / fall if fall > 0 else FORECAST_WINDOW_ITERATIONS
        total = iterate.number + max(1, min(math.ceil(left), MAX_BANDED_ITERATIONS - iterate.number))
        objective = iterate.objective / self._frames
        self._progress(iterate.number, total, f"{self._which}objective {objective:.4g} mm²")
