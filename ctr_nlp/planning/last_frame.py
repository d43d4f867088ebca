"""The last frame of a motion within a lumen's wall: whether there is anything to plan.

A motion ends well only if some configuration keeps off the wall and brings the tip to the target. Such
configurations of the last frame alone are found in about a second, where a motion takes many.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctr_nlp.ocp.frame_solver import FrameResult, distinct_results
from ctr_nlp.planning.nlp_frames import NlpFrames

MAX_FREE_SOLUTIONS = 12
"""Largest number of solutions without the wall from which solutions within it are looked for."""


@dataclass(frozen=True, eq=False)
class LastFrame:
    """A solution of a motion's last frame within the wall.

    Attributes
    ----------
    result : FrameResult
        The configuration.
    contact : float
        Depth by which the robot presses into the wall, mm; 0 where it keeps off.
    missed : float
        Distance from the tip to the target's end, mm.
    excess : float
        How far contact and distance are beyond what is allowed, mm; 0 where the motion would end well.
    """

    result: FrameResult
    contact: float
    missed: float
    excess: float

    @property
    def rank(self) -> tuple[float, float]:
        """Order of solutions, the best first: by excess, then by objective."""
        return self.excess, float(self.result.objective)


def measure_last_frame(frames: NlpFrames, result: FrameResult) -> LastFrame:
    """Measure contact and arrival in a solution of the last frame.

    Parameters
    ----------
    frames : NlpFrames
        Solver of the problem's frames, with a wall.
    result : FrameResult
        A solution.

    Returns
    -------
    LastFrame
        The solution with its measures.
    """
    assert frames.wall is not None
    x = (result.q if result.x is None else result.x)[None]
    last = frames.problem.target_frames[-1]
    slack = float(frames.wall.local_parameters_during([last])(x)[1][0])
    tip = frames.model.points(frames.problem.robot, x, np.ones(1))[0, -1]
    # The slack includes the clearance that is asked for.
    contact = max(slack - frames.settings.clearance, 0.0)
    missed = float(np.linalg.norm(tip - last.points[-1]))
    deep = max(contact - frames.settings.contact_allowed, 0.0)
    return LastFrame(result, contact, missed, deep + max(missed - frames.settings.arrival_tolerance, 0.0))


def solve_last_frame_near(frames: NlpFrames, known: FrameResult) -> LastFrame | None:
    """Solve the last frame within the wall near a known configuration; None where that fails.

    Parameters
    ----------
    frames : NlpFrames
        Solver of the problem's frames, with a wall.
    known : FrameResult
        A configuration, of this robot or of a similar one.

    Returns
    -------
    LastFrame or None
        The solution.
    """
    found = replace(frames, active_wall=frames.wall).search_near(frames.problem.frames - 1, known)
    return measure_last_frame(frames, found) if found.success else None


def solve_last_frame(frames: NlpFrames) -> list[LastFrame]:
    """Search for solutions of the last frame within the wall, near those that there are without it.

    Parameters
    ----------
    frames : NlpFrames
        Solver of the problem's frames, with a wall; at least two frames.

    Returns
    -------
    list of LastFrame
        Distinct solutions, the best first; none where no start was solved.
    """
    free = frames.search(frames.problem.frames - 1)[:MAX_FREE_SOLUTIONS]
    solved = (solve_last_frame_near(frames, one) for one in free if one.success)
    found = [one for one in solved if one is not None]
    # Solutions without the wall that differ may lead to the same one within it.
    distinct = distinct_results([one.result for one in found])
    return sorted((one for one in found if any(one.result is each for each in distinct)), key=lambda one: one.rank)
