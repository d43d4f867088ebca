"""Exact follow-the-leader deployment: the body stays on the path of the tip at every depth, in closed form.

Conditions: Gilbert, Neimat, Webster, Concentric Tube Robots as Steerable Needles: Achieving Follow-the-Leader
Deployment, IEEE Transactions on Robotics 31(2), 2015; Garriga-Casanovas, Rodriguez y Baena, Complete
Follow-the-Leader Kinematics Using Concentric Tube Robots, International Journal of Robotics Research 37(1), 2018.
Tubes of constant bending stiffness follow circles and helices, piece by piece. (The deformed helices of the latter
paper, whose curvature changes exponentially, need tubes that are not described here.)

Tubes do not twist each other where all bend in one direction, or in opposite ones, wherever they overlap: then
u x e(psi_i) = 0 in the balance of moments (models.elastic.torsion). Thus all helices have the same torsion. Tube
i advances with the tip to a depth b_i and stays there, the outermost first. A helix turns by its torsion for
each mm that it slides, and so passes every place in the same direction. Then the body keeps, between b_{i-1} and
b_i, the curvature sum EI_j k_j / sum EI_j of the tubes from i to d, with negative k of those turned by pi.

What differs from the publications: they say which paths a robot can follow so; here a path is given, and the
depths b_i and the rotation about the opening that come nearest to it are found by a grid and least squares. It is
refused where they do not meet it. Stability is checked in every frame: opposed tubes may be in an unstable
equilibrium.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.dominant.shape import backbone
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID, Frame
from ctr_nlp.robot import Robot, Tube
from ctr_nlp.robot.structure import Kind, Tubes
from ctr_nlp.typing import Array
from reference.descent import Method, extensions

ELASTIC_MODEL = KINEMATIC_MODELS["elastic"]
MAX_PATH_DEVIATION_MM = 0.02
"""Largest distance between the target and the path that the tubes follow, mm."""
GRID_POINTS_PER_DEPTH = 11
"""Grid points of each depth b_i, from which least squares start."""
MAX_TORSION_DIFFERENCE_RAD_PER_MM = 1e-9
"""Largest difference between the tubes' torsions, rad/mm."""


class Deployment(NamedTuple):
    """A follow-the-leader deployment in closed form.

    depths: b (d,), where tubes stop, mm. opposed: (d,), whether a tube is turned by pi. turned: rotation of the
    whole robot about the opening.
    """

    depths: Array
    opposed: Array
    turned: Rotation

    def configuration_at(self, robot: Robot, depth: float) -> Array:
        """Return the configuration q (2d + 2,) of a robot whose tip is at a depth, mm."""
        # R = Ry(theta_y) Rx(theta_x) Rz(turn): the last factor turns all tubes, and so belongs to alpha.
        theta_y, theta_x, turn = self.turned.as_euler("YXZ")
        beta = np.minimum(self.depths, depth)
        spins, curved = (
            np.array([getattr(tube, name) for tube in robot.tube_numbers]) for name in ("spin", "curved_length")
        )
        # alpha is the direction where the curved part begins, curved_length - beta behind the opening. So a helix
        # turns by its torsion per mm as it slides, and passes the opening in one direction at all times.
        alpha = turn + np.pi * self.opposed - spins * (curved - beta)
        return np.concatenate([alpha, beta, [theta_x, theta_y]])


def follow_the_leader(problem: Problem, motion_weight: float) -> Method:
    """Return the method for a problem; `motion_weight` is ignored, as is the frame before.

    Raises OptionError, which names the condition that the problem's robot or path does not fulfil.
    """
    del motion_weight
    robot = problem.robot
    found = find_deployment(problem)

    def solve(frame: Frame, guess: Array, before: FrameResult | None) -> FrameResult:
        q = found.configuration_at(robot, frame.length)
        x = ELASTIC_MODEL.guess(robot, q)
        away = np.linalg.norm(ELASTIC_MODEL.points(robot, x[None], SIGMA_GRID)[0] - frame.points, axis=1)
        return FrameResult(q, True, float((away**2).mean()), np.nan, 1, f"within {away.max():.2g} mm", x=x)

    return solve


def find_deployment(problem: Problem) -> Deployment:
    """Find the deployment that follows a problem's path; raises OptionError as follow_the_leader does."""
    robot = problem.robot
    name = problem.name or "the problem"
    torsion = _torsion(robot)
    path = growing_path(problem, "follow-the-leader")
    known = [
        best
        for signs in _opposed_choices(robot)
        if (best := _fit_deployment(robot, torsion, signs, path)) is not None
    ]
    if not known:
        raise OptionError(
            f"follow-the-leader keeps straight parts inside, and {name} is {path.length:.4g} mm long: the curved "
            f"part and the limits of beta of the innermost tube do not reach so far"
        )
    found, away = min(known, key=lambda each: each[1])
    if away > MAX_PATH_DEVIATION_MM:
        raise OptionError(
            f"follow-the-leader needs pieces of the curvatures that tubes together have, of torsion {torsion:g} "
            f"rad/mm, one after the other: {name} is up to {away:.3g} mm away from the nearest such path"
        )
    for frame in problem.target_frames:
        q = found.configuration_at(robot, frame.length)
        try:
            robot.check(q, f"follow-the-leader in frame {frame.number + 1}")
        except RobotError as error:
            raise OptionError(str(error)) from error
        if ELASTIC_MODEL.margins(robot, ELASTIC_MODEL.guess(robot, q)[None])[0] <= 0:
            raise OptionError(
                f"follow-the-leader is not stable in frame {frame.number + 1} of {name}: tubes snap round"
            )
    return found


