"""Planning frame by frame within the lumen's wall, started from the first frame of the motion without the wall.

Contact costs w for each mm of slack, an exact penalty (docs/method.md, "The lumen's wall"). Where fewer frames of
the motion without the wall fail, that is the plan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ctr_nlp.ocp.wall import Wall
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import find_off_branch_frames
from ctr_nlp.plan.simulation import Simulation, Simulator
from ctr_nlp.planning.marching import Pass, run_again
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.planning.stability_refinement import refine_pass_margins
from ctr_nlp.typing import Array, Flags


def failed_frames(problem: Problem, simulation: Simulation, x: Array, success: Flags) -> int:
    """Count the frames that were not solved, or in which the simulated robot is on another branch than planned.

    Parameters
    ----------
    problem : Problem
        Robot and target.
    simulation : Simulation
        The robot, simulated through the motion.
    x : ndarray
        Unknowns (T, n) of the model that the motion was planned with.
    success : ndarray
        Whether each frame was solved, (T,).

    Returns
    -------
    int
        Number of frames.
    """
    # A frame on another branch counts as not solved: in neither is the robot where it was planned to be.
    return int((~success | find_off_branch_frames(simulation.x, x, simulation.snaps, problem.robot.d)).sum())


def run_within_wall(
    frames: NlpFrames, free: Pass, simulator: Simulator, stop: Callable[[], bool]
) -> tuple[Pass, Wall | None]:
    """Solve all frames again within the wall, starting from the first frame of a pass without it.

    Parameters
    ----------
    frames : NlpFrames
        Solver of single frames; its `wall` is the one that counts.
    free : Pass
        Pass through all frames without the wall.
    simulator : Simulator
        Simulator of the problem's robot, on the model of the plan.
    stop : callable
        Returns whether to end the work.

    Returns
    -------
    Pass, Wall or None
        The pass within the wall, and that wall; or `free` and None where more frames fail within the wall.
    """
    problem = frames.problem
    wall = frames.wall
    first = free.order[0]
    if wall is None or first not in free.results:
        return free, None

    def count_failed_frames(one: Pass) -> int:
        success = np.array([j in one.results and one.results[j].success for j in range(problem.frames)])
        return failed_frames(problem, simulator(one.motion(problem)), one.unknowns(problem), success)

    # Programs are shared; only the wall that counts in them differs.
    within = replace(frames, active_wall=wall)
    found = run_again(free, within, stop)
    if not stop():
        # Within the wall the motion is another one, whose margins between frames have to be refined again.
        found = refine_pass_margins(within, found, simulator, stop)[0]
    return (free, None) if count_failed_frames(found) > count_failed_frames(free) else (found, wall)
