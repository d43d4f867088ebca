"""Share of time outside compiled code: in Python and numpy, around calls of C.

The whole is timed without the profiler, which slows Python down, and the compiled part with it.
"""

from __future__ import annotations

import cProfile
import pstats
import time
from collections.abc import Callable
from typing import Any

from benchmarks.growth import min_thread_seconds
from ctr_nlp.paths.named_problems import named_problem
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.per_frame import solve_per_frame
from ctr_nlp.planning.steerer import Steerer
from ctr_nlp.typing import Array

CALLERS = (("codegen/batch_evaluator.py", "__call__"), ("frame/run.py", "__call__"), ("motion/loop.py", "iterate"))
"""Functions (end of the file's path, name) whose own time is that of the C code that they call."""
COMPILED = "casadi", "lapack", "scipy.linalg"
"""Words in the names of built-in functions that count as compiled."""


def compiled_seconds(work: Callable[[], Any]) -> float:
    """Return the processor time, s, of `work` in compiled code: the own time of functions that call it."""
    profile = cProfile.Profile(time.thread_time)
    profile.runcall(work)
    entries: dict[tuple[str, int, str], Any] = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    return float(sum(own for key, (_, _, own, _, _) in entries.items() if _is_compiled(*key)))


def _is_compiled(file: str, line: int, name: str) -> bool:
    # The profiler files built-in functions under "~".
    if file == "~":
        return any(word in name for word in COMPILED)
    path = file.replace("\\", "/")
    return any(path.endswith(end) and name == function for end, function in CALLERS)


def uncompiled_share(work: Callable[[], Any], repeats: int = 5) -> float:
    """Return the share of work's time outside compiled code, from the least times over a number of repeats."""
    whole = min_thread_seconds(work, repeats)
    within = min(compiled_seconds(work) for _ in range(repeats))
    return max(0.0, 1 - within / whole)


def measure_uncompiled_shares() -> dict[str, float]:
    """Return the shares of time outside compiled code: of steps along cos on both models, and of its horizon."""
    problem = named_problem("cos")
    found = {}
    for model in ("dominant", "elastic"):
        steerer = Steerer(problem.robot, _start(model), problem.dt, model=model)
        targets = [frame.points for frame in problem.target_frames]
        there_and_back = targets + targets[::-1]

        def step_all(steerer: Steerer = steerer, targets: list[Array] = there_and_back) -> None:
            for each in targets:
                steerer.step(each)

        found[f"Steerer.step, {model}"] = uncompiled_share(step_all)
    found["solve_horizon"] = uncompiled_share(lambda: solve_horizon(problem, model="dominant"), 3)
    return found


def _start(model: str) -> Any:
    return solve_per_frame(named_problem("cos"), model=model, direction="forward").q[0]
