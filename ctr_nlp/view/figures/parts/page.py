"""Parts that figures share: style, heading, marks behind frames, panels with letters, a square-root scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from string import ascii_lowercase
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from ctr_nlp.exceptions import escape_control_characters
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.summary_text import describe_unmet_verdicts
from ctr_nlp.typing import Flags
from ctr_nlp.view.figures.parts.palette import FAILED_FRAME_COLOUR, UNREACHED_FRAME_COLOUR

STYLE: Any = {
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.titlesize": 9,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "text.usetex": False,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}
"""Settings with which every figure is drawn, whatever the caller's own are."""


AT_FRAME, BETWEEN_FRAMES = "at the frame", "on the way to it"
"""Names of two lines: values of the frames, and the least ones of the sub-steps from the frame before."""


TITLE_FONT_SIZE, TITLE_MARGIN_IN = 10.0, 0.1
"""Size of a figure's title, points, and the least distance of its lines from the sides, inches."""
TITLE_LINE_HEIGHT_IN = 1.2 * TITLE_FONT_SIZE / 72
"""Distance of a title's lines, inches."""


def add_heading(figure: Figure, plan: Plan, title: str) -> None:
    """Add a heading to `figure`: title, problem, how `plan` was solved, and its error over all frames."""
    numbers = summary(plan)
    on = (
        numbers["model"]
        if numbers["evaluated"] == numbers["model"]
        else f"{numbers['evaluated']} instead of {numbers['model']}"
    )
    on += " model" + ("" if numbers["load"] is None else f" under {numbers['load']}")
    how = f"{numbers['formulation']}, {on}, {numbers['solver']}; {outcome(numbers)}"
    add_title(figure, f"{title}: {numbers['problem']}", how)


def add_title(figure: Figure, *lines: str, fontsize: float = TITLE_FONT_SIZE) -> None:
    """Add a title of lines to a figure; those that are wider than it are wrapped."""
    width = figure.get_figwidth() - 2 * TITLE_MARGIN_IN
    text = "\n".join(wrap_line(line, width, fontsize) for line in lines)
    figure.suptitle(text, fontsize=fontsize, parse_math=False)


def wrap_line(line: str, width: float, fontsize: float) -> str:
    """Break a line between words so that none is wider than `width`, inches, in a font of some points."""
    font = get_font(findfont(FontProperties()))
    font.set_size(fontsize, 72)
    wrapped = [""]
    for word in printable(line).split(" "):
        longer = f"{wrapped[-1]} {word}" if wrapped[-1] else word
        font.set_text(longer)
        # FreeType has 64 units in a pixel, and there are 72 pixels in an inch at 72 dots an inch.
        if wrapped[-1] and font.get_width_height()[0] / 64 / 72 > width:
            wrapped.append(word)
        else:
            wrapped[-1] = longer
    return "\n".join(wrapped)


def outcome(numbers: Mapping[str, Any]) -> str:
    """Say the error over all frames, how many failed, and which verdicts are no; numbers: a plan's summary."""
    e3 = "no frame reached" if numbers["e3"] is None else f"e3 = {numbers['e3']:.3g} mm"
    frames = f"{numbers['failed']} of {numbers['frames']} frames failed" if numbers["failed"] else ""
    return ", ".join(filter(None, (e3, frames, describe_unmet_verdicts(numbers))))


def printable(text: str) -> str:
    """Return `text` as one line with "?" for characters that the font lacks: a file, and so a problem, may have
    any name.

    Draw it with parse_math=False; where matplotlib offers none, as in legends, draw :func:`label_text`.
    """
    font = get_font(findfont(FontProperties()))
    return "".join(c if font.get_char_index(ord(c)) else "?" for c in escape_control_characters(text))


def label_text(text: str) -> str:
    """Return `text` for a legend, where matplotlib would read what stands between dollar signs as mathematics."""
    return printable(text).replace("$", r"\$")


def shade(axes: Axes, centres: npt.NDArray[Any], width: float, mask: Flags, colour: str, label: str) -> None:
    """Colour the background of some frames.

    axes: the panel. centres (T,), width: positions and width of frames on the horizontal axis. mask (T,): frames
    to shade. colour: of matplotlib. label: for the legend.
    """
    for number, centre in enumerate(centres[mask]):
        name = "_" if number else label
        axes.axvspan(centre - width / 2, centre + width / 2, color=colour, lw=0, zorder=0, label=name)


