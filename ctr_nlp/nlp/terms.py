"""Named residuals and constraints that formulations add up: pure functions of symbols; no solver in sight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.models import dominant
from ctr_nlp.nlp.nlp import Constraint, Cost, Residual
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Vector


def shape(points: Vector, target: Vector, quadrature: Any) -> Residual:
    """Distance from the robot to its target at equal sigma, eq. (8).

    points, target: x, y, z, each (n, 1) mm. quadrature: (n,), non-negative, sums to 1.
    """
    root = ca.sqrt(quadrature)
    return Residual("shape", ca.vertcat(*(root * (points[i] - target[i]) for i in range(3))))


def motion(q: ca.SX, previous: ca.SX, mm_per_unit: Array, root: ca.SX) -> Residual:
    """Change of configuration over one frame, eq. (9).

    root: sqrt(lambda) / dt, with lambda in s^2 and dt in s; 0 where there is no frame before.
    """
    return Residual("motion", root * ca.DM(mm_per_unit) * (q - previous))


def motors(robot: Robot, alpha: ca.SX) -> Constraint:
    """The motors' angles within their limits, where they are not unknowns themselves."""
    return Constraint("alpha", alpha, robot.lower[: robot.d], robot.upper[: robot.d])


CLEAR = 0.05
"""What determinants before the last keep from 0: where two vanish together, an unstable shape looks stable."""


def stability(determinants: ca.SX) -> Constraint:
    """Those of stability.responses, which are positive as long as the margin is held; 1 where nothing twists."""
    count = determinants.numel()
    return Constraint("stability", determinants, np.append(np.full(count - 1, CLEAR), 0.0), np.full(count, np.inf))


FIRM = 1e-3
"""What keeps Hessians definite, where contact costs nothing too."""
CENTRED = 0.01
"""mm: what rounds off the distance to the path where that is 0."""


def clearance(points: Vector, path: Sequence[Vector], wall: Sequence[ca.SX], slack: ca.SX) -> Constraint:
    """Distance from the robot to a path within the room that the lumen leaves it, or that and a slack, mm.

    points: x, y, z, each (n, 1) mm. path: its point near to each, its tangent and its bend, 1/mm, in the same
    axes. wall, each (n, 1): the room there, mm, how much more there is a mm further, and how far the path goes on
    behind and ahead, mm.
    """
    (centre, tangent, bend), (room, taper, behind, ahead) = path, wall
    away = [points[i] - centre[i] for i in range(3)]
    further = ca.fmax(ca.fmin(sum(away[i] * tangent[i] for i in range(3)), ahead), -behind)
    across = [away[i] - further * tangent[i] - further**2 / 2 * bend[i] for i in range(3)]
    distance = ca.sqrt(sum(part**2 for part in across) + CENTRED**2)
    value = room + taper * further + slack - distance
    return Constraint("clearance", value, np.zeros(value.numel()), np.full(value.numel(), np.inf))


def contact(slack: Any, weight: Any) -> Cost:
    """An exact penalty on the depth of contact; weight: mm^2 a mm."""
    return Cost("contact", weight * slack + FIRM * slack**2)


def length(beta_d: ca.SX, target_length: ca.SX, weight: float) -> Residual:
    """Deployed length against the target's, mm; weight has no unit."""
    return Residual("length", np.sqrt(weight) * (beta_d - target_length))


def lever(robot: Robot) -> float:
    """What turns 1/mm into mm, so that stage one has the scale of shape errors: reach^2 / (2 sqrt 5), mm^2.

    A curvature error kept along the whole reach moves the points by it times s^2 / 2; this is the root mean
    square over sigma.
    """
    return robot.reach**2 / (2 * np.sqrt(5))


