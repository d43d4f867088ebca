"""Error against roughness: the front of horizons, and other methods beside it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from ctr_nlp.figures.page import STYLE
from ctr_nlp.figures.palette import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from ctr_nlp.trade_off import Point

MARKERS = (("s", VERMILLION), ("D", ORANGE), ("^", GREEN), ("v", PURPLE), ("P", SKY), ("X", BLACK))


@matplotlib.rc_context(STYLE)
def pareto(points: Sequence[Point], problem: str) -> Figure:
    """e3 in mm over roughness in mm^2/s; the weights of the horizons are written at the ends of their front."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    front = sorted((p for p in points if p.method == "horizon" and p.solved), key=lambda p: p.roughness)
    look: dict[str, Any] = {"color": BLUE, "lw": 1.8, "marker": "o", "ms": 4}
    axes.plot([p.roughness for p in front], [p.e3 for p in front], label="horizon, by weight λ", **look)
    for point in {id(p): p for p in front[:1] + front[-1:]}.values():
        place = {"xytext": (0, -12), "textcoords": "offset points", "ha": "center", "va": "top", "fontsize": 8}
        axes.annotate(f"λ = {point.motion_weight:.1g} s²", (point.roughness, point.e3), **place)
    others = [p for p in points if p.method != "horizon"]
    for point, (marker, colour) in zip(others, MARKERS, strict=False):
        label = point.method + ("" if point.solved else ", not all solved")
        axes.plot(point.roughness, point.e3, marker=marker, color=colour, mec=BLACK, ms=8, ls="", label=label)
    _scales(axes)
    axes.margins(0.1)
    figure.suptitle(f"Error against roughness: {problem}", fontsize=10, parse_math=False)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def _scales(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(_Few(labelOnlyBase=False, minor_thresholds=(2, 0.5)))
    axes.grid(which="minor", lw=0.3)
    axes.set_xlabel("roughness (mm²/s)")
    axes.set_ylabel("e3 (mm)")


class _Few(LogFormatter):
    """Plain numbers where there is room for them."""

    def _num_to_string(self, x: float, vmin: float, vmax: float) -> str:
        return f"{x:g}"
