"""Clips (single frames) of several motions in one figure at one scale, as the paper's Figs. 4, 9 (d) and 10."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.overlay import draw, key

CLIP_MOTION_FRACTIONS = (0.25, 0.5, 0.75, 1.0)
"""Fractions of a motion at which it is shown."""
CLIPS_WIDTH_INCH = 7.2
"""Width of a picture, inches."""
CLIPS_LEFT_MARGIN_INCH, CLIPS_RIGHT_MARGIN_INCH, CLIP_GROUP_SPACING_INCH, CLIP_SPACING_INCH = 0.55, 0.1, 0.5, 0.08
"""Margins of the figure, and spaces between groups and between the clips of a group, inches."""
CLIP_ROW_TOP_INCH, CLIP_ROW_BOTTOM_INCH, CLIPS_KEY_HEIGHT_INCH = 0.5, 0.45, 0.4
"""Space above and below a row, and height of the key, inches."""
MIN_CLIP_WIDTH_MM = 34.0
"""Least width of a clip, mm, so that its tick labels fit."""
CLIP_MARGIN_MM = 5.0
"""Margin around robot and target, mm."""


@dataclass(frozen=True)
class ClipGroup:
    """Clips of one plan seen from one side; sideways: the horizontal axis, 0 for x and 1 for y."""

    title: str
    plan: Plan
    sideways: int = 0

    @property
    def frames(self) -> list[int]:
        """Numbers of the frames that are shown, from 1."""
        return clip_frames(len(self.plan.time))

    def box(self) -> Array:
        """Return the lower and upper limits (2, 2), mm, of the horizontal axis and of z that all clips share."""
        index = np.array(self.frames) - 1
        points = np.concatenate([self.plan.target[index], self.plan.shape[index]]).reshape(-1, 3)
        low, high = (f(points[:, [self.sideways, 2]], axis=0) for f in (np.nanmin, np.nanmax))
        missing = max(0.0, MIN_CLIP_WIDTH_MM - 2 * CLIP_MARGIN_MM - (high - low)[0]) / 2
        return np.array([low - CLIP_MARGIN_MM - [missing, 0.0], high + CLIP_MARGIN_MM + [missing, 0.0]])


def clip_frames(frames: int) -> list[int]:
    """Return the numbers, from 1, of the frames that are shown of a motion of so many frames."""
    return sorted({max(1, round(part * frames)) for part in CLIP_MOTION_FRACTIONS})


def draw_clips(rows: Sequence[Sequence[ClipGroup]], room: float = 0.0) -> Figure:
    """Draw rows of groups of clips, all at one scale, with a key; z points up.

    room: height left free above the key, inches, for what else the caller draws.
    """
    boxes = [[group.box() for group in row] for row in rows]
    # Inches per mm of the row that needs most space, for all rows: lengths can be compared across the figure.
    scale = min(_scale(row, at) for row, at in zip(rows, boxes, strict=True))
    heights = [scale * max(np.diff(box, axis=0)[0, 1] for box in at) for at in boxes]
    height = CLIPS_KEY_HEIGHT_INCH + room + sum(heights) + len(rows) * (CLIP_ROW_TOP_INCH + CLIP_ROW_BOTTOM_INCH)
    figure = Figure(figsize=(CLIPS_WIDTH_INCH, height))
    top = height
    for row, at, tall in zip(rows, boxes, heights, strict=True):
        left = CLIPS_LEFT_MARGIN_INCH
        top = top - CLIP_ROW_TOP_INCH - tall
        for group, box in zip(row, at, strict=True):
            figure.text(
                (left - 0.35) / CLIPS_WIDTH_INCH, (top + tall + 0.24) / height, f"{group.title}, frame", fontsize=9
            )
            left = _draw_group(figure, group, box, scale, (left, top)) + CLIP_GROUP_SPACING_INCH
        top -= CLIP_ROW_BOTTOM_INCH
    figure.legend(handles=key(rows[0][0].plan.robot.d), loc="lower center", ncols=8)
    return figure


def _scale(row: Sequence[ClipGroup], boxes: Sequence[Array]) -> float:
    """Return the scale, inches per mm, at which a row fills the width; at most that of the paper's figures."""
    gaps = (
        CLIPS_LEFT_MARGIN_INCH
        + CLIPS_RIGHT_MARGIN_INCH
        + CLIP_GROUP_SPACING_INCH * (len(row) - 1)
        + CLIP_SPACING_INCH * sum(len(group.frames) - 1 for group in row)
    )
    widths = [np.diff(box, axis=0)[0, 0] * len(group.frames) for group, box in zip(row, boxes, strict=True)]
    return float(min((CLIPS_WIDTH_INCH - gaps) / sum(widths), 2.2 / 150.0))


def _draw_group(figure: Figure, group: ClipGroup, box: Array, scale: float, corner: tuple[float, float]) -> float:
    """Draw a group with its lower left corner at `corner`, inches; returns the position of its right edge, inches.

    box: limits (2, 2) of the axes, mm. scale: inches per mm.
    """
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
        x += wide + CLIP_SPACING_INCH
    middle = (corner[0] + x - CLIP_SPACING_INCH) / 2
    figure.text(middle / across, (y - 0.35) / up, f"{'xy'[group.sideways]} (mm)", ha="center", fontsize=9)
    return float(x - CLIP_SPACING_INCH)
