"""Draw the pictures of docs/concepts/: `python scripts/site/concepts.py [FOLDER]`. Every curve is computed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

import ctr_nlp as ctr
from ctr_nlp.models import model_named
from ctr_nlp.models.protocol import subdivide_motion
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.simulation import simulate_motion
from ctr_nlp.robot.samples import sample_robots
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.palette import BLUE, GREEN, ORANGE, VERMILLION

FOLDER = Path(__file__).parents[2] / "docs" / "concepts"
COLOURS = BLUE, ORANGE, GREEN
"""Of tubes, the outermost first."""
GREY = "#888888"
NITINOL = 60000.0
"""Young's modulus of the picture of loads, MPa."""
PAIR = ctr.Robot(
    tuple(
        ctr.Tube(length, 100.0, curvature, outer, inner, youngs_modulus=NITINOL)
        for length, curvature, outer, inner in ((140.0, 0.014, 2.0, 1.6), (170.0, 0.014, 1.5, 0.7))
    )
)
"""Two tubes that bend alike and are about as stiff: turned against each other, they snap."""
OUT = (60.0, 100.0, 150.0)
"""Lengths of the paper's tubes beyond the insertion point in the pictures, mm."""


def configuration(alpha: tuple[float, ...], beta: tuple[float, ...]) -> Array:
    """A row of q whose base is not tilted."""
    return np.array([[*alpha, *beta, 0.0, 0.0]])


def view(axes: Axes, title: str) -> None:
    """Name the axes of a picture of shapes, seen from the side, at one scale."""
    axes.set(title=title, xlabel="x (mm)", ylabel="z (mm)", aspect="equal")


def tubes(axes: Axes) -> None:
    """A robot of three tubes and what is called alpha and beta."""
    robot = ctr.table_i_robot()
    points = ctr.shapes(robot, configuration((0.0, 0.0, np.pi), OUT))[0]
    length = SIGMA_GRID * OUT[-1]
    for i, (start, end) in enumerate(zip((0.0, *OUT), OUT, strict=False)):
        part = (length >= start) & (length <= end)
        axes.plot(*points[part][:, [0, 2]].T, color=COLOURS[i], lw=8 - 2.5 * i, solid_capstyle="butt")
        tip = points[part][-1]
        axes.annotate(f"$\\beta_{i + 1}$ = {end:g} mm", tip[[0, 2]], (8, -12), textcoords="offset points")
    axes.annotate("insertion point", (0, 0), (10, 0), textcoords="offset points")
    axes.set_xlim(-30, 150)
    view(axes, "Each tube shows where it is the outermost one")


def whole_shape(axes: Axes) -> None:
    """Two shapes with nearly the same tip."""
    robot = ctr.table_i_robot()
    one = ctr.shapes(robot, configuration((0.0, np.pi, 0.0), (40.0, 80.0, 120.0)))[0][:, [0, 2]]
    target = np.linspace(0, 1, len(one))[:, None] * one[-1]
    axes.plot(*target.T[::-1], color=GREY, ls="--", label="target")
    axes.plot(*one.T[::-1], color=COLOURS[0], lw=3, label="robot")
    for a, b in zip(one[::8], target[::8], strict=True):
        axes.plot(*np.array([a, b]).T[::-1], color=VERMILLION, lw=1)
    error = np.sqrt(np.mean(np.sum((one - target) ** 2, axis=1)))
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.8), ncols=2)
    view(axes, f"The tip is where it should be; the body is not: {error:.1f} mm")
    axes.set(xlabel="z (mm)", ylabel="x (mm)")


def models(axes: Axes) -> None:
    """The same configuration on both models."""
    robot, q = ctr.table_i_robot(), configuration((0.0, 1.2, 2.4), OUT)
    for name, style in (("dominant", "--"), ("elastic", "-")):
        axes.plot(*simulate_motion(robot, q, name).shape[0][:, [0, 2]].T, style, color=COLOURS[0], label=name)
    axes.legend(title="model")
    view(axes, "One configuration, two models")


def snap(axes: Axes) -> None:
    """How the tip follows the motors, and where it cannot: every x is an equilibrium, so the curve is direct."""
    model, beta = model_named("elastic"), (100.0, 100.0)
    tips = np.linspace(0, 2 * np.pi, 400)
    x = np.array([[-tip, tip, *beta, 0.0, 0.0] for tip in tips])  # the first angle is against the last
    q, margin = (found(PAIR, x) for found in (model.configuration, model.margins))
    motors, stable = q[:, 1] - q[:, 0], margin > 0
    for part, style, label in ((stable, "-", "stable"), (~stable, ":", "not stable")):
        axes.plot(*(np.where(part, each, np.nan) for each in (motors, tips)), style, color=COLOURS[0], label=label)
    edge = np.flatnonzero(~stable)[0] - 1
    landing = tips[stable & (tips > np.pi)][np.argmin(abs(motors[stable & (tips > np.pi)] - motors[edge]))]
    axes.annotate(
        "",
        (motors[edge], landing),
        (motors[edge], tips[edge]),
        arrowprops={"arrowstyle": "->", "color": VERMILLION},
    )
    axes.text(motors[edge] + 0.15, np.pi, "snap", color=VERMILLION)
    axes.set(title="Two tubes turned against each other", xlabel="motors apart (rad)", ylabel="tips apart (rad)")
    axes.legend(loc="lower right")


def draws(axes: Axes) -> None:
    """Where robots come to that are within the tolerances of one robot."""
    robot, q, model = ctr.table_i_robot(), configuration((0.0, 2.4, 4.2), OUT), model_named("elastic")
    robots, way = sample_robots(robot, 40, seed=1), subdivide_motion(q, 1)
    moved = model.follow_batch(
        robots.structure, robots.numbers, way, robots.tube_configurations(way.q, way.fresh), margins=False
    )
    x = np.array([each.x for each in moved])
    for (points,) in model.points_batch(robots.structure, robots.numbers, x, SIGMA_GRID):
        axes.plot(*points[:, [0, 2]].T, color=COLOURS[0], lw=1, alpha=0.4)
    axes.plot(
        *simulate_motion(robot, q, model).shape[0][:, [0, 2]].T,
        color=VERMILLION,
        lw=2,
        label="the robot described",
    )
    axes.margins(x=0.8)
    axes.legend()
    view(axes, "Forty robots within the tolerances")


def loads(axes: Axes) -> None:
    """A robot under a force at its tip."""
    q = configuration((0.0, 0.4), (60.0, 100.0))
    for force, colour in ((0.0, GREY), (0.3, COLOURS[0]), (0.6, VERMILLION)):
        model = ctr.Loaded(ctr.Load(force=(0.0, 0.0, force)))
        points = model.points(PAIR, model.rest(PAIR, q[0])[None], SIGMA_GRID)[0]
        axes.plot(*points[:, [0, 2]].T, color=colour, lw=2, label=f"{force:g} N")
    axes.legend(title="force along z")
    view(axes, "A force at the tip bends the whole robot")


PICTURES: dict[str, Callable[[Axes], None]] = {
    "tubes": tubes,
    "whole-shape": whole_shape,
    "models": models,
    "snap": snap,
    "tolerances": draws,
    "loads": loads,
}
"""Name of a picture -> what draws it."""


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    for name, paint in PICTURES.items():
        figure, axes = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
        paint(axes)
        figure.savefig(folder / f"{name}.png", dpi=100, bbox_inches="tight")
        plt.close(figure)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
