"""Validation of a design's arguments (problems, rules, settings), and the search for tubes that they describe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.models import Model, model_named
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.shared.design import DesignedTubes, with_linear_curvatures
from ctr_nlp.ocp.shared.manufacture import Manufacture
from ctr_nlp.paths.problem import Problem
from ctr_nlp.planning.motions import at_frames
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.planning.starts.search import pick_draft_frames
from ctr_nlp.support.value_checks import check_instance
from ctr_nlp.tube_design.search import SHAPE_ALONE, DesignSearch


def search_for(
    problems: Sequence[Problem],
    model: str | Model = "elastic",
    rules: Manufacture | None = None,
    fixed: Sequence[str] = (),
    constant_curvature: bool = False,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    walls: bool = False,
) -> DesignSearch:
    """Build the search for tubes over all frames of problems.

    Parameters
    ----------
    problems : sequence of Problem
        Tasks, which share one robot and have different names.
    model : str or Model
        ``"elastic"``, ``"dominant"`` or ``Loaded(load)``.
    rules : Manufacture, optional
        Rules of manufacture; the defaults of :class:`Manufacture` where None.
    fixed : sequence of str
        Names of numbers that stay as they are.
    constant_curvature : bool
        Whether curved parts are arcs; otherwise their curvature is linear in arc length.
    settings : Settings
        `stability_margin` is the least of every robot; costs and tolerances of contact and arrival count where
        `walls` do.
    walls : bool
        Whether tubes are chosen for the tasks within their walls, and so that the tip arrives.

    Returns
    -------
    DesignSearch
        The search, with tasks on the robot whose structure is designed.

    Raises
    ------
    LoadError, OptionError, ProblemError, RobotError
        Something is not what it must be.
    """
    tasks = _check_problems(problems, settings)
    described = model_named(model, "model of a design")
    described.check_planning(tasks[0].robot)
    weighs = described.applied_load is not None and described.applied_load.has_weight
    # Arcs become parts with a linear curvature that is all but constant: root and tip are then two unknowns.
    robot = tasks[0].robot if constant_curvature else with_linear_curvatures(tasks[0].robot)
    tubes = DesignedTubes(robot, rules or Manufacture(), tuple(fixed), weighs)
    margin = 0.0 if settings.stability_margin is None else settings.stability_margin
    if walls and (without := next((task for task in tasks if task.wall is None), None)):
        raise ProblemError(
            f"walls count in this design, and none is known around {without.name}; give a path with radii or a "
            "mask, or leave walls out"
        )
    priorities = settings if walls else SHAPE_ALONE
    tasks = tuple(replace(task, robot=robot) for task in tasks)
    return DesignSearch(tasks, tubes, described, margin, priorities)


def _check_problems(problems: Sequence[Problem], settings: Settings) -> tuple[Problem, ...]:
    """Return the problems as a tuple; raise ProblemError unless their robots are equal and their names differ."""
    tasks = tuple(problems)
    if not tasks:
        raise ProblemError("problems of a design is empty; give at least one")
    check_instance(OptionError, "settings", settings, Settings)
    for task in tasks:
        check_instance(ProblemError, "problem", task, Problem)
        if task.robot != tasks[0].robot:
            raise ProblemError(
                f"the robot of {task.name} is not that of {tasks[0].name}; a design begins with one robot for all"
            )
    if len({task.name for task in tasks}) < len(tasks):
        raise ProblemError("two problems of a design have the same name; plans are written under their names")
    return tasks


def draft(task: Problem) -> Problem:
    """Return a task on the frames of a draft: 25 to 49 of them, or all where there are fewer than 50."""
    picked = pick_draft_frames(task.frames)
    return task if len(picked) == task.frames else at_frames(task, picked, int(picked[-1] - picked[-2]))
