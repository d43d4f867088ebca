"""Simulated robots within the tolerances beside the nominal one, as thin lines of a scene."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import to_rgb

from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.sample_motions import simulate_samples
from ctr_nlp.robot.samples import perturb_robot
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.palette import SKY, VERMILLION
from ctr_nlp.view.report.legible import darken_for_white

MAX_REPORT_GHOSTS, REPORT_GHOST_SAMPLE_STRIDE = 20, 5
"""Number of simulated robots that are shown, and stride of the 101 samples of their shapes: some 0.3 MB of
a page.
"""
REPORT_GHOST_COLOUR, REPORT_FAILED_GHOST_COLOUR = darken_for_white(SKY), VERMILLION
"""Colours of simulated robots, and of failed ones from the frame on in which they fail."""
REPORT_GHOST_LINE_WIDTH_MM = 0.35
"""Width of their lines."""
SAMPLED_ROBOTS_PART = "sampled robots"
"""Name of their part of a scene."""


def ghosts(k3d: Any, plan: Plan) -> list[Any]:
    """Return one object with the first simulated robots of a plan, in a list; an empty list where it has none.

    k3d: the module. plan: the plan, which holds the robots' parameters but not their shapes: these are simulated
    again. The object's time is the index of the frame. Where a robot has no shape it is a point at the insertion
    point.
    """
    if plan.drawn is None:
        return []
    shapes = _shapes(plan)
    n, frames, samples = shapes.shape[:3]
    first = samples * np.arange(n)[:, None] + np.arange(samples - 1)
    lost = plan.drawn.lost[:n, None]
    number = np.arange(1, frames + 1)
    gone = np.repeat((lost > 0) & (lost <= number), samples, axis=0).astype(np.float32)
    told = k3d.lines(
        {str(j): shapes[:, j].reshape(-1, 3) for j in range(frames)},
        np.stack([first, first + 1], axis=-1).reshape(-1, 2).astype(np.uint32),
        indices_type="segment",
        attribute={str(j): gone[:, j] for j in range(frames)},
        color_map=[
            part
            for at, colour in ((0.0, REPORT_GHOST_COLOUR), (1.0, REPORT_FAILED_GHOST_COLOUR))
            for part in (at, *to_rgb(colour))
        ],
        color_range=[0.0, 1.0],
        width=REPORT_GHOST_LINE_WIDTH_MM,
        shader="thick",
        name=SAMPLED_ROBOTS_PART,
        custom_data={"part": SAMPLED_ROBOTS_PART},
    )
    return [told]


def _shapes(plan: Plan) -> Array:
    """Return shapes of the first simulated robots in every frame, (n, T, samples, 3) mm; 0 where there is none."""
    assert plan.drawn is not None
    draws = perturb_robot(plan.robot, plan.drawn.parts[:MAX_REPORT_GHOSTS], plan.drawn.lags[:MAX_REPORT_GHOSTS])
    found = simulate_samples(plan.robot, draws, plan.q, plan.evaluated_model)
    return np.nan_to_num(found.shape[:, :, ::REPORT_GHOST_SAMPLE_STRIDE]).astype(np.float32)
