"""What programs tell their live views."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

from ctr_nlp.figures.live import Now, Playing, Solving, Stage, View
from ctr_nlp.hardware.devices import Progress
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.plan.plan import Plan
from ctr_nlp.solvers import Iterate
from ctr_nlp.target.problem import Problem


class Solved:
    """Shows iterates of a problem's motion as they are found, and at last the plan that they have led to."""

    def __init__(self, view: View, problem: Problem) -> None:
        self._view, self._frames, self._unknowns = view, problem.frames, len(problem.robot.axes)
        self._history = list[tuple[float, float]]()

    def __call__(self, iterate: Iterate) -> None:
        """Show an iterate; where a solver begins anew there is a gap."""
        if iterate.number == 0 and self._history:
            self._history.append((np.nan, np.nan))
        self._history.append((iterate.objective / self._frames, iterate.error))
        self._view.show(partial(self._stage, iterate))

    def _stage(self, iterate: Iterate) -> Stage:
        objective, error = np.array(self._history).T
        return Stage(objective, error, iterate.x.reshape(self._frames, -1)[:, : self._unknowns])

    def ended(self, plan: Plan) -> None:
        """Show the plan."""
        self._view.show(lambda: plan)


class Played:
    """Shows what a player sees, and at last how it ended."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._last: tuple[Trajectory, Progress] | None = None

    def __call__(self, trajectory: Trajectory, progress: Progress, state: str) -> None:
        """Show where the robot is; state: of the player, in words."""
        self._last = trajectory, progress
        self._view.show(partial(_now, trajectory, progress, state))

    def ended(self, outcome: str) -> None:
        """Show how it ended, with the robot where it was seen last."""
        if self._last is not None:
            self(*self._last, outcome)


def _now(trajectory: Trajectory, progress: Progress, state: str) -> Now:
    time = np.array([progress.time])
    measured, commanded = trajectory.joints(time, progress.position[None])[0], trajectory.at(time)[0][0]
    return Now(state, trajectory.passed(progress.time), progress.time, measured, commanded)


@contextmanager
def solving(problem: Problem, model: str) -> Iterator[Solved]:
    """A window for the motion of a problem; raises OptionError where none can be opened."""
    lumen = None if problem.sampled_lumen is None else problem.sampled_lumen.table
    target = np.array([frame.points for frame in problem.samples])
    with View(Solving(problem.name, problem.robot, model, target, lumen)) as view:
        yield Solved(view, problem)


@contextmanager
def playing(plan: Plan) -> Iterator[Played]:
    """A window for a plan that is played; raises OptionError where none can be opened."""
    with View(Playing(plan)) as view:
        yield Played(view)
