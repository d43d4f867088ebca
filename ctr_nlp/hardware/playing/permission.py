"""Whether a plan may be played: every verdict on it must read "yes".

A verdict that nobody checked stands in the way just as one that reads "no" does. Otherwise a plan of which less is
known would be played more readily: on the dominant model, which cannot predict snapping, nothing would be asked.
"""

from __future__ import annotations

from ctr_nlp.exceptions import OptionError, TrajectoryError
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import NO, YES, Verdict


def check_permission(
    plan: Plan, *, free_space: bool = False, uncertified: bool = False, name: str = "PLAN.npz"
) -> tuple[Verdict, ...]:
    """Raise an error unless every verdict on a plan reads "yes" or is waived.

    It does not replace :func:`~ctr_nlp.hardware.playing.checks.check_plan`, whose refusals nothing waives:
    unsolved frames, limits of the robot and of the hardware, and snaps on the model that the plan is evaluated on.

    Parameters
    ----------
    plan : Plan
        The plan that is to be played.
    free_space : bool, optional
        Nothing surrounds the robot, as on a bench. Waives the verdict on the wall where it was not checked, and no
        other.
    uncertified : bool, optional
        Waives all verdicts.
    name : str, optional
        What the message calls the plan's file.

    Returns
    -------
    tuple of Verdict
        The verdicts that do not read "yes" and were waived, so that they can be shown; empty where there are none.

    Raises
    ------
    OptionError
        `free_space` of a plan that knows a lumen.
    TrajectoryError
        A verdict reads "no" or was not checked, and is not waived. The message lists all of these.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> plan = ctr.solve_per_frame(named_problem("arc", frames=3), model="dominant")
    >>> "stable" in [verdict.matter for verdict in check_permission(plan, uncertified=True)]
    True
    """
    lumen_known = any(each is not None for each in (plan.wall, plan.lumen_radius, plan.clearance))
    if free_space and lumen_known:
        raise OptionError("--free-space says that nothing surrounds the robot, but the plan has a lumen")
    wall = plan.verdicts.within_wall
    open_verdicts = tuple(verdict for verdict in plan.verdicts if verdict.word != YES)
    refused = [verdict for verdict in open_verdicts if not (free_space and verdict is wall and wall.word != NO)]
    if not refused or uncertified:
        return open_verdicts
    reasons = "; ".join(map(str, refused))
    remedies = []
    if any(verdict.word != NO for verdict in refused if verdict is not wall):
        remedies.append(f"`ctr-nlp robust {name}` checks stability and simulated robots")
    if wall in refused and wall.word != NO and not lumen_known:
        remedies.append("--free-space says that nothing surrounds the robot")
    remedies.append("--uncertified plays it anyway")
    raise TrajectoryError(
        f"the plan was not played, since not all of its verdicts are yes. {reasons}. " + "; ".join(remedies)
    )
