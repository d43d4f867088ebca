"""Compare two robots on the same paths: the paper's, and one with 1.5 times its pre-curvatures."""

from dataclasses import replace

import numpy as np

import ctr_nlp as ctr

FRAMES = 12


def scale_curvatures(robot: ctr.Robot, factor: float) -> ctr.Robot:
    """Return the robot with every pre-curvature multiplied by a factor."""
    curvatures = (factor * np.broadcast_to(tube.curvature, 2) for tube in robot.tubes)  # at root and tip
    tubes = (replace(tube, curvature=(k[0], k[1])) for tube, k in zip(robot.tubes, curvatures, strict=True))
    return replace(robot, tubes=tuple(tubes))


paper_robot = ctr.table_i_robot()
for name, robot in {
    "the paper's robot": paper_robot,
    "1.5 times as curved": scale_curvatures(paper_robot, 1.5),
}.items():
    for problem in ("cos", "line"):
        plan = ctr.solve_per_frame(ctr.named_problem(problem, FRAMES, robot=robot))
        print(f"{name} along {problem}: e3 {ctr.summary(plan)['e3']:.2f} mm")