def growing_path(problem: Problem, method: str) -> Frame:
    """Return the target of the last frame, of which the targets of all frames are first parts.

    problem: whose target is checked. method: its name in the message. Raises OptionError where the target is not
    one path that grows.
    """
    curves = problem.target.curves
    lengths = np.array(problem.target.lengths)
    if any(curve is not curves[0] for curve in curves) or (np.diff(lengths) < 0).any():
        raise OptionError(f"{method} follows one path that grows, and the target of {problem.name} is none")
    return problem.target_frames[-1]


def _torsion(robot: Robot) -> float:
    """Return the torsion that all curved tubes have, rad/mm.

    Raises OptionError where torsions differ or a curvature is not constant.
    """
    kinds = robot.structure.kinds
    spins = [tube.pre_torsion for tube in robot.tubes]
    curved = [i for i, kind in enumerate(kinds) if kind != "straight"]
    for i in curved:
        if kinds[i] == "linear":
            raise OptionError(f"follow-the-leader needs constant curvatures, and that of tube {i + 1} changes")
        if abs(spins[i] - spins[curved[0]]) > MAX_TORSION_DIFFERENCE_RAD_PER_MM:
            raise OptionError(
                f"follow-the-leader needs one torsion, and those of tubes {curved[0] + 1} and {i + 1} are "
                f"{spins[curved[0]]:g} and {spins[i]:g} rad/mm"
            )
    return spins[curved[0]] if curved else 0.0


def _opposed_choices(robot: Robot) -> Iterator[Array]:
    """Yield every choice (d,) of tubes that are turned by pi against the outermost curved one.

    That one has no choice: turning all tubes by pi turns the robot, which the rotation about the opening does.
    """
    free = [i for i, kind in enumerate(robot.structure.kinds) if kind != "straight"][1:]
    for turned in itertools.product((False, True), repeat=len(free)):
        found = np.zeros(robot.d, dtype=bool)
        found[free] = turned
        yield found


def _fit_deployment(robot: Robot, torsion: float, opposed: Array, path: Frame) -> tuple[Deployment, float] | None:
    """Find the deployment whose path is nearest to `path`, and its largest distance from it, mm.

    torsion: rad/mm. opposed: (d,), the tubes turned by pi. None where the curved parts are too short.
    """
    # Straight parts stay inside: a tube is out by its curved length at most.
    beta = [(low, min(high, tube.curved_length)) for tube, low, high in _extension_limits(robot)]
    low, high = beta[-1]
    if not low <= path.length <= high * (1 + MAX_TORSION_DIFFERENCE_RAD_PER_MM):
        return None
    within = robot.with_limits(beta=beta)
    last = np.array(path.length)
    tubes = _combine_tubes(robot, torsion, opposed)

    def away(parts: Array) -> tuple[Rotation, Array]:
        shape = _shape(tubes, extensions(within, parts, last))
        # The best rotation for given depths is known in closed form (Kabsch), so that depths alone are searched.
        # Shape and path begin at the origin, so there is no translation.
        turned, _ = Rotation.align_vectors(path.points, shape)
        return turned, path.points - turned.apply(shape)

    # The distance may have several minima over the depths: a coarse grid first, then least squares from its best
    # point.
    tried = itertools.product(np.linspace(0.0, 1.0, GRID_POINTS_PER_DEPTH), repeat=robot.d - 1)
    parts = min((np.array(each) for each in tried), key=lambda each: (away(each)[1] ** 2).sum())
    if robot.d > 1:
        parts = least_squares(lambda each: away(each)[1].ravel(), parts, bounds=(0.0, 1.0), xtol=1e-12).x
    turned, rest = away(parts)
    largest = float(np.linalg.norm(rest, axis=1).max())
    return Deployment(extensions(within, parts, last), opposed, turned), largest


def _extension_limits(robot: Robot) -> Iterator[tuple[Tube, float, float]]:
    """Yield every tube with its least and its largest beta, mm."""
    low, high = (robot.split(ends)[1].tolist() for ends in (robot.lower, robot.upper))
    return zip(robot.tubes, low, high, strict=True)


def _combine_tubes(robot: Robot, torsion: float, opposed: Array) -> Tubes:
    """Return tubes each of which alone has the curvature of itself and all tubes within it together.

    torsion: of all, rad/mm. opposed: (d,), the tubes turned by pi, whose curvature counts negative.
    """
    stiffness = np.array([tube.bending_stiffness for tube in robot.tubes])
    pull = stiffness * [tube.largest_curvature for tube in robot.tubes] * np.where(opposed, -1, 1)
    # On the dominant model tube i alone shapes the part up to b_i: give it sum EI_j k_j / sum EI_j, j = i..d.
    inwards = slice(None, None, -1)
    curvature = (np.cumsum(pull[inwards]) / np.cumsum(stiffness[inwards]))[inwards].tolist()
    numbers = zip(robot.tube_numbers, curvature, strict=True)
    return tuple(
        tube._replace(kind=_kind(k, torsion), root_curvature=k, tip_curvature=k, pre_torsion=torsion)
        for tube, k in numbers
    )


def _kind(curvature: float, torsion: float) -> Kind:
    """Return the kind of a single tube with the curvature, possibly 0, and torsion that several have together."""
    if torsion:
        return "helix"
    return "arc" if curvature else "straight"


def _shape(tubes: Tubes, beta: Array) -> Array:
    """Compute the points (101, 3) in mm of tubes that stop at beta (d,) mm and bend towards x at the opening."""
    turns = [-tube.spin * (tube.curved_length - out) for tube, out in zip(tubes, beta, strict=True)]
    return np.stack(
        np.broadcast_arrays(*backbone(tubes, [*turns, *beta, 0.0, 0.0], SIGMA_GRID, np).points), axis=-1
    )
