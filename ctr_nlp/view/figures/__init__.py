"""Figures of a plan, like Figs. 4, 5, 6 and 8 of the paper, and the files that they are written to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ctr_nlp.exceptions import OutputError
from ctr_nlp.plan.plan import Plan
from ctr_nlp.view.figures.errors import by_frame, errors
from ctr_nlp.view.figures.film import check_film, film
from ctr_nlp.view.figures.margins import clearance, stability
from ctr_nlp.view.figures.motion import configuration, tracking
from ctr_nlp.view.figures.overlay import shapes
from ctr_nlp.view.figures.robustness_plot import robustness

__all__ = ["check_film", "film", "save", "save_all", "tracking"]

PICTURES = {"shapes": shapes, "errors": errors, "by_frame": by_frame, "configuration": configuration}
"""Figures that every plan has, by the names of their files."""
FIGURE_DPI = 150
VECTOR_FORMATS = "pdf", "svg"
"""Formats of figures for print, with lines and text instead of pixels."""


def save_all(
    plan: Plan,
    folder: str | Path,
    suffix: str = "png",
    progress: Callable[[int, int, str], None] | None = None,
) -> list[Path]:
    """Write shapes, errors, by_frame, configuration, and where known stability, clearance and robustness.

    plan: the plan to draw. folder: an existing folder. suffix: of the files, "png" or one of VECTOR_FORMATS.
    progress: called as ``progress(done, total, name)`` before each picture. Returns the paths of the files. Raises
    OutputError where one cannot be written.
    """
    pictures = PICTURES | ({"stability": stability} if np.isfinite(plan.stability).any() else {})
    pictures |= {} if plan.clearance is None else {"clearance": clearance}
    pictures |= {} if plan.drawn is None else {"robustness": robustness}
    paths = list[Path]()
    for name, picture in pictures.items():
        if progress is not None:
            progress(len(paths), len(pictures), name)
        paths.append(save(picture(plan), Path(folder) / f"{name}.{suffix}"))
    return paths


def save(figure: Figure, path: Path) -> Path:
    """Write a figure to a file, and return its path; the same figure gives the same bytes every time.

    figure: the figure. path: where to write; a name in .pdf or .svg gets lines and text, any other a PNG. Raises
    OutputError where it cannot be written.
    """
    try:
        # Dates in PDF and SVG, and random names within SVG, would change the bytes of every run.
        figure.set_dpi(FIGURE_DPI)
        if path.suffix == ".pdf":
            from matplotlib.backends.backend_pdf import FigureCanvasPdf  # brings fontTools, which is seldom needed

            FigureCanvasPdf(figure).print_pdf(path, metadata={"CreationDate": None})
        elif path.suffix == ".svg":
            from matplotlib.backends.backend_svg import FigureCanvasSVG

            with rc_context({"svg.hashsalt": "ctr-nlp"}):
                FigureCanvasSVG(figure).print_svg(path, metadata={"Date": None})
        else:
            canvas = FigureCanvasAgg(figure)  # Figure.savefig draws a laid-out figure twice
            canvas.print_png(path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error}") from error
    return path