def curvature(robot: Robot, beta: Sequence[ca.SX], turning: ca.SX, target_length: ca.SX, width: ca.SX) -> Cost:
    """Curvature of the robot against the target's, eq. (11), its jumps smoothed over a width in mm.

    turning: (n + 1,) integral of the target's curvature in rad at uniform sigma; the target's mean over each
    cell is compared with the robot's value at its middle. As a mean over sigma, the sum cannot be made small
    by shrinking the robot. A Cost, not a Residual: what is left at the optimum is large and its second
    derivatives dominate, so that Gauss-Newton steps do not converge.
    """
    cells = turning.numel() - 1
    middle = ca.DM((np.arange(cells) + 0.5) / cells)
    mean = (turning[1:] - turning[:-1]) * (cells / target_length)
    here = dominant.curvature(robot, beta, middle * beta[-1], lambda x: smooth_step(x / width), ca)
    return Cost("curvature", lever(robot) ** 2 / cells * ca.sumsqr(here - mean))


def smooth_step(x: Any) -> Any:
    """S(x), from 0 to 1; 96 % of the rise lies in [-1, 1]."""
    return (1 + ca.tanh(2 * x)) / 2


def curvature_exact(
    robot: Robot, beta: Sequence[ca.SX], kappa: ca.SX, turning: ca.SX, target_length: ca.SX
) -> Cost:
    """The integral in eq. (11) itself, as a mean over sigma and without any smoothing of jumps.

    Per tube, the mean of (k - kappa)^2 needs the target's curvature only through its cumulative integrals
    at the tube's two ends. The mean of kappa^2, which no beta changes, is left out.
    kappa: (n + 1,) in 1/mm and turning: (n + 1,) in rad, at uniform sigma.
    """
    total, start = ca.SX(0), ca.SX(0)
    first, second = _cumulative(kappa, turning, target_length)
    for i, tube in enumerate(robot.tubes):
        low, at_low, slope = dominant.curved_part(robot, i, start, beta[i], ca)
        sigma_low, sigma_high, per_sigma = low / beta[-1], beta[i] / beta[-1], slope * beta[-1]
        width, turned = sigma_high - sigma_low, first(sigma_high) - first(sigma_low)
        own = at_low**2 * width + at_low * per_sigma * width**2 + per_sigma**2 * width**3 / 3
        mixed = at_low * turned
        if tube.root_curvature != tube.tip_curvature:
            mixed += per_sigma * (width * first(sigma_high) - second(sigma_high) + second(sigma_low))
        total += own - 2 * mixed
        start = beta[i]
    return Cost("curvature", lever(robot) ** 2 * total)


def _cumulative(kappa: ca.SX, turning: ca.SX, target_length: ca.SX) -> tuple[Any, Any]:
    """The integral over sigma of the target's curvature from 0, and that integral's own integral.

    Between grid points the first is the cubic that meets turning and kappa at both: C1 everywhere.
    """
    cells = kappa.numel() - 1
    h = 1 / cells
    nodes = ca.DM(np.arange(cells) * h)
    rise = (turning[1:] - turning[:-1]) / target_length
    a, b = kappa[:-1], kappa[1:]
    cubic = (a + b) / h**2 - 2 * rise / h**3
    square = 3 * rise / h**2 - (2 * a + b) / h
    before = turning[:-1] / target_length

    def first(sigma: ca.SX) -> ca.SX:
        c = ca.fmin(ca.fmax(sigma - nodes, 0), h)
        return ca.sum1(c * (a + c * (square + c * cubic)))

    def second(sigma: ca.SX) -> ca.SX:
        c = ca.fmin(ca.fmax(sigma - nodes, 0), h)
        return ca.sum1(c * (before + c * (a / 2 + c * (square / 3 + c * cubic / 4))))

    return first, second


def order(robot: Robot, beta: Sequence[ca.SX]) -> tuple[Constraint, ...]:
    """beta_i <= beta_{i+1}, eq. (2), and the least gap between carriages where the robot has one."""
    if robot.d == 1:
        return ()
    growth = ca.vertcat(*(beta[i + 1] - beta[i] for i in range(robot.d - 1)))
    most = np.full(robot.d - 1, np.inf)
    if robot.carriage_gap is not None:
        most = np.diff([tube.length for tube in robot.tubes]) - robot.carriage_gap
    return (Constraint("order", growth, np.zeros(robot.d - 1), most),)
