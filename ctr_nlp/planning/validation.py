"""Validation of a planner's arguments, and of problems without a feasible motion, before anything is solved.

Growth of the path and given ends are compared with the robot's speeds and accelerations: a solver would only
report that it did not converge, and after minutes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.optimize import linprog

from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.models import Model
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.settings import Settings, check_motion_weight
from ctr_nlp.ocp.terms import Term
from ctr_nlp.paths.problem import MAX_TARGET_LENGTH_RATIO, Problem
from ctr_nlp.support.value_checks import check_choice, check_instance, floats, whole_number
from ctr_nlp.typing import Array

Direction = Literal["forward", "backward", "best"]

DIRECTIONS = ("forward", "backward", "best")
MIN_ANGLE_TO_POLE_RAD = 0.1
"""Least angle between a loaded robot's base tangent and the y axis, rad: at 0 the tilt is singular."""
IMPOSSIBLE_MOTION_RELATIVE_SLACK = 1e-6
"""Relative amount by which limits may be exceeded before a motion counts as impossible."""


def check_problem_and_settings(problem: Any, settings: Any) -> None:
    """Raise ProblemError or OptionError unless `problem` is a Problem and `settings` are Settings."""
    check_instance(ProblemError, "problem", problem, Problem)
    check_instance(OptionError, "settings", settings, Settings)


def check_model(problem: Problem, model: Model) -> None:
    """Raise LoadError or RobotError where a robot does not suit a model, ProblemError near the pole of the tilt.

    problem: with the robot and the target. Programs of a single frame, and those within a wall, have the direction
    of a loaded robot's tip as unknown, and compute theta from the base's direction. At theta_x = 90 deg theta_y is
    undetermined, and would have to turn by half a turn in one frame.
    """
    model.check_planning(problem.robot)
    if model.applied_load is None:
        return
    base = np.array([sample.tangents[0] for sample in problem.target_frames])
    # The angle to the y axis, either direction of it: at 0, eq. (4) has theta_x = 90 deg. The target's first
    # tangent stands for the robot's, which is not known yet.
    away = np.arctan2(np.hypot(base[:, 0], base[:, 2]), abs(base[:, 1]))
    frame = int(away.argmin())
    if away[frame] < MIN_ANGLE_TO_POLE_RAD:
        raise ProblemError(
            f"the target of {problem.name} begins {away[frame]:.2f} rad from the y axis of the base in frame "
            f"{frame + 1}, where theta_x is 90 deg; under a load it must stay {MIN_ANGLE_TO_POLE_RAD:g} rad "
            f"away where frames "
            "are planned one by one, or within a wall. Plan over a horizon and free of the wall, or turn the "
            "problem about the z axis of the base"
        )


def checked_ends(
    problem: Problem, direction: Direction, start: npt.ArrayLike | None, end: npt.ArrayLike | None = None
) -> tuple[Array | None, Array | None]:
    """Return the given start and end of a motion, q (2d + 2,) or None, as arrays.

    problem: whose robot's limits they must keep. direction: order of frames, with which a start must agree. Raises
    RobotError where an end violates the limits, and OptionError.
    """
    check_choice("direction", direction, DIRECTIONS)
    if start is not None and direction == "backward":
        raise OptionError("direction is 'backward' and a start is given; a motion from a start goes forward")
    check = problem.robot.check
    return None if start is None else check(start, "start"), None if end is None else check(end, "end")


def check_search(motion_weight: float | None, starts: int | None, jobs: int) -> None:
    """Raise OptionError unless motion_weight (s^2), starts and jobs are numbers that a search can have."""
    for name, count in (("starts", starts), ("jobs", jobs)):
        if count is not None:
            whole_number(OptionError, name, count)
    if motion_weight is not None:
        check_motion_weight(motion_weight)


def checked_motions(problem: Problem, initial: Sequence[npt.ArrayLike]) -> list[Array]:
    """Return the motions `initial` of a problem, each (T, 2d + 2), as arrays; raises OptionError."""
    if not isinstance(initial, Sequence | np.ndarray) or isinstance(initial, str):
        raise OptionError(f"initial is {initial!r:.80}; it must be a sequence of motions")
    expected = (problem.frames, len(problem.robot.axes))
    return [floats(OptionError, "a motion of initial", motion, expected) for motion in initial]


def checked_terms(terms: Sequence[Term]) -> tuple[Term, ...]:
    """Return further terms of the objective as a tuple; raise OptionError unless they are terms."""
    for term in terms if isinstance(terms, Sequence) else [terms]:
        check_instance(OptionError, "a term", term, Term)
    return tuple(terms)


