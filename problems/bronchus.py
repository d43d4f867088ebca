"""From the trachea into the right lower lobe, as the paper's Fig. 9 (d), on a synthetic airway."""

from ctr_nlp import Problem, Robot, growing, table_i_robot
from ctr_nlp.anatomy.airway import synthetic_airway
from ctr_nlp.paths.placement import move_to_robot_frame


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """The last 150 mm of the airway of seed 0."""
    airway = synthetic_airway(seed=0)
    path, to_robot = move_to_robot_frame(airway.part(airway.length - 150, airway.length))
    target, lumen = growing(path, frames), airway.apply_transform(to_robot)
    return Problem("bronchus", robot or table_i_robot(), target, duration, to_robot=to_robot, lumen=lumen)
