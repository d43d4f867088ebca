"""Compare two robots on the same path: the paper's, and one whose tubes are bent half as much again."""

from dataclasses import replace

import numpy as np

import ctr_nlp as ctr

FRAMES = 12


def bent_more(robot: ctr.Robot, factor: float) -> ctr.Robot:
    """The same robot with every pre-curvature, in 1/mm, multiplied."""
    curvatures = (factor * np.broadcast_to(tube.curvature, 2) for tube in robot.tubes)  # at root and tip
    tubes = (replace(tube, curvature=(k[0], k[1])) for tube, k in zip(robot.tubes, curvatures, strict=True))
    return replace(robot, tubes=tuple(tubes))


seed = ctr.table_i_robot()
for name, robot in {"the paper's robot": seed, "bent half as much again": bent_more(seed, 1.5)}.items():
    for problem in ("cos", "line"):
        plan = ctr.solve_per_frame(ctr.named_problem(problem, FRAMES, robot=robot))
        print(f"{name} along {problem}: e3 {ctr.summary(plan)['e3']:.2f} mm")
