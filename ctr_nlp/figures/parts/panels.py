"""Several panels with letters, as the paper's figures have them, and a scale for errors of different size."""

from __future__ import annotations

from collections.abc import Sequence
from string import ascii_lowercase
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

TICKS = tuple(digit * 10.0**power for power in range(-6, 4) for digit in (1, 2, 5))
APART = 0.13
"""Least distance of two ticks, as a part of the axis."""


def panels(titles: Sequence[str], columns: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for each title, (a), (b), ... in reading order; size: of a panel in inches."""
    rows = -(-len(titles) // columns)
    figure = Figure(figsize=(columns * size[0], rows * size[1]), layout="constrained")
    grid: npt.NDArray[Any] = figure.subplots(rows, columns, squeeze=False)
    for letter, title, axes in zip(ascii_lowercase, titles, grid.flat, strict=False):
        axes.set_title(f"({letter}) {title}", loc="left")
    for spare in grid.flat[len(titles) :]:
        spare.remove()
    return figure, list(grid.flat[: len(titles)])


def root_scale(axes: Axes) -> None:
    """A square-root scale from 0 upwards: small errors are seen beside large ones, and 0 has its place."""
    top = max(axes.get_ylim()[1], 2 * TICKS[0])
    axes.set_yscale("function", functions=(lambda y: np.sqrt(np.maximum(y, 0.0)), np.square))
    axes.set_ylim(0.0, top)
    chosen: list[float] = []
    for tick in sorted((tick for tick in TICKS if tick <= top), reverse=True):
        height = np.sqrt(tick / top)
        if height >= APART and (not chosen or np.sqrt(chosen[-1] / top) - height >= APART):
            chosen.append(tick)
    axes.set_yticks([0.0, *chosen])
    axes.yaxis.set_major_formatter("{x:g}")
