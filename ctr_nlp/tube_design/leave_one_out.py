"""Leave-one-out: how many ends robots reach in an anatomy that they were not designed for.

For each anatomy, robots are designed for all others, and each of its ends is planned on every one of them. The
share of ends reached estimates the share in people whose anatomy was never seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ctr_nlp.exceptions import OptionError
from ctr_nlp.paths.problem import Problem
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.tube_design.choice import RobotChoice, compare_robots
from ctr_nlp.tube_design.co_design import design
from ctr_nlp.tube_design.groups import divide_problems


@dataclass(frozen=True)
class HeldOutEnd:
    """One end of an anatomy that was left out of a design.

    Attributes
    ----------
    anatomy : int
        Number of the anatomy, from 0.
    name : str
        Name of the problem that leads to the end.
    choice : RobotChoice
        The best of the robots that were designed for the other anatomies, with its plan.
    """

    anatomy: int
    name: str
    choice: RobotChoice


def leave_one_out(
    anatomies: Sequence[Sequence[Problem]],
    robots: int,
    *,
    nominal: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> list[HeldOutEnd]:
    """Design robots for all anatomies but one, in turn, and plan the ends of that one on them.

    Parameters
    ----------
    anatomies : sequence of sequence of Problem
        The problems of each anatomy, within walls; at least two anatomies.
    robots : int
        Number of robots that are designed.
    nominal : bool
        Whether tolerances are left out, of designs and of plans.
    progress : callable, optional
        Called as ``progress(done, total, note)`` after each anatomy.
    **options
        Further options of :func:`divide_problems`, which :func:`design` takes, too, except `walls`.

    Returns
    -------
    list of HeldOutEnd
        One for each problem, anatomy by anatomy.

    Raises
    ------
    OptionError
        There are fewer than two anatomies, or fewer problems in all but one than robots.
    KeyboardInterrupt
        Ctrl-C was pressed.
    """
    if len(anatomies) < 2:
        raise OptionError(
            f"leave-one-out needs at least two anatomies; there is {len(anatomies)}. Each file that is given "
            "counts as one"
        )
    settings = options.get("settings", DEFAULT_PLANNER_SETTINGS)
    jobs = options.get("jobs", 1)
    found = list[HeldOutEnd]()
    for number, ends in enumerate(anatomies):
        others = [problem for k, each in enumerate(anatomies) if k != number for problem in each]
        groups = divide_problems(others, robots, walls=True, **options)
        # With one group no tubes were found yet; with several, designs start from the tubes of their groups.
        starts: dict[str, Any] = {"starts": 1} if robots > 1 else {}
        made = {
            f"robot {k}": design(group, nominal=nominal, walls=True, **starts, **options).robot
            for k, group in enumerate(groups, start=1)
        }
        for problem in ends:
            best = compare_robots(problem, made, robust=not nominal, settings=settings, jobs=jobs)[0]
            found.append(HeldOutEnd(number, problem.name, best))
        if progress is not None:
            progress(number + 1, len(anatomies), f"without anatomy {number + 1}")
    return found
