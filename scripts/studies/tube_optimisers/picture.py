"""Figure of the best tubes over time; in a file of its own, since the numbers need no matplotlib."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib import rc_context
from matplotlib.figure import Figure

from ctr_nlp.view.figures.parts.page import STYLE, plain_ticks, printable
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, VERMILLION
from tube_optimisers.race import DESIGN_OPTIMISERS, OptimiserRun

OPTIMISER_COLOURS = dict(zip(DESIGN_OPTIMISERS, (VERMILLION, BLUE, BLACK), strict=True))


@rc_context(STYLE)
def draw_optimiser_race(runs: Sequence[OptimiserRun], names: Sequence[str]) -> Figure:
    """Draw the least error so far over process time, one line for each of `runs`; `names`: of the problems."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    last = max((run.seconds[-1] for run in runs if len(run.seconds)), default=1.0)
    for run in runs:
        if len(run.seconds):
            seconds = [*run.seconds, last]
            e3 = [*run.e3, run.best]
            label = f"{run.method}, {run.evaluations} tubes tried"
            axes.plot(seconds, e3, drawstyle="steps-post", color=OPTIMISER_COLOURS[run.method], label=label)
            axes.plot(run.seconds, run.e3, "o", ms=3, color=OPTIMISER_COLOURS[run.method])
    axes.set_yscale("log")
    plain_ticks(axes.yaxis)
    axes.set_xlabel("process time (s)")
    axes.set_ylabel("best root mean square of e3 (mm)")
    axes.legend()
    title = f"One robot for {', '.join(names)}"
    figure.suptitle(printable(title), fontsize=10, parse_math=False)
    return figure