def check_growth(problem: Problem) -> None:
    """Raise ProblemError where a problem's path grows or shrinks faster than the innermost tube may slide.

    As for a path that is too long, 0.5 % of the robot's reach is accepted: a tube may be ahead of the path, or
    behind it, where the path is fast for a moment.
    """
    speed = float(problem.robot.speed[2 * problem.robot.d - 1])
    if not np.isfinite(speed):
        return
    lengths = np.asarray(problem.target.lengths)
    time = problem.dt * np.arange(1, problem.frames + 1)
    # beta_d is the robot's length, so that its speed bounds that of the path. The lag is the largest length by
    # which the path gets ahead of a tube at full speed between any two frames; negated, for a path that shrinks.
    late = np.array([_largest_rise(lengths - speed * time), _largest_rise(-lengths - speed * time)])
    # Half: the tube may be ahead of the path at one end of the interval, and behind it at the other.
    worst = int(late[:, 0].argmax())
    lag = float(late[:, 0].max()) / 2
    if lag > (MAX_TARGET_LENGTH_RATIO - 1) * problem.robot.reach:
        _, first, last = late[worst]
        i = int(first)
        j = int(last)
        needed = abs(lengths[j] - lengths[i]) / (time[j] - time[i])
        raise ProblemError(
            f"the path of {problem.name} changes its length by {abs(lengths[j] - lengths[i]):.1f} mm from frame "
            f"{i + 1} to {j + 1}, at {needed:.1f} mm/s; beta_{problem.robot.d} may slide at {speed:g} mm/s. "
            f"Raise its speed, or give a duration of at least {problem.duration * needed / speed:.1f} s"
        )


def _largest_rise(ahead: Array) -> tuple[float, int, int]:
    """Return the largest rise ahead[j] - ahead[i] over i < j, with i and j, in one pass over running minima."""
    lowest = np.minimum.accumulate(ahead)
    j = int((ahead - lowest).argmax())
    i = int(ahead[: j + 1].argmin())
    return float(ahead[j] - ahead[i]), i, j


def check_ends(problem: Problem, chain: Chain) -> None:
    """Raise ProblemError where no motion between two given ends keeps limits, order, speeds and accelerations.

    problem: robot and target. chain: of all frames. A linear program finds the least factor f by which all bounds
    on speeds v and accelerations a would have to grow:

        min f  over x and f  subject to  lower <= x <= upper,  the order of tubes,
        |q_{j+1} - q_j| <= f v dt,  |q_{j+1} - 2 q_j + q_{j-1}| <= f a dt^2

    All of these are linear in x. Constraints of frames that are not linear are left out: what is impossible
    without them is so with them.
    """
    # Any point will do to take derivatives at, as the rows are linear.
    x0 = np.clip(np.zeros(chain.lower.size), chain.lower.ravel(), chain.upper.ravel())
    at = chain.slopes(x0)
    size = x0.size
    rows = size + np.flatnonzero(np.tile(~chain.frame.g_nonlinear, chain.frames))
    # Rows of a chain are x, then the frames' constraints, then links between frames: speeds and accelerations.
    links = np.arange(at.value.size - len(chain.offset), at.value.size)
    own = sp.block_diag(list(at.jacobian), format="csr")[rows - size]
    matrix = sp.csr_array(sp.vstack([own, chain.linking[:, :size]]))
    picked = np.concatenate([rows, links])
    # The constant part of each row: value(x) = matrix x + shift.
    shift = at.value[picked] - matrix @ x0
    grows = np.isin(picked, links)
    sides = []
    for sign, bound in ((1.0, chain.bounds[1][picked]), (-1.0, -chain.bounds[0][picked])):
        some = np.flatnonzero(np.isfinite(bound))
        factor = sp.csr_array(np.where(grows, bound, 0.0)[some, None])
        right = np.where(grows, 0.0, bound)[some] - sign * shift[some]
        # One-sided rows: sign (matrix x + shift) <= bound, where the bound of a link is f times its own.
        sides.append((some, sp.hstack([sign * matrix[some], -factor]), right))
    index, matrices, rights = (list(part) for part in zip(*sides, strict=True))
    cost = np.append(np.zeros(size), 1.0)
    bounds = [*zip(chain.lower.ravel(), chain.upper.ravel(), strict=True), (0.0, None)]
    found = linprog(cost, sp.vstack(matrices), np.concatenate(rights), bounds=bounds)
    if not found.success:
        raise ProblemError(f"no motion leads from start to end within limits and order: {found.message}")
    if found.x[-1] > 1 + IMPOSSIBLE_MOTION_RELATIVE_SLACK:
        # The row with the most negative multiplier is the limit that f depends on most: it is named to the user.
        name, frame = chain.describe_row(int(picked[np.concatenate(index)[found.ineqlin.marginals.argmin()]]))
        raise ProblemError(
            f"no motion leads from start to end in {problem.duration:g} s: {name} would have to be "
            f"{found.x[-1]:.2f} times what is allowed, at frame {frame} among others. Raise that limit, give a "
            "longer duration, or ends that are closer"
        )
