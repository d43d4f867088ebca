"""Make films of plans: moving robots side by side and in step, above their errors."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ctr_nlp.exceptions import OptionError, OutputError
from ctr_nlp.plan import metrics, summary_text
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.atomic_write import write_atomically
from ctr_nlp.view.figures.errors import CURVES
from ctr_nlp.view.figures.overlay import TARGET_LINE_STYLE
from ctr_nlp.view.figures.parts.orientation import picture_axes
from ctr_nlp.view.figures.parts.page import STYLE, TITLE_MARGIN_IN, by_frames, curve, legend_of, outcome, wrap_line
from ctr_nlp.view.figures.parts.palette import BLACK
from ctr_nlp.view.figures.parts.space import (
    RobotLines,
    add_space_axes,
    add_wall_sections,
    fit_box,
    key,
    points_of_all,
    span,
)
from ctr_nlp.view.figures.parts.wall_forces import WALL_FORCE_COLOUR, wall_force_lines

WRITERS: dict[str, Any] = {".gif": PillowWriter, ".mp4": FFMpegWriter}
"""Class that writes a film, by the suffix of its file."""
FILM_COLUMN_WIDTH_IN, FILM_HEIGHT_IN, FILM_DPI = 4.8, 7.2, 100
"""Size of a plan's column, inches; whole and even numbers of pixels, as H.264 needs them."""
FILM_FONT_SIZE = STYLE["font.size"]
"""Size of a film's words, points."""
FILM_LINE_HEIGHT = 1.25 * FILM_FONT_SIZE / 72 / FILM_HEIGHT_IN
"""Distance of lines as a part of the height."""
FILM_FORCE_LINE_WIDTH = 1.2
"""Width of the lines of a wall's forces, points."""
FILM_TITLE_TOP, FILM_SPACE_BOTTOM = 0.985, 0.31
"""Top of the title, and bottom of the robots, as parts of the height."""
MIN_FILM_DURATION_S, MAX_FILM_DURATION_S = 2.0, 60.0
"""Bounds of a film's duration, however short or long its plans are."""
MAX_FILM_PICTURES_PER_S, MAX_FILM_PICTURES = 25, 300
"""Most pictures a second, and in all."""


