"""Figures of a calibration: residuals, measured over fitted, parameters with their uncertainty, correlations."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ctr_nlp.identify.calibration.calibration import Calibration
from ctr_nlp.identify.calibration.prediction import flat_measured
from ctr_nlp.identify.calibration.residuals import errors
from ctr_nlp.typing import Array
from ctr_nlp.view.figures import save
from ctr_nlp.view.figures.parts.page import STYLE, panels, root_scale
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, ORANGE, SKY, VERMILLION

MOST_AXES = 8
"""Axes of q over which residuals are drawn."""


def save_all(found: Calibration, folder: Path) -> list[Path]:
    """Write residuals.png, measured.png, parameters.png and correlations.png.

    Parameters
    ----------
    found : Calibration
        The calibration.
    folder : Path
        The folder that they are written into.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    pictures = {
        "residuals": residuals,
        "measured": against_fitted,
        "parameters": parameters,
        "correlations": correlations,
    }
    return [save(picture(found), folder / f"{name}.png") for name, picture in pictures.items()]


@matplotlib.rc_context(STYLE)
def residuals(found: Calibration) -> Figure:
    """Draw errors of all observations found, mm, over each entry of q that was moved."""
    q = found.measured.q
    moved = [k for k in range(q.shape[1]) if np.ptp(q[:, k]) > 1e-9][:MOST_AXES] or [0]
    figure, axes = panels([found.nominal.axes[k] for k in moved], min(3, len(moved)), (2.6, 2.2))
    looks = (
        (found.nominal_residuals, SKY, "as described"),
        (found.fit.residuals, BLUE, "fitted"),
        (found.held_out, ORANGE, "held out"),
    )
    for panel, k in zip(axes, moved, strict=True):
        for values, colour, label in looks:
            panel.plot(q[:, k], errors(values), ".", ms=3, color=colour, label=label)
        unit = "mm" if found.nominal.axes[k].startswith("beta") else "rad"
        panel.set_xlabel(f"{found.nominal.axes[k]} ({unit})")
        root_scale(panel)
    axes[0].set_ylabel("error (mm)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


@matplotlib.rc_context(STYLE)
def against_fitted(found: Calibration) -> Figure:
    """Draw every measured coordinate found over the predicted one, x, y and z in the sensor's axes, mm."""
    figure, axes = panels(["x", "y", "z"], 3, (2.6, 2.6))
    for axis, panel in enumerate(axes):
        measured = _coordinates(flat_measured(found.measured), axis)
        for values, colour, label in (
            (found.nominal_residuals, SKY, "as described"),
            (found.fit.residuals, BLUE, "fitted"),
        ):
            panel.plot(measured - _coordinates(values, axis), measured, ".", ms=3, color=colour, label=label)
        known = measured[np.isfinite(measured)]
        if len(known):
            panel.plot([known.min(), known.max()], [known.min(), known.max()], color=BLACK, lw=0.6)
        panel.set_xlabel("predicted (mm)")
    axes[0].set_ylabel("measured (mm)")
    axes[0].legend()
    return figure


@matplotlib.rc_context(STYLE)
def parameters(found: Calibration) -> Figure:
    """Draw the parameters found with two standard deviations, in units of those before measuring."""
    chosen = [k for k, one in enumerate(found.parameters.each) if not one.kind.startswith("base_")]
    chosen = chosen or list(range(len(found.parameters)))
    figure = Figure(figsize=(6.0, 1.0 + 0.26 * len(chosen)), layout="constrained")
    axes = figure.subplots()
    sigma = found.parameters.sigma[chosen]
    rows = np.arange(len(chosen))[::-1]
    off = (found.fit.values - found.parameters.mean)[chosen] / sigma
    axes.barh(rows, 4.0, left=-2.0, height=0.8, color="0.85", label="before")
    axes.errorbar(off, rows, xerr=2 * found.fit.sigma[chosen] / sigma, fmt="o", ms=3, color=BLUE, label="after")
    held = [place for place, k in enumerate(chosen) if found.standing[k] == "held"]
    if held:
        axes.plot(off[held], rows[held], "o", ms=3, color=VERMILLION, label="barely determined by the data")
    axes.set_yticks(rows, [found.parameters.names[k] for k in chosen])
    axes.set_xlabel("difference from before, in its standard deviations (bars: two)")
    figure.legend(loc="outside upper right", ncols=3)
    return figure


@matplotlib.rc_context(STYLE)
def correlations(found: Calibration) -> Figure:
    """Draw the correlations of the parameters found that are left after measuring."""
    count = len(found.parameters)
    sigma = found.fit.sigma
    side = max(3.5, 1.6 + 0.2 * count)
    figure = Figure(figsize=(side + 0.6, side), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(found.fit.covariance / np.outer(sigma, sigma), cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_xticks(range(count), found.parameters.names, rotation=90, fontsize=6)
    axes.set_yticks(range(count), found.parameters.names, fontsize=6)
    axes.grid(visible=False)
    figure.colorbar(image, label="correlation", shrink=0.7)
    return figure


def _coordinates(flat: Array, axis: int) -> Array:
    """One coordinate of tips and points, from rows (T, 6 + 3n): axis 0, 1 or 2, all observations in one array."""
    return np.delete(flat, slice(3, 6), axis=1)[:, axis::3].ravel()
