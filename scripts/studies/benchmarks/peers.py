"""Race of solvers on identical frames: compiled SQP, interpreted IPOPT and the paper's methods.

Every solver gets the same start, parameters and bounds of each frame, from the path of compiled SQP, so that only
the solver makes a difference.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from reference import reference_frames

from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.frame_solver import FrameResult, reachable_bounds
from ctr_nlp.ocp.joint import joint
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.stage import Stage
from ctr_nlp.paths.problem import Problem
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.solvers import SOLVERS, NlpSolver, Solution
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.typing import Array

Found = TypeVar("Found", Solution, FrameResult)

REFERENCE_FRAME_STRIDE = 5
"""Stride of the frames that the paper's methods solve, which take much longer."""
REFERENCES = ("paper-two-stage", "euclidean")
PEER_RACE_ROUNDS = 3
"""Number of rounds in which each solver solves all frames."""
EVALUATIONS = 2000
"""Number of evaluations over which the time of one is averaged."""


class Times:
    """Times of one method: processor time of the thread for each frame, s, and the number of failed frames."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.failed = 0

    def time_call(self, work: Callable[..., Found], *arguments: Any) -> Found:
        """Call `work` with `arguments`, which solves one frame; record its time, and return its result."""
        begin = time.thread_time()
        found = work(*arguments)
        self.seconds.append(time.thread_time() - begin)
        self.failed += not found.success
        return found


def race_solvers(problem: Problem) -> dict[str, Times]:
    """Solve a problem's frames by every method in turn, each from compiled SQP's solution of the frame before.

    Returns the times by the method's name.
    """
    settings = Settings()
    (stage,) = joint(problem.robot, settings, KINEMATIC_MODELS["dominant"])
    solvers: dict[str, NlpSolver] = {name: SOLVERS[name](stage.nlp) for name in ("sqp", "ipopt")}
    path = _path(problem, stage, solvers["sqp"])
    times = {name: Times() for name in (*solvers, *REFERENCES)}
    for _ in range(PEER_RACE_ROUNDS):
        for name, solve in solvers.items():
            warm: Solution | None = None
            for given in path:
                warm = times[name].time_call(solve, *given, warm)
    for name in REFERENCES:
        method = reference_frames(problem, name, settings)
        for number in range(REFERENCE_FRAME_STRIDE, problem.frames, REFERENCE_FRAME_STRIDE):
            # path[j] belongs to frame j + 1 and starts at the solution of frame j.
            times[name].time_call(method.step, number, FrameResult(path[number - 1][0]))
    return times


def _path(problem: Problem, stage: Stage, solve: NlpSolver) -> list[tuple[Array, Array, Array, Array]]:
    """Return start, parameters, lower and upper bounds of each frame's NLP but the first.

    Each starts from the solution of the frame before by `solve`, which is compiled SQP.
    """
    settings = Settings()
    warm = None
    path: list[tuple[Array, Array, Array, Array]] = []
    q = NlpFrames.of(problem, model="dominant", settings=settings).search(0)[0].q
    for frame in problem.target_frames[1:]:
        given = {"previous": q, "motion_root": math.sqrt(settings.motion_weight) / problem.dt}
        path.append(
            (q, stage.nlp.pack({**stage.fill(frame, q), **given}), *reachable_bounds(problem.robot, q, problem.dt))
        )
        warm = solve(*path[-1], warm)
        q = warm.x
    return path


def evaluation_seconds(program: Program, function: str = "slopes") -> float:
    """Return the seconds of one evaluation of a frame's objective and constraints.

    program: compiled. function: "value" for values alone, "slopes" for first derivatives, too.
    """
    # Called as C by its address, without CasADi's wrapper, which takes longer than the function: the signature of
    # code that CasADi generates is int f(arg, res, iw, w, mem).
    run = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4, ctypes.c_int)(program.functions[function])
    n = len(program.x)
    m = len(program.lower) - len(program.x)
    results = [np.zeros(max(count, 1)) for count in ((1, m) if function == "value" else (1, n, m, m * n))]
    pointers = ctypes.c_void_p * 4
    arg = pointers(program.x.ctypes.data, program.p.ctypes.data)
    res = pointers(*(result.ctypes.data for result in results))
    begin = time.thread_time()
    for _ in itertools.repeat(None, EVALUATIONS):
        run(arg, res, None, None, 0)
    return (time.thread_time() - begin) / EVALUATIONS
