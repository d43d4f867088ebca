"""Live windows of programs: what they are shown while a plan is solved for or played."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.solvers import Iterate
from ctr_nlp.view.figures.live import LiveWindow, PlaybackPicture, PlaybackState, SolverPicture, SolverState


class SolverView:
    """Window that shows iterates of a problem's motion as they are found, and at last the plan."""

    def __init__(self, view: LiveWindow, problem: Problem) -> None:
        self._view = view
        self._frames = problem.frames
        self._unknowns = len(problem.robot.axes)
        self._history = list[tuple[float, float]]()

    def __call__(self, iterate: Iterate) -> None:
        """Show an iterate; a gap separates it from those of another start."""
        if iterate.number == 0 and self._history:
            self._history.append((np.nan, np.nan))
        self._history.append((iterate.objective / self._frames, iterate.error))
        self._view.show(partial(self._stage, iterate))

    def _stage(self, iterate: Iterate) -> SolverState:
        """Return what the picture shows of an iterate; called in the window's sender thread."""
        objective, error = np.array(self._history).T
        # A horizon's unknowns have, frame by frame, those of the robot first, and slack variables after them.
        return SolverState(objective, error, iterate.x.reshape(self._frames, -1)[:, : self._unknowns])

    def show_plan(self, plan: Plan) -> None:
        """Show the plan."""
        self._view.show(lambda: plan)


class PlaybackView:
    """Window that shows what a player sees, and at last how playback ended."""

    def __init__(self, view: LiveWindow) -> None:
        self._view = view
        self._last: tuple[Trajectory, MotionProgress] | None = None

    def __call__(self, trajectory: Trajectory, progress: MotionProgress, state: str) -> None:
        """Show where the robot is; state: of the player, in words."""
        self._last = trajectory, progress
        self._view.show(partial(_playback_state, trajectory, progress, state))

    def show_outcome(self, outcome: str) -> None:
        """Show `outcome`, how playback ended in words, with the robot where it was seen last."""
        if self._last is not None:
            self(*self._last, outcome)


def _playback_state(trajectory: Trajectory, progress: MotionProgress, state: str) -> PlaybackState:
    """Return what the picture shows of a moment; called in the window's sender thread."""
    time = np.array([progress.time])
    measured = trajectory.joints(time, progress.position[None])[0]
    commanded = trajectory.at(time)[0][0]
    return PlaybackState(state, trajectory.last_frame_passed(progress.time), progress.time, measured, commanded)


@contextmanager
def open_solver_view(problem: Problem, model: str) -> Iterator[SolverView]:
    """Open a window for the motion of a problem on the model called `model`; raises OptionError where it
    cannot.
    """
    lumen = None if problem.lumen_wall is None else problem.lumen_wall.table
    target = np.array([frame.points for frame in problem.target_frames])
    picture = SolverPicture(problem.name, problem.robot, model, target, lumen, problem.drawn_walls)
    with LiveWindow(picture) as view:
        yield SolverView(view, problem)


@contextmanager
def open_playback_view(plan: Plan) -> Iterator[PlaybackView]:
    """Open a window for a plan that is played; raises OptionError where it cannot."""
    with LiveWindow(PlaybackPicture(plan)) as view:
        yield PlaybackView(view)
