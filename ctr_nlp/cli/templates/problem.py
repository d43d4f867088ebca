"""A problem: a robot and the shapes that it is to take. Plan it with `ctr-nlp plan` and the name of this file."""

import casadi as ca

from ctr_nlp import Problem, Robot, curve_from_formula, growing, table_i_robot


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """What `ctr-nlp plan` calls with --frames, --duration in s, and --robot, which is None where not given."""

    def path(u: ca.SX) -> tuple[ca.SX, float, ca.SX]:
        """A point (x, y, z) in mm at each u. At first it is the origin, where the robot enters, and goes along z.

        Use CasADi's functions (ca.sin, ca.cos, ca.sqrt, ...): curvatures are derivatives of this formula.
        """
        return 10 * (1 - ca.cos(0.02 * u)), 0.0, u

    # The part of the path between these two u; no longer than the robot reaches, 150 mm for the paper's robot.
    # Points instead of a formula: ctr_nlp.curve_from_points(points), points an array (n, 3) in mm.
    curve = curve_from_formula(path, 0.0, 140.0)

    # growing: the robot advances along the path, a little further in each frame, and has arrived in the last one.
    # Shapes that move in another way: ctr_nlp.sequence([curve of frame 1, curve of frame 2, ...]).
    target = growing(curve, frames)

    # Other tubes: Robot.from_toml("robot.toml"), after `ctr-nlp new robot robot.toml`.
    return Problem("mine", robot or table_i_robot(), target, duration)