def check_film(path: str | Path) -> None:
    """Raise OptionError where no film can be written to `path`: its suffix is unknown, or ffmpeg is missing."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise OptionError(f"film is {str(path)!r}; its suffix must be {' or '.join(WRITERS)}")
    if not WRITERS[suffix].isAvailable():
        raise OptionError(
            f"film is {str(path)!r} and ffmpeg is missing; install it, or name a .gif, which needs none"
        )


@matplotlib.rc_context(STYLE | {"animation.codec": "h264"})
def film(
    plans: Sequence[Plan], path: str | Path, progress: Callable[[int, int, str], None] = lambda *_: None
) -> Path:
    """Write a film of plans side by side, with tubes, targets, walls where known, and errors; return its path.

    plans: the plans, at least one. path: the film's file; an existing one is replaced. progress: called as
    progress(done, total, note) after each picture.

    It lasts as long as the longest plan, within 2 to 60 s. Plans with other numbers of frames or durations play in
    step: at every moment each is at the same part of its own. A frame that was never reached shows its target
    alone. Raises OptionError as check_film, and without plans; OutputError where the film cannot be written.
    """
    check_film(path)
    if not plans:
        raise OptionError("plans is empty; a film needs at least one")
    target = Path(path)
    seconds = float(np.clip(max(plan.time[-1] for plan in plans), MIN_FILM_DURATION_S, MAX_FILM_DURATION_S))
    count = min(max(len(plan.time) for plan in plans), round(seconds * MAX_FILM_PICTURES_PER_S), MAX_FILM_PICTURES)
    figure, columns = _stage(plans)
    writer = WRITERS[target.suffix.lower()](fps=count / seconds)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(target) as partial, writer.saving(figure, str(partial), FILM_DPI):
            for k in range(1, count + 1):
                for column in columns:
                    column.show(k / count)
                writer.grab_frame()
                progress(k, count, "pictures of the film")
    except (OSError, subprocess.CalledProcessError) as error:
        raise OutputError(f"film {target} cannot be written: {error}") from error
    return target


def _stage(plans: Sequence[Plan]) -> tuple[Figure, list[_Column]]:
    """Return the figure before anything moves, with one scale for the shapes and one for the errors of all
    plans.
    """
    figure = Figure(figsize=(FILM_COLUMN_WIDTH_IN * len(plans), FILM_HEIGHT_IN), dpi=FILM_DPI)
    shown = [points_of_all([plan.shape, plan.target], plan.lumen_wall) for plan in plans]
    side = np.max([span(points) for points in shown], axis=0)
    titles = [_title(plan) for plan in plans]
    top = FILM_TITLE_TOP - FILM_LINE_HEIGHT * max(title.count("\n") + 1 for title in titles)
    upright = picture_axes(plans)
    columns = [
        _Column(figure, (k / len(plans), 1 / len(plans), top), plan, title)
        for k, (plan, title) in enumerate(zip(plans, titles, strict=True))
    ]
    for column, points in zip(columns, shown, strict=True):
        fit_box(column.space, points, side, upright)
    highest = max(column.errors.get_ylim()[1] for column in columns)
    for column in columns:
        column.errors.set_ylim(0.0, highest)
    handles = key(max(plan.robot.d for plan in plans), any(plan.wall is not None for plan in plans))
    if any(plan.wall_force is not None for plan in plans):
        handles.append(Line2D([], [], label="wall's force", color=WALL_FORCE_COLOUR, lw=FILM_FORCE_LINE_WIDTH))
    curves = legend_of(*(column.errors for column in columns))
    figure.legend(handles=[*handles, *curves.values()], loc="lower center", ncols=4 * len(plans))
    return figure, columns


def _title(plan: Plan) -> str:
    """Return the lines above the column of a plan: what it is, and how good."""
    numbers = metrics.summary(plan)
    width = FILM_COLUMN_WIDTH_IN - 2 * TITLE_MARGIN_IN
    lines = summary_text.title(numbers), outcome(numbers)
    return "\n".join(wrap_line(line, width, FILM_FONT_SIZE) for line in lines)


class _Column:
    """A plan's column of a film: its robot above, its errors below.

    place: left side, width and lower end of the title, as parts of the figure.
    """

    def __init__(self, figure: Figure, place: tuple[float, float, float], plan: Plan, title: str) -> None:
        self._plan = plan
        left, width, top = place
        below = top - FILM_LINE_HEIGHT
        space = add_space_axes(
            figure, (left, FILM_SPACE_BOTTOM, width, below - FILM_SPACE_BOTTOM), plan.lumen_wall
        )
        self.space = space
        add_wall_sections(space, plan.drawn_walls, plan.target[-1])
        self._target = space.plot([], [], [], zorder=5, **TARGET_LINE_STYLE)[0]
        self._body = RobotLines(space, plan.robot.d)
        self._forces = None if plan.wall_force is None else wall_force_lines(plan)
        self._pressing = space.plot([], [], [], color=WALL_FORCE_COLOUR, lw=FILM_FORCE_LINE_WIDTH, zorder=5)[0]
        figure.text(left + width / 2, FILM_TITLE_TOP, title, ha="center", va="top", parse_math=False)
        self._now = figure.text(left + width / 2, below, "", ha="center", va="bottom")
        self.errors = figure.add_axes((left + 0.13 * width, 0.125, 0.82 * width, 0.125))
        distance = metrics.e1(plan)
        frames = by_frames(self.errors, plan)
        curve(self.errors, frames, distance.max(axis=1), **CURVES["max"])
        curve(self.errors, frames, metrics.rms_over_sigma(distance), **CURVES["e2"])
        self.errors.set_ylabel("distance (mm)")
        self._cursor = self.errors.axvline(0.0, color=BLACK, lw=1.0)

    def show(self, part: float) -> None:
        """Show the frame at a part of the motion, in (0, 1]."""
        plan = self._plan
        # part may be k / T plus rounding, which must not show the frame after k.
        j = int(np.ceil(part * len(plan.time) - 1e-9)) - 1
        state = "" if plan.success[j] else ", failed" if plan.reached_frames[j] else ", not reached"
        self._body.show(plan.shape[j], plan.beta[j])
        self._target.set_data_3d(*plan.target[j].T)
        if self._forces is not None:
            # One line with gaps of NaN instead of an artist for each.
            gaps = np.full((self._forces.shape[1], 1, 3), np.nan)
            self._pressing.set_data_3d(*np.concatenate([self._forces[j], gaps], axis=1).reshape(-1, 3).T)
        self._now.set_text(f"frame {j + 1} of {len(plan.time)}, {plan.time[j]:.2f} s{state}")
        self._cursor.set_xdata([j + 1, j + 1])
