"""Error against roughness: the Pareto front of horizons, and other methods' points beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp.figures import save
from ctr_nlp.figures.parts.page import STYLE, printable
from ctr_nlp.figures.parts.palette import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.models import suits
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.steer import Horizon
from ctr_nlp.steer.passes import Progress
from ctr_nlp.studies.comparison import parse_variant
from ctr_nlp.support.interrupt import deferred_interrupt

WEIGHTS = tuple(10.0 ** (k / 2 - 8) for k in range(13))
"""Default lambdas of a sweep, s^2."""
BESIDE = ("joint:ipopt", "two-stage:ipopt", "paper-two-stage", "euclidean")
"""The variants whose points stand beside the front."""


@dataclass(frozen=True)
class Point:
    """A plan in the plane of error and roughness. motion_weight: s^2; e3: mm; roughness: mm^2/s.

    solved: every frame was.
    """

    method: str
    motion_weight: float
    e3: float
    roughness: float
    solved: bool


def trade_off(
    horizon: Horizon,
    plan: Plan,
    weights: Sequence[float],
    settings: Settings,
    labelled: Callable[[str], Progress],
) -> list[Point]:
    """The front over weights, of which each horizon starts from its neighbours', and the points beside it.

    plan: any motion of the horizon, to start from. Methods whose model does not describe the robot are left out.
    Ctrl-C, held back by the caller, leaves what was found. Raises OptionError.
    """
    with deferred_interrupt() as interrupted:
        plans = sweep(horizon, plan, weights, labelled)
        points = [_point("horizon", found) for found in plans]
        for name in BESIDE:
            if interrupted():
                break
            variant = parse_variant(name)
            label = f"{horizon.problem.name}, {name}"
            if suits(horizon.problem.robot, variant.model):
                points.append(_point(name, variant.plan(horizon.problem, settings, (), labelled(label))))
    return points


def sweep(
    horizon: Horizon, plan: Plan, weights: Sequence[float], labelled: Callable[[str], Progress]
) -> list[Plan]:
    """A plan for every weight, in ascending order: the better of one started from below and one from above."""
    ascending = sorted(set(weights))
    best: dict[float, Plan] = {}
    with deferred_interrupt() as interrupted:
        for order in (ascending, ascending[::-1]):
            motion = plan.q
            for weight in order:
                found = horizon.solve(
                    [motion], weight, progress=labelled(f"{horizon.problem.name}, λ = {weight:.1e} s²")
                )
                if interrupted():
                    return [best[weight] for weight in ascending if weight in best]
                motion = found.q
                if weight not in best or _badness(found) < _badness(best[weight]):
                    best[weight] = found
    return [best[weight] for weight in ascending]


def _badness(plan: Plan) -> tuple[bool, float]:
    return not plan.complete, float(plan.objective.mean())


def _point(method: str, plan: Plan) -> Point:
    found: dict[str, Any] = summary(plan)
    return Point(method, found["weights"]["motion_s2"], found["e3"], found["roughness"], plan.complete)


MARKERS = (("s", VERMILLION), ("D", ORANGE), ("^", GREEN), ("v", PURPLE), ("P", SKY), ("X", BLACK))

LABELLED = "235"
"""Leading digits of ticks between powers of ten that carry a number."""


@matplotlib.rc_context(STYLE)
def pareto(points: Sequence[Point], problem: str) -> Figure:
    """e3 in mm over roughness in mm^2/s, for a problem of that name; weights stand at the ends of the front."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    front = sorted((p for p in points if p.method == "horizon" and p.solved), key=lambda p: p.roughness)
    look: dict[str, Any] = {"color": BLUE, "lw": 1.8, "marker": "o", "ms": 4}
    axes.plot([p.roughness for p in front], [p.e3 for p in front], label="horizon, by weight λ", **look)
    for point, offset in zip(front[:1] + front[1:][-1:], ((6, 4), (-30, -14)), strict=False):
        place: dict[str, Any] = {"xytext": offset, "textcoords": "offset points", "fontsize": 8}
        axes.annotate(f"λ = {point.motion_weight:.1g} s²", (point.roughness, point.e3), **place)
    others = [p for p in points if p.method != "horizon"]
    for point, (marker, colour) in zip(others, MARKERS, strict=False):
        label = point.method + ("" if point.solved else ", not all solved")
        axes.plot(point.roughness, point.e3, marker=marker, color=colour, mec=BLACK, ms=8, ls="", label=label)
    _scales(axes)
    axes.margins(0.1)
    figure.suptitle(printable(f"Error against roughness: {problem}"), fontsize=10, parse_math=False)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def save_front(points: Sequence[Point], problem: str, folder: str | Path) -> Path:
    """Write pareto.png into a folder that exists; raises OutputError where it cannot be written."""
    return save(pareto(points, problem), Path(folder) / "pareto.png")


def _scales(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:.0e}"[0] in LABELLED else "")
    axes.grid(which="minor", lw=0.3)
    axes.set_xlabel("roughness (mm²/s)")
    axes.set_ylabel("e3 (mm)")
