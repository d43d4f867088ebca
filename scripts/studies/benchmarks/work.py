"""One row of the benchmark in a process of its own, for whichever tree of the library is on its path.

It is run as a file, with the name of a row, and imports only what every tree to be compared has: the
same file serves all trees. It writes a line of JSON when it is ready. Each line that it reads, a number of turns
and a factor, is answered with a line of as many lists of times.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

WorkTimer = Callable[[Callable[[], Any]], float]
"""A function that calls another one and returns the seconds that it took."""
TurnFunction = Callable[[WorkTimer], list[float]]
"""A function that does one turn of a row and returns the seconds of each piece of its work."""
BENCHMARK_BATCH_SIZE = 1000
"""Number of configurations whose elastic shapes are computed in one call."""
BENCHMARK_FORCE_N, BENCHMARK_MODULUS_MPA = 0.1, 60_000.0
"""Tip force across the robot, N, and Young's modulus, MPa, in rows with a load."""


def _problem(name: str, frames: int = 100) -> Any:
    from ctr_nlp.paths.named_problems import named_problem

    return named_problem(name, frames)


def _loaded_problem(problem: Any) -> tuple[Any, Any]:
    """Return the problem with a Young's modulus for its robot, and the model that applies the tip force."""
    from ctr_nlp.models.loaded.model import Loaded
    from ctr_nlp.models.loads import Load, with_modulus

    robot = with_modulus(problem.robot, BENCHMARK_MODULUS_MPA)
    return replace(problem, robot=robot), Loaded(Load((0.0, BENCHMARK_FORCE_N, 0.0)))


def step(model: str, loaded: bool = False) -> TurnFunction:
    """Make the row of Steerer.step, for each frame's target of cos, forward and back.

    model: name of the kinematic model. loaded: whether a force acts on the tip, on the model with loads.
    """
    from ctr_nlp.planning.per_frame import solve_per_frame
    from ctr_nlp.planning.steerer import Steerer

    problem, model = _loaded_problem(_problem("cos")) if loaded else (_problem("cos"), model)
    plan = solve_per_frame(problem, model=model, direction="forward")
    steerer = Steerer(problem.robot, plan.q[0], problem.dt, model=model)
    targets = [frame.points for frame in problem.target_frames]
    targets += targets[::-1]
    return lambda timed: [timed(lambda target=target: steerer.step(target)) for target in targets]  # type: ignore[misc]


def march(name: str, model: str = "dominant") -> TurnFunction:
    """Make the row of solve_per_frame: the time of all frames from a known start, over their number.

    name: of the problem. model: name of the kinematic model.
    """
    from ctr_nlp.planning.per_frame import solve_per_frame

    problem = _problem(name)
    start = solve_per_frame(problem, model=model, direction="forward").q[0]
    return lambda timed: [
        timed(lambda: solve_per_frame(problem, model=model, direction="forward", start=start)) / problem.frames
    ]


def random_poses(robot: Any) -> Any:
    """Sample configurations (BENCHMARK_BATCH_SIZE, 2d + 2) of a robot without tilt."""
    d = robot.d
    unit = np.random.default_rng(0).random((BENCHMARK_BATCH_SIZE, len(robot.lower)))
    beta = np.sort(unit[:, d : 2 * d], axis=1) * robot.upper[d : 2 * d]
    return np.hstack([unit[:, :d] * 2 * np.pi, beta, 0 * unit[:, 2 * d :]])


def shape(count: int) -> TurnFunction:
    """Make the row of elastic shapes with margins along a motion through random configurations.

    count: configurations in a call. The time is that of one.
    """
    from ctr_nlp.plan.simulation import simulate_motion
    from ctr_nlp.robot import table_i_robot

    robot = table_i_robot()
    q = random_poses(robot)
    given = [q] if count == BENCHMARK_BATCH_SIZE else [q[k : k + count] for k in range(0, 10 * count, count)]
    return lambda timed: [timed(lambda one=one: simulate_motion(robot, one, "elastic")) / count for one in given]  # type: ignore[misc]


def rest() -> TurnFunction:
    """Make the row of elastic shapes with margins at rest, BENCHMARK_BATCH_SIZE configurations in a call.

    The time is that of one.
    """
    from ctr_nlp.models import model_named
    from ctr_nlp.paths.target import SIGMA_GRID
    from ctr_nlp.robot import table_i_robot

    robot = table_i_robot()
    elastic = model_named("elastic")
    q = random_poses(robot)
    return lambda timed: [timed(lambda: elastic.rest_states(robot, q, SIGMA_GRID)) / BENCHMARK_BATCH_SIZE]


