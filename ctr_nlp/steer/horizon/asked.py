"""Steering over a whole motion at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy.typing as npt

from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.terms import Term
from ctr_nlp.models import Model, model_named
from ctr_nlp.plan.plan import Plan
from ctr_nlp.steer.attempts import Report
from ctr_nlp.steer.horizon.bearing import LoadedHorizon
from ctr_nlp.steer.horizon.chained import Horizon
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.requests import check_described, check_search, checked_motions
from ctr_nlp.target.problem import Problem


def solve_horizon(
    problem: Problem,
    *,
    model: str | Model = "dominant",
    solver: str | None = None,
    start: npt.ArrayLike | None = None,
    end: npt.ArrayLike | None = None,
    motion_weight: float | None = None,
    initial: Sequence[npt.ArrayLike] = (),
    starts: int | None = None,
    jobs: int = 1,
    settings: Settings = DEFAULTS,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
    seen: Report | None = None,
    exhaustive: bool = False,
) -> Plan:
    """The plan that follows a problem's target over all frames at once, eq. (9) over a horizon.

    solver: banded, or ipopt; None takes banded where there is a C compiler. start: q (2d + 2,) at time 0; end: q
    of the last frame; free where None. motion_weight: lambda in s^2; None takes the one at which the motion of
    the start costs a tenth of its shape errors. initial: motions (T, 2d + 2) to start from; without any, those of
    per_frame_motions, all of which are solved for some of the frames, and the best of these for all frames.
    starts: how many are solved for all frames instead: the best of those, then smooth random changes of the best
    (settings.seed). exhaustive: all of those are, and no others. jobs: in how many processes. settings: of the
    frames run one by one. terms: further ones of the objective (formulations.terms). seen: told of every iterate
    of all frames, or where processes are several of every attempt that is the best until then.
    Under a load, all this is of the robot without it. The search begins with motions frame by frame (bearing.py);
    the robot without the load is solved over all frames only where these lead to no good one, and where starts or
    exhaustive are given.
    The plan is never worse than the best motion it started from, and marked where it is no solution. Ctrl-C ends
    the work; the plan is then the best feasible one so far, marked as interrupted. Raises OptionError,
    ProblemError, RobotError.
    """
    check_described(problem, settings)
    check_search(motion_weight, starts, jobs)
    motions = checked_motions(problem, initial)
    model = model_named(model, "model of a horizon")
    over = Horizon if model.bears is None else LoadedHorizon
    whole = over(problem, model, solver, start, end, settings, terms)
    return whole.solve(motions, motion_weight, starts, jobs, progress, seen, exhaustive)
