"""Entry points of plans over all frames at once: the objective of eq. (9) summed over a motion's frames.

    sum_j d_j + lambda sum_j |W (q_{j+1} - q_j)|^2 / dt^2

d_j, mm^2, is the distance (8) in frame j; lambda is in s^2, and W scales rad to mm (10 mm/rad for angles).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy.typing as npt

from ctr_nlp.models import DEFAULT_MODEL, Model, model_named
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import Term
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.horizon.horizon import Horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.multistart import IterateCallback
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.planning.validation import check_problem_and_settings, check_search, checked_motions

if TYPE_CHECKING:
    from ctr_nlp.planning.horizon.loaded_horizon import LoadedHorizon


def solve_horizon(
    problem: Problem,
    *,
    model: str | Model = DEFAULT_MODEL,
    solver: str | None = None,
    start: npt.ArrayLike | None = None,
    end: npt.ArrayLike | None = None,
    motion_weight: float | None = None,
    initial: Sequence[npt.ArrayLike] = (),
    starts: int | None = None,
    jobs: int = 1,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
    callback: IterateCallback | None = None,
    exhaustive: bool = False,
) -> Plan:
    """Plan all frames of a motion in one nonlinear program, eq. (9) over a horizon.

    The plan is never worse than the best motion it started from, and is marked where it is no solution. Ctrl-C
    ends the work; the plan is then the best feasible one so far, marked as interrupted.

    Parameters
    ----------
    problem : Problem
        Robot and target.
    model : str or Model
        ``"elastic"``, the default, or ``"dominant"``, or ``Loaded(load)`` for a loaded robot. Under a load, the
        search begins with motions frame by frame (loaded_horizon.py); the robot without the load is solved over
        all frames only where none of these is good, or where `starts` or `exhaustive` are given.
    solver : str, optional
        ``"banded"`` or ``"ipopt"``; by default banded where there is a C compiler.
    start, end : array_like, optional
        Configurations q (2d + 2,) at time 0 and in the last frame; free where None.
    motion_weight : float, optional
        Lambda in s^2; by default the one at which the motion of the start costs a tenth of its shape errors.
    initial : sequence of array_like
        Motions (T, 2d + 2) to start from. By default those of per_frame_motions are solved on some of the frames
        (drafts), and the best of these on all frames.
    starts : int, optional
        Number of motions that are solved on all frames instead: the best ones, then smooth random changes of the
        best (`settings.seed`).
    jobs : int
        Number of processes.
    settings : Settings
        Weights of the wall and of single frames, and the stability margin.
    terms : sequence of Term
        Further terms of the objective (ctr_nlp.ocp.terms).
    progress : callable, optional
        Called as ``progress(done, total, note)``.
    callback : callable, optional
        Called with every iterate of all frames, or, with several processes, with every motion that is the best
        so far.
    exhaustive : bool
        Whether every motion found frame by frame is solved for all frames, and no other.

    Returns
    -------
    Plan
        Returned also where frames failed: see ``plan.success`` and ``plan.verdicts``.

    Raises
    ------
    OptionError, ProblemError, RobotError
        An option, the problem or the robot is not what it must be.
    """
    check_problem_and_settings(problem, settings)
    check_search(motion_weight, starts, jobs)
    # Given motions are checked before programs are built, which takes seconds.
    motions = checked_motions(problem, initial)
    planner = horizon_planner(problem, model, solver, start, end, settings, terms)
    return planner.solve(motions, motion_weight, starts, jobs, progress, callback, exhaustive)


def horizon_planner(
    problem: Problem,
    model: str | Model = DEFAULT_MODEL,
    solver: str | None = None,
    start: npt.ArrayLike | None = None,
    end: npt.ArrayLike | None = None,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    terms: Sequence[Term] = (),
) -> Horizon | LoadedHorizon:
    """Build the planner of all frames at once, to be solved for one or several motion weights.

    The only way to a horizon: command line, Python, sweeps and comparisons take the planner from here, so that
    all of them run the same algorithm for the same request.

    Parameters
    ----------
    problem, model, solver, start, end, settings, terms
        As :func:`solve_horizon`.

    Returns
    -------
    Horizon or LoadedHorizon
        The second where the model has a load: its search begins with the robot without the load.

    Raises
    ------
    OptionError, ProblemError, RobotError, LoadError
        As :func:`solve_horizon`.
    """
    chosen = model_named(model, "model of a horizon")
    # Both have the same method `solve`: callers need not know which of them they have.
    if chosen.applied_load is None:
        return Horizon(problem, chosen, solver, start, end, settings, terms)
    # Brings the loaded rod and the solver of several scenarios, which no robot without a load needs.
    from ctr_nlp.planning.horizon.loaded_horizon import LoadedHorizon

    return LoadedHorizon(problem, chosen, solver, start, end, settings, terms)
