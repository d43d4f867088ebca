"""Clips of several motions in one picture and at one scale, as the paper's Figs. 4, 9 (d) and 10."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ctr_nlp.figures.overlay import draw, key
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array

QUARTERS = (0.25, 0.5, 0.75, 1.0)
"""Parts of a motion at which it is shown."""
WIDTH = 7.2
"""Width of a picture, inches."""
LEFT, RIGHT, BETWEEN, GAP = 0.55, 0.1, 0.5, 0.08
"""Inches beside everything, between groups, and between the clips of a group."""
ABOVE, BELOW, FOOT = 0.5, 0.45, 0.4
"""Inches above and below a row, and for the key."""
SLIM = 34.0
"""Least width of a clip in mm, for its ticks."""
MARGIN = 5.0
"""mm around what is shown."""


@dataclass(frozen=True)
class Group:
    """A plan's clips seen from one side; sideways: the horizontal axis, 0 for x and 1 for y."""

    title: str
    plan: Plan
    sideways: int = 0

    @property
    def frames(self) -> list[int]:
        """The frames that are shown, from 1."""
        return frames_shown(len(self.plan.time))

    def box(self) -> Array:
        """Lowest and highest of the horizontal axis and of z, (2, 2) in mm."""
        index = np.array(self.frames) - 1
        points = np.concatenate([self.plan.target[index], self.plan.shape[index]]).reshape(-1, 3)
        low, high = (f(points[:, [self.sideways, 2]], axis=0) for f in (np.nanmin, np.nanmax))
        missing = max(0.0, SLIM - 2 * MARGIN - (high - low)[0]) / 2
        return np.array([low - MARGIN - [missing, 0.0], high + MARGIN + [missing, 0.0]])


def frames_shown(frames: int) -> list[int]:
    """The frames that are shown of so many, from 1."""
    return sorted({max(1, round(part * frames)) for part in QUARTERS})


def clips(rows: Sequence[Sequence[Group]], room: float = 0.0) -> Figure:
    """A picture with rows of groups of clips, all to one scale, and a key; z points up.

    room: inches left free at the bottom, above the key, for what else the caller draws there.
    """
    boxes = [[group.box() for group in row] for row in rows]
    scale = min(_scale(row, at) for row, at in zip(rows, boxes, strict=True))
    heights = [scale * max(np.diff(box, axis=0)[0, 1] for box in at) for at in boxes]
    height = FOOT + room + sum(heights) + len(rows) * (ABOVE + BELOW)
    figure = Figure(figsize=(WIDTH, height))
    top = height
    for row, at, tall in zip(rows, boxes, heights, strict=True):
        left, top = LEFT, top - ABOVE - tall
        for group, box in zip(row, at, strict=True):
            figure.text((left - 0.35) / WIDTH, (top + tall + 0.24) / height, f"{group.title}, frame", fontsize=9)
            left = _place(figure, group, box, scale, (left, top)) + BETWEEN
        top -= BELOW
    figure.legend(handles=key(rows[0][0].plan.robot.d), loc="lower center", ncols=8)
    return figure


def _scale(row: Sequence[Group], boxes: Sequence[Array]) -> float:
    """Inches a mm at which a row takes the picture's width, up to that of the paper's figures."""
    gaps = LEFT + RIGHT + BETWEEN * (len(row) - 1) + GAP * sum(len(group.frames) - 1 for group in row)
    widths = [np.diff(box, axis=0)[0, 0] * len(group.frames) for group, box in zip(row, boxes, strict=True)]
    return float(min((WIDTH - gaps) / sum(widths), 2.2 / 150.0))


def _place(figure: Figure, group: Group, box: Array, scale: float, corner: tuple[float, float]) -> float:
    """Draw a group with its lower left corner, inches, at corner; returns where its right edge is."""
    (x, y), (wide, high) = corner, scale * np.diff(box, axis=0)[0]
    across, up = figure.get_size_inches()
    for k, frame in enumerate(group.frames):
        axes = figure.add_axes((x / across, y / up, wide / across, high / up))
        draw(axes, group.plan, frame - 1, group.sideways)
        axes.set_xlim(*box[:, 0])
        axes.set_ylim(*box[:, 1])
        axes.locator_params(axis="x", nbins=2)
        axes.set_title(str(frame), fontsize=8)
        if k:
            axes.tick_params(labelleft=False)
        else:
            axes.set_ylabel("z (mm)", labelpad=1)
        x += wide + GAP
    middle = (corner[0] + x - GAP) / 2
    figure.text(middle / across, (y - 0.35) / up, f"{'xy'[group.sideways]} (mm)", ha="center", fontsize=9)
    return float(x - GAP)
