"""How well a device kept to its commands: position errors of its axes at the times of frames, and lateness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy.typing as npt
from matplotlib.figure import Figure

from ctr_nlp.figures.parts.page import STYLE, at_least, frame_axis, printable
from ctr_nlp.figures.parts.palette import tube_colour, tube_width


@matplotlib.rc_context(STYLE)
def tracking(
    title: str, frame: npt.NDArray[Any], error: npt.NDArray[Any], late: npt.NDArray[Any], names: Sequence[str]
) -> Figure:
    """Errors of sliding axes (mm), of turning ones, and lateness (ms) over frames (T,).

    error: (T, m), measured less commanded. late: (T,) s. names: (m,), of the axes, each with its unit, "X (mm)".
    """
    figure = Figure(figsize=(6.4, 6.2), layout="constrained")
    rows = figure.subplots(3, 1, sharex=True)
    slides = [k for k, name in enumerate(names) if name.endswith("(mm)")]
    turns = [k for k in range(len(names)) if k not in slides]
    for axes, some in ((rows[0], slides), (rows[1], turns)):
        units = dict.fromkeys(names[k].rpartition("(")[2].rstrip(")") for k in some)
        axes.set_ylabel(f"error when due ({', '.join(units)})")
        axes.axhline(0.0, color="0.6", lw=0.9)
        for i, k in enumerate(some):
            axes.plot(frame, error[:, k], color=tube_colour(i), lw=tube_width(i, len(some)), label=names[k])
        at_least(axes, 0.02)
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    rows[2].plot(frame, 1e3 * late, color="0.2", lw=1.2)
    at_least(rows[2], 20.0)
    rows[2].set_ylabel("late (ms)")
    frame_axis(rows[2], int(frame[-1]))
    figure.suptitle(printable(title), fontsize=10, parse_math=False)
    return figure
