"""Re-planning of the remaining frames of a plan."""

from __future__ import annotations

from typing import Any

from ctr_nlp.exceptions import OptionError
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.plan_data import planned_model
from ctr_nlp.planning.per_frame import solve_per_frame
from ctr_nlp.support.value_checks import whole_number


def replan_from_frame(plan: Plan, problem: Problem, from_frame: int, **options: Any) -> Plan:
    """Return a plan whose frames from `from_frame` on, counted from 1, are re-planned.

    plan: whose earlier frames are kept; the configuration of the last of them is the start. problem: as many
    frames as the plan; its robot, time step and lumen must be the plan's, its later targets may differ. options:
    of solve_per_frame, such as settings. Raises OptionError.
    """
    frames = len(plan.time)
    number = whole_number(OptionError, "from_frame", from_frame, 2)
    if problem.frames != frames or number > frames:
        raise OptionError(
            f"from_frame is {number}, of a plan of {frames} frames and a problem of {problem.frames}: it must be "
            f"in [2, {frames}], and both must have as many frames"
        )
    # Frames count from 1: q[number - 2] is the frame before `number`, and [number - 1 :] begins with it.
    start = plan.q[number - 2]
    model = {"model": planned_model(plan.meta)} | options
    return plan[: number - 1] + solve_per_frame(problem[number - 1 :], start=start, direction="forward", **model)
