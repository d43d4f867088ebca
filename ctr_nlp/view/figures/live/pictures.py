"""Contents of live windows: a motion while it is solved for, and a robot while it is moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.paths.wall_surfaces import DrawnWall
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.overlay import TARGET_LINE_STYLE
from ctr_nlp.view.figures.parts.page import add_title, outcome
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, FAILED_FRAME_COLOUR
from ctr_nlp.view.figures.parts.space import (
    RobotLines,
    add_space_axes,
    add_wall_sections,
    fit_box,
    key,
    points_of_all,
)

LIVE_SHAPE_FRAMES = 5
"""Number of frames whose shapes are drawn."""


class SolverState(NamedTuple):
    """Progress of a solver.

    objective (n,), mean over frames, mm^2, and error (n,), KKT residual, of all iterates; NaN between two starts.
    motion (T, 2d + 2): unknowns of the newest iterate.
    """

    objective: Array
    error: Array
    motion: Array


@dataclass
class SolverPicture:
    """Picture of a motion while it is solved for; its states are SolverState, and at last a Plan.

    name: of the problem. model: name of the kinematic model. target (T, 101, 3) mm; lumen (N, 4) mm, where it is
    a wall; walls: other walls.
    """

    name: str
    robot: Robot
    model: str
    target: Array
    lumen: Array | None
    walls: Sequence[DrawnWall] = ()
    size = (9.6, 7.0)

    def begin(self, figure: Figure) -> None:
        """Draw what stays into `figure`: box, wall, insertion point and targets."""
        axes = add_space_axes(figure, (0.0, 0.08, 0.5, 0.84), self.lumen)
        add_wall_sections(axes, self.walls, self.target[-1])
        count = len(self.target)
        self._frames = np.unique(
            np.ceil(np.arange(1, LIVE_SHAPE_FRAMES + 1) * count / LIVE_SHAPE_FRAMES).astype(int) - 1
        )
        self._bodies = [RobotLines(axes, self.robot.d) for _ in self._frames]
        for j in self._frames:
            axes.plot(*self.target[j].T, zorder=5, **TARGET_LINE_STYLE)
        fit_box(axes, points_of_all([self.target], self.lumen))
        self._curves = list[tuple[Axes, Line2D]]()
        for row, (label, colour) in enumerate((("objective (mm²)", BLUE), ("KKT residual", BLACK))):
            panel = figure.add_axes((0.6, 0.57 - 0.4 * row, 0.36, 0.33))
            panel.set_yscale("log")
            panel.set_ylabel(label)
            self._curves.append((panel, panel.plot([], [], color=colour, lw=0.8, marker=".", ms=2)[0]))
            panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        panel.set_xlabel("iterate, of all starts")
        add_title(figure, f"{self.name}: the motion while it is solved for")
        self._now = figure.text(0.25, 0.925, "looking for motions to start from", ha="center", va="center")
        walled = self.lumen is not None or bool(self.walls)
        figure.legend(handles=key(self.robot.d, walled), loc="lower center", ncols=6)

    def show(self, state: SolverState | Plan) -> None:
        """Show the newest motion and all iterates of `state`; or a plan, in their place."""
        if isinstance(state, Plan):
            shapes = state.shape[self._frames]
            beta = state.beta[self._frames]
            self._show(shapes, beta, f"the plan: {outcome(summary(state))}")
            return
        motion = state.motion[self._frames]
        shapes = KINEMATIC_MODELS[self.model].points(self.robot, motion, SIGMA_GRID)
        beta = self.robot.split(motion)[1]
        for (panel, line), values in zip(self._curves, (state.objective, state.error), strict=True):
            line.set_data(np.arange(len(values)), np.where(values > 0, values, np.nan))
            panel.relim()
            panel.autoscale_view()
        # NaN separates starts and is no iterate.
        number = np.isfinite(state.error).sum()
        self._show(shapes, beta, f"iterate {number}, objective {state.objective[-1]:.4g} mm²")

    def _show(self, shapes: Array, beta: Array, words: str) -> None:
        """Draw shapes (n, 101, 3) mm with extensions beta (n, d) mm, and say `words` above them."""
        for body, shape, row in zip(self._bodies, shapes, beta, strict=True):
            body.show(shape, row)
        self._now.set_text(f"frames {', '.join(str(j + 1) for j in self._frames)}; {words}")


COMMANDED: dict[str, Any] = {"color": FAILED_FRAME_COLOUR, "lw": 8.0, "zorder": 3}
"""Style of the commanded shape: a broad light band, in which the robot should lie."""


class PlaybackState(NamedTuple):
    """A moment of a plan that is played.

    state: of the player, in words. frame: the last that was passed, 0 for none. time: since the program's start,
    s. measured, commanded: q (2d + 2,).
    """

    state: str
    frame: int
    time: float
    measured: Array
    commanded: Array


@dataclass
class PlaybackPicture:
    """Picture of a plan that is played; its states are PlaybackState."""

    plan: Plan
    size = (5.2, 7.0)

    def begin(self, figure: Figure) -> None:
        """Draw what stays into `figure`: box, wall and insertion point."""
        plan = self.plan
        axes = add_space_axes(figure, (0.0, 0.08, 1.0, 0.84), plan.lumen_wall)
        add_wall_sections(axes, plan.drawn_walls, plan.target[-1])
        self._commanded = (
            RobotLines(axes, plan.robot.d, **COMMANDED),
            ShapeContinuation(plan.robot, plan.evaluated_model_name),
        )
        self._measured = RobotLines(axes, plan.robot.d), ShapeContinuation(plan.robot, plan.evaluated_model_name)
        self._target = axes.plot([], [], [], zorder=5, **TARGET_LINE_STYLE)[0]
        fit_box(axes, points_of_all([plan.shape, plan.target], plan.lumen_wall))
        add_title(figure, f"{plan.meta['problem']['name']}, played")
        self._now = figure.text(0.5, 0.925, "waiting", ha="center", va="center")
        commanded = Line2D([], [], label="commanded", **{name: COMMANDED[name] for name in ("color", "lw")})
        figure.legend(handles=[*key(plan.robot.d, plan.wall is not None), commanded], loc="lower center", ncols=4)

    def show(self, state: PlaybackState) -> None:
        """Show the moment `state`; a robot without an equilibrium is not drawn."""
        d = self.plan.robot.d
        plan = self.plan
        for (body, shape), q in ((self._commanded, state.commanded), (self._measured, state.measured)):
            body.show(shape(q), q[d : 2 * d])
        self._target.set_data_3d(*plan.target[np.clip(state.frame, 1, len(plan.time)) - 1].T)
        where = f"frame {state.frame} of {len(plan.time)}" if state.frame else "on the way to frame 1"
        self._now.set_text(f"{state.state}, {where}, {state.time:.1f} s")


class ShapeContinuation:
    """Shapes of one robot along a sequence of configurations, each equilibrium continued from the one before."""

    def __init__(self, robot: Robot, model: str) -> None:
        self._robot = robot
        self._model = KINEMATIC_MODELS[model]
        self._before: tuple[Array, Array] | None = None

    def __call__(self, q: Array) -> Array:
        """Return the shape (101, 3) mm at q (2d + 2,); NaN where no equilibrium is found."""
        # On the elastic model q alone does not determine the equilibrium; its branch comes from the motion before.
        passage, x0 = (
            (q[None], None) if self._before is None else (np.stack([self._before[0], q]), self._before[1])
        )
        x = self._model.follow(self._robot, passage, x0).x[-1]
        self._before = (q, x) if np.isfinite(x).all() else None
        return self._model.points(self._robot, x[None], SIGMA_GRID)[0]