def shade_failures(axes: Axes, plan: Plan, centres: npt.NDArray[Any], width: float) -> None:
    """Shade the frames of a plan that were not solved, lighter where there is no shape at all.

    axes: the panel. plan: the plan. centres (T,), width: positions and width of frames on the horizontal axis.
    """
    shade(axes, centres, width, ~plan.success & plan.reached_frames, FAILED_FRAME_COLOUR, "failed frame")
    shade(axes, centres, width, ~plan.reached_frames, UNREACHED_FRAME_COLOUR, "not reached")


def curve(axes: Axes, x: npt.NDArray[Any], y: npt.NDArray[np.float64], **look: Any) -> None:
    """Plot y (n,) over x (n,) on `axes`, with a dot for each value that no line would show; look: style, with
    `color`.
    """
    axes.plot(x, y, **look)
    single = isolated_indices(y)
    axes.plot(x[single], y[single], color=look["color"], ls="", marker="o", ms=3)


def isolated_indices(y: npt.NDArray[np.float64]) -> npt.NDArray[np.int_]:
    """Return the indices of known values of y (n,) between two unknown ones."""
    known = np.isfinite(np.concatenate([[np.nan], y, [np.nan]]))
    return np.flatnonzero(known[1:-1] & ~known[:-2] & ~known[2:])


def by_frames(axes: Axes, plan: Plan) -> npt.NDArray[np.int_]:
    """Make the horizontal axis of `axes` one of a plan's frames, shade failed ones, and return their numbers (T,),
    from 1.
    """
    frames = np.arange(1, len(plan.time) + 1)
    shade_failures(axes, plan, frames, 1.0)
    frame_axis(axes, len(frames))
    return frames


def legend_of(*panels: Axes) -> dict[str, Any]:
    """Return the entries of one legend for several panels: handles by label, each label once."""
    named = [axes.get_legend_handles_labels() for axes in panels]
    return {label: handle for some, labels in named for handle, label in zip(some, labels, strict=True)}


def frame_axis(axes: Axes, frames: int) -> None:
    """Number frames from 1 to `frames` along the horizontal axis of `axes`."""
    axes.set_xlim(0.5, max(frames, 1) + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.set_xlabel("frame")


def at_least(axes: Axes, span: float) -> None:
    """Widen the vertical range of `axes` to `span`, in its unit, so that rounding noise does not fill the
    picture.
    """
    low, high = axes.get_ylim()
    if high - low < span:
        middle = (low + high) / 2
        axes.set_ylim(middle - span / 2, middle + span / 2)


ROOT_SCALE_TICKS = tuple(digit * 10.0**power for power in range(-6, 4) for digit in (1, 2, 5))
MIN_ROOT_TICK_DISTANCE = 0.13
"""Least distance of two ticks, as a part of the axis."""


def panels(titles: Sequence[str], columns: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    """Make a figure with a panel for each of `titles`, lettered (a), (b), ... in reading order; return it and the
    panels.

    columns: panels in a row. size: width and height of a panel, inches.
    """
    rows = -(-len(titles) // columns)
    figure = Figure(figsize=(columns * size[0], rows * size[1]), layout="constrained")
    grid: npt.NDArray[Any] = figure.subplots(rows, columns, squeeze=False)
    for letter, title, axes in zip(ascii_lowercase, titles, grid.flat, strict=False):
        axes.set_title(printable(f"({letter}) {title}"), loc="left", parse_math=False)
    for spare in grid.flat[len(titles) :]:
        spare.remove()
    return figure, list(grid.flat[: len(titles)])


def root_scale(axes: Axes) -> None:
    """Give `axes` a square-root scale from 0 upwards: small errors are seen beside large ones, and 0 has its
    place.
    """
    top = max(axes.get_ylim()[1], 2 * ROOT_SCALE_TICKS[0])
    axes.set_yscale("function", functions=(lambda y: np.sqrt(np.maximum(y, 0.0)), np.square))
    axes.set_ylim(0.0, top)
    chosen: list[float] = []
    for tick in sorted((tick for tick in ROOT_SCALE_TICKS if tick <= top), reverse=True):
        height = np.sqrt(tick / top)
        if height >= MIN_ROOT_TICK_DISTANCE and (
            not chosen or np.sqrt(chosen[-1] / top) - height >= MIN_ROOT_TICK_DISTANCE
        ):
            chosen.append(tick)
    axes.set_yticks([0.0, *chosen])
    axes.yaxis.set_major_formatter("{x:g}")


def plain_ticks(axis: Axis) -> None:
    """Label the ticks of a logarithmic axis with plain numbers, a few in every decade."""
    axis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())
