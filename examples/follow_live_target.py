"""Follow a target that is known only at the present moment: find one configuration for each new shape."""

import numpy as np

import ctr_nlp as ctr
from ctr_nlp.plan.simulation import simulate_motion

DT, SIGMA = 0.1, np.linspace(0, 1, 101)
"""Seconds from one target to the next, and normalised arc lengths of the points of a shape."""


def target(time: float) -> ctr.Curve:
    """Return the path at a time in s, 120 mm deep; its bend grows and shrinks as in a breathing lung."""
    bend = 0.004 + 0.001 * np.sin(1.5 * time)
    return ctr.curve_from_formula(lambda u: (bend * u**2, 0.0, u), 0.0, 120.0)


robot = ctr.table_i_robot()
first = ctr.Problem("first", robot, ctr.sequence([target(0.0)]))
q = ctr.solve_per_frame(first).q[0]  # where the robot stands when the target begins to move
steerer = ctr.Steerer(robot, q, DT)

for number in range(1, 31):
    path = target(number * DT)
    points = path.point(SIGMA * path.length)  # (101, 3) in mm
    q = steerer.step(points)  # within the robot's limits of speed; takes some 0.1 ms if compiled
    if number % 5 == 0:
        shape = simulate_motion(robot, q[None], "elastic").shape[0]  # (101, 3) in mm, with twisting tubes
        error = np.sqrt(np.mean(np.sum((shape - points) ** 2, axis=1)))
        print(f"{number * DT:.1f} s: error {error:.2f} mm, tubes at {q[3]:.0f}, {q[4]:.0f} and {q[5]:.0f} mm")
