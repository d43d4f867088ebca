"""Figure of error against roughness; in a file of its own, since the numbers need no matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp.studies.pareto_front import ParetoPoint
from ctr_nlp.view.figures import save
from ctr_nlp.view.figures.parts.page import STYLE, add_title
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION

PARETO_METHOD_MARKERS = (("s", VERMILLION), ("D", ORANGE), ("^", GREEN), ("v", PURPLE), ("P", SKY), ("X", BLACK))

PARETO_TICK_DIGITS = "235"
"""Leading digits of the ticks between powers of ten that are labelled."""


@matplotlib.rc_context(STYLE)
def draw_pareto_front(points: Sequence[ParetoPoint], problem: str) -> Figure:
    """Draw e3, mm, over roughness, mm^2/s; points: of all methods; problem: its name, for the title."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    front = sorted((p for p in points if p.method == "horizon" and p.solved), key=lambda p: p.roughness)
    look: dict[str, Any] = {"color": BLUE, "lw": 1.8, "marker": "o", "ms": 4}
    axes.plot([p.roughness for p in front], [p.e3 for p in front], label="horizon, by weight λ", **look)
    for point, offset in zip(front[:1] + front[1:][-1:], ((6, 4), (-30, -14)), strict=False):
        place: dict[str, Any] = {"xytext": offset, "textcoords": "offset points", "fontsize": 8}
        axes.annotate(f"λ = {point.motion_weight:.1g} s²", (point.roughness, point.e3), **place)
    others = [p for p in points if p.method != "horizon"]
    for point, (marker, colour) in zip(others, PARETO_METHOD_MARKERS, strict=False):
        label = point.method + ("" if point.solved else ", not all solved")
        axes.plot(point.roughness, point.e3, marker=marker, color=colour, mec=BLACK, ms=8, ls="", label=label)
    _scales(axes)
    axes.margins(0.1)
    add_title(figure, f"Error against roughness: {problem}")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def save_pareto_front(points: Sequence[ParetoPoint], problem: str, folder: str | Path) -> Path:
    """Write pareto.png, the figure of `points` of a problem of that name, into an existing folder.

    Raises OutputError where it cannot be written.
    """
    return save(draw_pareto_front(points, problem), Path(folder) / "pareto.png")


def _scales(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:.0e}"[0] in PARETO_TICK_DIGITS else "")
    axes.grid(which="minor", lw=0.3)
    axes.set_xlabel("roughness (mm²/s)")
    axes.set_ylabel("e3 (mm)")
