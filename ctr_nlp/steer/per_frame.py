"""Steering frame by frame: a first frame found by search, then each from the one before it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import OptionError
from ctr_nlp.forward import shapes
from ctr_nlp.frames import FrameResult, FrameSolver
from ctr_nlp.metrics import rms_over_sigma
from ctr_nlp.plan import Plan, plan_from_configurations
from ctr_nlp.problem import Problem
from ctr_nlp.settings import Settings
from ctr_nlp.steer.interrupt import deferred_interrupt
from ctr_nlp.steer.nlp_frames import DEFAULTS, NlpFrames

Array = npt.NDArray[np.float64]
Direction = Literal["forward", "backward", "best"]
Progress = Callable[[int, int, str], None]
"""Called with (frames done, frames in all, what is being done)."""

DIRECTIONS = ("forward", "backward", "best")
CANDIDATES = 4
"""Distinct answers of the first frame from which a whole motion is tried, in each direction."""


def solve_per_frame(
    problem: Problem,
    formulation: str = "joint",
    *,
    model: str = "dominant",
    solver: str = "ipopt",
    direction: Direction = "best",
    start: npt.ArrayLike | None = None,
    settings: Settings = DEFAULTS,
    progress: Progress | None = None,
) -> Plan:
    """The plan that follows a problem's target frame by frame.

    formulation: joint, two-stage or two-stage-exact. solver: ipopt or sqp. direction: in which order frames
    are solved; best tries both. start: q (2d + 2,) at time 0, from which the motion then leads forward.
    settings: weights, widths and seeds. Frames that could not be solved are marked in the plan. Ctrl-C ends
    the work; the plan then has what was solved and is marked as interrupted. Raises OptionError, RobotError.
    """
    return march(
        problem,
        NlpFrames(problem, formulation, solver, model, settings),
        direction,
        start,
        progress,
    )


def march(
    problem: Problem,
    solver: FrameSolver,
    direction: Direction = "best",
    start: npt.ArrayLike | None = None,
    progress: Progress | None = None,
) -> Plan:
    """The plan that any FrameSolver makes; arguments as for solve_per_frame."""
    if direction not in DIRECTIONS:
        raise OptionError(f"direction is {direction!r}; it must be one of {', '.join(DIRECTIONS)}")
    q0 = None if start is None else np.asarray(start, dtype=float)
    if q0 is not None:
        problem.robot.check(q0, "start")
        if direction == "backward":
            raise OptionError("direction is 'backward' and a start is given; a motion from a start goes forward")
    begin = time.perf_counter()
    with deferred_interrupt() as interrupted:
        passes = _first_frames(problem, solver, direction, q0)
        search_seconds = time.perf_counter() - begin
        for number, one in enumerate(passes):
            for done in one.run(solver):
                if interrupted():
                    break
                if progress is not None:
                    note = f"{one.direction}, try {number + 1} of {len(passes)}"
                    progress(number * problem.frames + done, len(passes) * problem.frames, note)
    best = min(passes, key=lambda one: one.badness(problem))
    options = {
        "direction": best.direction,
        "passes": len(passes),
        "start": None if q0 is None else q0.tolist(),
    }
    return _plan(problem, solver, best, options, {"search_s": search_seconds, "interrupted": interrupted()})


@dataclass
class _Pass:
    """One run through all frames; results and seconds by frame number."""

    direction: str
    order: Sequence[int]
    before: FrameResult | None = None
    results: dict[int, FrameResult] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)

    def run(self, solver: FrameSolver) -> Iterator[int]:
        """Solve the frames that have no result yet, in order; yields how many have one."""
        before = self.before
        for frame in self.order:
            if frame not in self.results:
                assert before is not None
                begin = time.perf_counter()
                self.results[frame] = solver.step(frame, before)
                self.seconds[frame] = time.perf_counter() - begin
            before = self.results[frame]
            yield len(self.results)

    def badness(self, problem: Problem) -> tuple[int, float]:
        """Frames not solved, then the mean square error of the others in mm^2."""
        solved = [j for j, result in self.results.items() if result.success]
        if not solved:
            return problem.frames, np.inf
        found = shapes(problem.robot, np.array([self.results[j].q for j in solved]))
        wanted = np.array([problem.samples[j].points for j in solved])
        squares = rms_over_sigma(np.linalg.norm(found - wanted, axis=-1)) ** 2
        return problem.frames - len(solved), float(squares.mean())


def _first_frames(problem: Problem, solver: FrameSolver, direction: Direction, q0: Array | None) -> list[_Pass]:
    forward = range(problem.frames)
    if q0 is not None:
        return [_Pass("forward", forward, FrameResult(q0))]
    orders: dict[str, range] = {"forward": forward, "backward": forward[::-1]}
    wanted = orders if direction == "best" and problem.frames > 1 else {direction: orders.get(direction, forward)}
    passes = []
    for name, order in wanted.items():
        for first in solver.search(order[0])[:CANDIDATES]:
            begin = time.perf_counter()
            again = solver.step(order[0], first) if first.success else first
            seconds = time.perf_counter() - begin
            passes.append(
                _Pass(name, order, None, {order[0]: again if again.success else first}, {order[0]: seconds})
            )
    return passes


def _plan(
    problem: Problem, solver: FrameSolver, best: _Pass, options: dict[str, Any], work: dict[str, Any]
) -> Plan:
    missing = FrameResult(np.full(2 * problem.robot.d + 2, np.nan), success=False, status="not reached")
    results = [best.results.get(j, missing) for j in range(problem.frames)]
    meta = {
        **solver.description,
        **work,
        "options": solver.description["options"] | options,
        "build_s": solver.build_seconds,
        "iterations": sum(result.iterations for result in results),
        "failures": {str(j + 1): r.status for j, r in enumerate(results) if not r.success},
    }
    return plan_from_configurations(
        problem,
        np.array([result.q for result in results]),
        meta,
        success=np.array([result.success for result in results]),
        solve_time=np.array([best.seconds.get(j, np.nan) for j in range(problem.frames)]),
        objective=np.array([result.objective for result in results]),
        kkt=np.array([result.kkt for result in results]),
    )
