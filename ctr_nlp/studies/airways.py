"""Problems of studies that are made from synthetic airways."""

from __future__ import annotations

from pathlib import Path

from ctr_nlp.anatomy.airway import synthetic_airway
from ctr_nlp.paths.placement import move_to_robot_frame
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import growing
from ctr_nlp.robot import table_i_robot

SYNTHETIC = "synthetic:"
"""Prefix, before the seed, of the names of synthetic airways in studies."""
FOLLOWED_MM = 150.0
"""Length of the last part of a synthetic airway, mm, that is followed."""


def synthetic_problem(seed: int, frames: int = 100) -> Problem:
    """Make a problem in which the paper's robot advances along the last FOLLOWED_MM of a synthetic airway.

    seed: of the generator of airways. frames: number of frames. The wall is that of the whole airway.
    """
    airway = synthetic_airway(seed=seed)
    path, to_robot = move_to_robot_frame(airway.part(airway.length - FOLLOWED_MM, airway.length))
    lumen = airway.apply_transform(to_robot)
    return Problem(f"synthetic {seed}", table_i_robot(), growing(path, frames), to_robot=to_robot, lumen=lumen)


def shown_name(problem: str) -> str:
    """Return the name of a study's problem as tables show it: a file's path loses its folder and ending."""
    return problem.replace(":", " ") if problem.startswith(SYNTHETIC) else Path(problem).stem
