"""How far from the snap a motion keeps."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ctr_nlp.figures.parts.page import STYLE, curve, frame_axis, head, shade_failures
from ctr_nlp.figures.parts.palette import BLUE, ORANGE, VERMILLION
from ctr_nlp.plan.plan import Plan


@matplotlib.rc_context(STYLE)
def stability(plan: Plan) -> Figure:
    """Stability margin at every frame and on the way to it, the one asked for, and snaps."""
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    axes = figure.subplots()
    frames = np.arange(1, len(plan.time) + 1)
    shade_failures(axes, plan, frames, 1.0)
    curve(axes, frames, plan.stability_between, color=ORANGE, lw=1.2, ls="--", label="on the way to a frame")
    curve(axes, frames, plan.stability, color=BLUE, lw=2.0, ls="-", label="at a frame")
    asked = plan.meta["options"].get("stability_margin")
    if asked is not None:
        axes.axhline(asked, color="0.3", lw=0.9, ls=":", label=f"asked for, {asked:g}")
    for k, snap in enumerate(plan.meta.get("snaps", [])):
        axes.axvline(snap["frame"], color=VERMILLION, lw=1.2, label=None if k else "snap")
    axes.axhline(0.0, color="0.3", lw=0.6)
    low = float(np.nanmin(np.append(plan.stability_between[np.isfinite(plan.stability_between)], 0.0)))
    axes.set_ylim(min(1.15 * low, -0.02), 1.05)
    frame_axis(axes, len(frames))
    axes.set_ylabel("stability margin")
    figure.legend(loc="outside lower center", ncols=4)
    head(figure, plan, "Stability")
    return figure
