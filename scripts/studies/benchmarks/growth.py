"""Growth of times with the number of frames, tubes and samples: an exponent p each, and a figure.

The model is t = c n^p with t in s and n the size, fitted by least squares of log t = log c + p log n.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers import evaluation_seconds
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.frame import program
from ctr_nlp.ocp.terms import Order, ShapeDistance
from ctr_nlp.paths.named_problems import named_problem
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.per_frame import solve_per_frame
from ctr_nlp.robot import Robot, Tube, table_i_robot
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.typing import Array

GROWTH_FRAME_COUNTS = (100, 300, 1000, 2000, 5000)
GROWTH_LUMEN_FRAME_COUNTS = (50, 100, 200, 400)
"""Frames of a motion within a lumen."""
GROWTH_TUBE_COUNTS = (2, 3, 4, 5)
GROWTH_SAMPLE_STRIDES = (20, 10, 5, 2, 1)
"""Strides in the 101 samples of a shape, of which a frame's program evaluates every so many."""
REPEATS = 3
"""Number of measurements of which the least counts."""


@dataclass(frozen=True)
class Growth:
    """Growth of one kind of work: sizes (n,), least times seconds (n,), and the exponent p of the fit c size^p.

    what: the kind of work, in words. error: standard error of the exponent.
    """

    what: str
    sizes: Array
    seconds: Array
    exponent: float
    error: float


def fit_growth(what: str, sizes: Sequence[float], seconds: Sequence[float]) -> Growth:
    """Fit the exponent of `what` to times `seconds` (n,) at `sizes` (n,), by least squares of logarithms."""
    x = np.log(sizes)
    y = np.log(seconds)
    basis = np.column_stack([np.ones(len(x)), x])
    (constant, exponent), *_ = np.linalg.lstsq(basis, y, rcond=None)
    rest = y - constant - exponent * x
    # Standard error of a regression's slope: sqrt(sum r^2 / (n - 2) / sum (x - mean x)^2).
    spread = float(np.sqrt((rest**2).sum() / max(len(x) - 2, 1) / ((x - x.mean()) ** 2).sum()))
    return Growth(what, np.array(sizes, float), np.array(seconds, float), float(exponent), spread)


def _frame_seconds(robot: Robot, stride: int) -> float:
    """Return the seconds of a frame's first derivatives; `stride` is that of the samples along the robot."""
    terms = ShapeDistance(stride=stride), Order(robot.carriage_gap)
    nlp = program("frame", robot.structure, KINEMATIC_MODELS["dominant"], terms)
    frame = Program(nlp, wait=True)
    frame.x[:] = np.clip(np.linspace(0.1, 100, len(frame.x)), robot.lower, robot.upper)
    frame.p[nlp.parameter_slice("tubes")] = robot.numbers.ravel(order="F")
    return min(evaluation_seconds(frame) for _ in range(REPEATS))


def nested_robot(count: int) -> Robot:
    """Return a robot of `count` tubes like the paper's, each inside the one before and longer."""
    tubes = (
        Tube(90.0 + 60 * i, 50.0 + 20 * i, 0.006 + 0.001 * i, 6.0 - 0.9 * i, 5.3 - 0.9 * i) for i in range(count)
    )
    return Robot(tuple(tubes))


def min_thread_seconds(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Return the least processor time, s, that this thread takes for `work`, over a number of `repeats`.

    The least, since other programs and interrupts only ever add to it.
    """
    times = []
    for _ in range(repeats):
        begin = time.thread_time()
        work()
        times.append(time.thread_time() - begin)
    return min(times)


GROWTH_KINDS: Mapping[str, tuple[Sequence[int], Callable[[int], float]]] = {
    "horizon, by frames": (
        GROWTH_FRAME_COUNTS,
        lambda n: min_thread_seconds(
            lambda: solve_horizon(named_problem("cos", n), model="dominant"), 2 if n < 2000 else 1
        ),
    ),
    "frames within a lumen, by frames": (
        GROWTH_LUMEN_FRAME_COUNTS,
        lambda n: min_thread_seconds(
            lambda: solve_per_frame(named_problem("bronchus", n), model="dominant", direction="forward")
        ),
    ),
    "first derivatives of a frame, by tubes": (GROWTH_TUBE_COUNTS, lambda n: _frame_seconds(nested_robot(n), 5)),
    "first derivatives of a frame, by samples": (
        sorted(100 // stride + 1 for stride in GROWTH_SAMPLE_STRIDES),
        lambda n: _frame_seconds(table_i_robot(), 100 // (n - 1)),
    ),
}
"""Kinds of work: sizes, and a function that returns the seconds at a size."""


def measure_growths(
    kinds: Mapping[str, tuple[Sequence[int], Callable[[int], float]]] = GROWTH_KINDS,
) -> Iterator[Growth]:
    """Measure and fit each of `kinds`: name -> (sizes, function from a size to seconds); yields the fits."""
    for what, (sizes, seconds) in kinds.items():
        yield fit_growth(what, sizes, [seconds(size) for size in sizes])


def draw_growths(found: Sequence[Growth], path: Path) -> Path:
    """Draw times over sizes on logarithmic scales, with the fitted powers.

    found: the fits. path: of the picture's file, which is returned. Raises OutputError where it cannot be written.
    """
    import matplotlib
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    from ctr_nlp.view.figures import save
    from ctr_nlp.view.figures.parts.page import STYLE, panels
    from ctr_nlp.view.figures.parts.palette import BLUE, VERMILLION

    with matplotlib.rc_context(STYLE):
        figure, grid = panels([growth.what for growth in found], 2, (3.6, 2.6))
        for axes, growth in zip(grid, found, strict=True):
            # The factor c: a least-squares line passes through the means of both logarithms.
            centre = np.exp(np.log(growth.seconds).mean() - growth.exponent * np.log(growth.sizes).mean())
            axes.loglog(growth.sizes, growth.seconds, color=BLUE, ls="", marker="o", ms=4, label="least time")
            label = f"size to the power of {growth.exponent:.2f} ± {growth.error:.2f}"
            axes.loglog(
                growth.sizes, centre * growth.sizes**growth.exponent, color=VERMILLION, lw=1.2, label=label
            )
            axes.set_xticks(growth.sizes, [f"{size:g}" for size in growth.sizes])
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(EngFormatter("s"))
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_formatter(NullFormatter())
            axes.set_ylabel("time")
            axes.legend()
        return save(figure, path)
