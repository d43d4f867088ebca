"""Figure of the learning curve; in a file of its own, since the numbers need no matplotlib."""

from __future__ import annotations

from matplotlib import rc_context
from matplotlib.figure import Figure
from reference.learned.network import InverseKinematicsNetwork

from ctr_nlp.view.figures.parts.page import STYLE, plain_ticks
from ctr_nlp.view.figures.parts.palette import BLUE, VERMILLION


@rc_context(STYLE)
def learning_curve(network: InverseKinematicsNetwork) -> Figure:
    """Draw the error over the training steps of `network`, on training batches and on held-out shapes, in mm."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    step, trained, held = network.curve.T
    axes.plot(step, trained, color=BLUE, lw=1, label="a batch of what is trained on")
    axes.plot(step, held, color=VERMILLION, label="shapes that are not trained on")
    axes.set_yscale("log")
    plain_ticks(axes.yaxis)
    axes.set_xlabel("step of training")
    axes.set_ylabel("mean error of a shape (mm)")
    axes.legend()
    return figure