def horizon(*names: str, model: str = "dominant", frames: int = 100, loaded: bool = False) -> TurnFunction:
    """Make the row of solve_horizon, including its start motions.

    names: of the problems. model: name of the kinematic model. frames: number of frames. loaded: whether a force
    acts on the tip.
    """
    from ctr_nlp.planning.horizon import solve_horizon

    problems = [_problem(name, frames) for name in names]
    asked = [_loaded_problem(problem) if loaded else (problem, model) for problem in problems]
    return lambda timed: [timed(lambda one=one, on=on: solve_horizon(one, model=on)) for one, on in asked]  # type: ignore[misc]


def contact() -> TurnFunction:
    """Make the row of solve_on_wall in bronchus, with the plan that it begins with."""
    from ctr_nlp.loads.contact_plan import solve_on_wall

    problem, _ = _loaded_problem(_problem("bronchus"))
    return lambda timed: [timed(lambda: solve_on_wall(problem))]


def program(*options: str) -> TurnFunction:
    """Make the row of `ctr-nlp plan arc` as a process, including the processes that it starts.

    options: of the command line; those that a tree does not have are left out.
    """
    folder = tempfile.TemporaryDirectory()
    plan = [sys.executable, "-m", "ctr_nlp", "plan"]
    told = subprocess.run([*plan, "--help"], capture_output=True, text=True, check=True).stdout
    command = [*plan, "arc", "--out", f"{folder.name}/out", *(option for option in options if option in told)]

    def run(timed: WorkTimer) -> list[float]:
        # Processor time of the children, since the work is not in this thread.
        before = os.times()
        done = subprocess.run(
            command, cwd=folder.name, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        after = os.times()
        if done.returncode != 0:
            raise RuntimeError(done.stderr)
        spent = after.children_user + after.children_system - before.children_user - before.children_system
        return [spent + timed(lambda: None)]

    return run


BENCHMARK_ROWS: dict[str, Callable[[], TurnFunction]] = {
    "step": lambda: step("dominant"),
    "step-elastic": lambda: step("elastic"),
    "step-loaded": lambda: step("elastic", loaded=True),
    "frame": lambda: march("cos"),
    "frame-lumen": lambda: march("bronchus"),
    "shape": lambda: shape(1),
    "shapes": lambda: shape(BENCHMARK_BATCH_SIZE),
    "shapes-rest": rest,
    "horizon": lambda: horizon("cos"),
    "plans": lambda: horizon("cos", "arc", "line", "line_arc", "synthesis"),
    "horizon-lumen": lambda: horizon("bronchus"),
    "horizon-elastic": lambda: horizon("cos", model="elastic"),
    "horizon-loaded": lambda: horizon("cos", model="elastic", loaded=True),
    "horizon-lumen-loaded": lambda: horizon("bronchus", model="elastic", loaded=True),
    "horizon-contact": contact,
    "horizon-5000": lambda: horizon("cos", frames=5000),
    "program": lambda: program("--model", "dominant", "--no-figures"),
    "program-figures": lambda: program("--model", "dominant"),
}
"""The rows: name -> function that prepares the row and returns its turn."""


def timer(factor: float) -> WorkTimer:
    """Return a timer that measures processor time of the thread, s.

    factor: above 1, all work is made to take so many times as long, to test that the benchmark notices.
    """

    def timed(work: Callable[[], Any]) -> float:
        begin = time.thread_time()
        work()
        end = time.thread_time()
        until = begin + factor * (end - begin)
        while factor > 1 and end < until:
            end = time.thread_time()
        return end - begin

    return timed


def serve_row(row: str, lines: Iterator[str]) -> Iterator[str]:
    """Yield a line of JSON when the row is ready, and then the answer to each of `lines`."""
    work = BENCHMARK_ROWS[row]()
    # One turn that does not count: it fills caches and loads what is imported late.
    work(timer(1.0))
    yield json.dumps("ready")
    for line in lines:
        turns, factor = json.loads(line)
        yield json.dumps([work(timer(factor)) for _ in range(turns)])


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the library prints is no answer
    for answer in serve_row(sys.argv[1], iter(sys.stdin.readline, "")):
        print(answer, file=answers, flush=True)
