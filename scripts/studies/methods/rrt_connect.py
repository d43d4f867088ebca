"""Sampling-based planning within a lumen: RRT-Connect on the elastic model, by the library OMPL.

Kuffner, LaValle, RRT-Connect: An Efficient Approach to Single-Query Path Planning, ICRA 2000; Sucan, Moll,
Kavraki, The Open Motion Planning Library, IEEE Robotics & Automation Magazine 19(4), 2012. Two trees grow, from
start and goal, in the unknowns x of the model, of which each is an equilibrium: the robot can really execute a
path along which the stability margin is positive. A state is valid where it satisfies the limits and the margin,
and is nowhere further beyond the wall than allowed. The path leads from a solution of the target's first frame to
one of its last, and is shortened afterwards; frames between are ignored.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt
from reference.descent import extensions, fractions
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.lumen import outermost_tube_radii
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.planning.per_frame import solve_per_frame
from ctr_nlp.support.extras import import_extra
from ctr_nlp.support.value_checks import floats, number
from ctr_nlp.typing import Array

RRT_SEARCH_S, RRT_SHORTENING_S = 60.0, 10.0
"""Time for the search, and for shortening its path, s."""
RRT_RANGE_MM, RRT_RESOLUTION = 20.0, 0.005
"""Largest length of a branch of a tree, mm, and the spacing of states that are checked along it, relative to the
extent of the space.
"""
MAX_TILT_DEVIATION_RAD = 0.5
"""Largest difference of tilts from the first frame's, rad."""
WALL_CHECK_SIGMA, LUMEN_SAMPLE_SPACING_MM, WALL_CHECK_MARGIN_MM = SIGMA_GRID[::2], 0.1, 0.01
"""Normalised arc lengths of the robot that are checked against the wall; spacing of samples of the lumen's
centreline, mm; and a margin for what lies between both, mm.
"""
RRT_STATE_SCALE_MM = 20.0, 40.0, 50.0
"""Scales of the search space, mm: of a radian of a tube, of the whole range of an outer tube's extension, and of a
radian of tilt.
"""
ELASTIC_MODEL = KINEMATIC_MODELS["elastic"]


class SearchSpace:
    """Search space of the trees, and the validity of its states.

    A point is (the unknowns' d angles, fractions of the d - 1 outer extensions, beta_d, theta), scaled to mm.
    """

    def __init__(self, problem: Problem, settings: Settings) -> None:
        """Prepare the space of a problem; settings: margin and allowed contact.

        Raises OptionError where the problem has no wall.
        """
        lumen = problem.lumen
        if lumen is None or lumen.radius is None:
            name = problem.name or "the problem"
            raise OptionError(f"rrt-connect plans within a lumen, and {name} has none with a radius")
        self.robot = problem.robot
        self._settings = settings
        self.checked_points = 0
        places = np.arange(0.0, lumen.length, LUMEN_SAMPLE_SPACING_MM)
        self._tree = cKDTree(lumen.point(places))
        self._radius = lumen.radius(places)
        d = self.robot.d
        turn, room, tilt = RRT_STATE_SCALE_MM
        self._scale = np.concatenate([np.full(d, turn), np.full(d - 1, room), [1.0], np.full(2, tilt)])

    def to_point(self, x: Array) -> Array:
        """Return the point (2d + 2,), mm, of unknowns x (2d + 2,)."""
        d = self.robot.d
        parts = fractions(self.robot, x[d : 2 * d])[:-1]
        return np.asarray(self._scale * np.concatenate([x[:d], parts, x[2 * d - 1 :]]))

    def unknowns(self, place: Array) -> Array:
        """Return the unknowns x (2d + 2,) of a point `place` (2d + 2,), mm."""
        d = self.robot.d
        values = place / self._scale
        beta = extensions(self.robot, values[d : 2 * d - 1], values[2 * d - 1])
        return np.concatenate([values[:d], beta, values[2 * d :]])

    def bounds(self, known: Array) -> tuple[Array, Array]:
        """Return lower and upper bounds (2d + 2,) of points, mm.

        They include the points `known` (n, 2d + 2), of which the first is the start.
        """
        d, (low, high) = self.robot.d, (self.robot.lower, self.robot.upper)
        beta = slice(d, 2 * d - 1)
        theta = slice(2 * d, None)
        low, high = (np.where(np.isfinite(each), each, sign * np.pi) for each, sign in ((low, -1), (high, 1)))
        # RRT samples a bounded box: one turn for tubes, whose limits _within_angle_limits checks, fractions in
        # [0, 1], and tilts near the start's.
        low[:d], high[:d], low[beta], high[beta] = -np.pi, np.pi, 0.0, 1.0
        middle = known[0, theta] / self._scale[theta]
        low[theta] = np.maximum(low[theta], middle - MAX_TILT_DEVIATION_RAD)
        high[theta] = np.minimum(high[theta], middle + MAX_TILT_DEVIATION_RAD)
        # Start and goal may have turned by more than pi; OMPL refuses states out of bounds.
        return np.minimum(low * self._scale, known.min(axis=0)), np.maximum(high * self._scale, known.max(axis=0))

    def is_valid_point(self, place: Array) -> bool:
        """Return whether the robot is within lumen, margin and limits at a point `place` (2d + 2,), mm."""
        self.checked_points += 1
        return self.is_valid_robot(self.unknowns(place))

    def is_valid_robot(self, x: Array) -> bool:
        """Return whether the robot with unknowns x (2d + 2,) is within the lumen, stable and within its limits."""
        d = self.robot.d
        robot = self.robot
        points = ELASTIC_MODEL.points(robot, x[None], WALL_CHECK_SIGMA)[0]
        distance, nearest = self._tree.query(points)
        # The distance to a sample of the centreline is never less than that to the centreline: on the safe side.
        over = (
            distance + outermost_tube_radii(robot, x[None, d : 2 * d], WALL_CHECK_SIGMA)[0] - self._radius[nearest]
        )
        if over.max() > self._settings.contact_allowed - WALL_CHECK_MARGIN_MM:
            return False
        margin = self._settings.stability_margin
        stable = margin is None or ELASTIC_MODEL.margins(robot, x[None])[0] > margin
        return bool(stable and self._within_angle_limits(x))

    def _within_angle_limits(self, x: Array) -> bool:
        """Return whether motors keep limits that the box of the space does not have: those of alpha, at x."""
        robot = self.robot
        d = self.robot.d
        if not np.isfinite([robot.lower[:d], robot.upper[:d]]).any():
            return True
        q = ELASTIC_MODEL.configuration(robot, x[None])[0]
        return bool((q >= robot.lower).all() and (q <= robot.upper).all())


def rrt_connect(
    problem: Problem,
    settings: Settings | None = None,
    *,
    start: npt.ArrayLike | None = None,
    end: npt.ArrayLike | None = None,
    seconds: float = RRT_SEARCH_S,
    seed: int = 1,
) -> Plan:
    """Find a path through the lumen to the pose of the last frame, as a plan with frames evenly along it.

    problem: robot, target and lumen. settings: of these, stability_margin and contact_allowed define valid states.
    start, end: configurations (2d + 2,) of start and goal, at rest; by default those of the first and last frame
    planned alone. seconds: time limit of the search. seed: of OMPL's random numbers. Where no path is found, no
    frame counts as solved, and the robot stands still. Raises OptionError where the problem has no wall, start or
    goal is not valid, or OMPL is not installed.
    """
    number(OptionError, "seconds", seconds, lambda value: 0.1 <= value <= 1e5, "lie in [0.1, 1e5]", " s")
    ompl = import_extra("ompl")
    settings = settings or Settings()
    room = SearchSpace(problem, settings)
    begin = time.perf_counter()
    given = zip((start, end), (0, problem.frames - 1), strict=True)
    ends = [_valid_end(problem, room, settings, q, frame) for q, frame in given]
    build = time.perf_counter() - begin
    path = _search_path(ompl, room, np.array([room.to_point(x) for x in ends]), seconds, seed)
    found = path is not None
    x = np.repeat(ends[:1], problem.frames, axis=0) if path is None else _resample_path(room, path, problem.frames)
    why = {} if found else {str(j + 1): f"no path was found within {seconds:g} s" for j in range(problem.frames)}
    unknown = np.full(problem.frames, np.nan)
    meta = {
        "formulation": "rrt-connect",
        "model": ELASTIC_MODEL.name,
        "solver": "ompl",
        "options": settings.options() | {"seconds": seconds, "seed": seed, "direction": "forward"},
        "build_s": build,
        "search_s": time.perf_counter() - begin - build,
        "interrupted": False,
        "contact_weight": None,
        "iterations": room.checked_points,
        "failures": why,
    }
    q = ELASTIC_MODEL.configuration(problem.robot, x)
    solved = np.full(problem.frames, found)
    q[:, : problem.robot.d] = np.unwrap(q[:, : problem.robot.d], axis=0)
    return plan_from_configurations(
        problem, q, meta, success=solved, solve_time=unknown, objective=unknown, kkt=unknown, planned=x
    )


def _valid_end(
    problem: Problem, room: SearchSpace, settings: Settings, q: npt.ArrayLike | None, frame: int
) -> Array:
    """Return the unknowns (2d + 2,) of a robot at rest at q (2d + 2,), or as planned for a frame alone.

    frame: from 0; counts where q is None. Raises OptionError where the state is not valid.
    """
    if q is None:
        q = solve_per_frame(problem[frame : frame + 1], model=ELASTIC_MODEL, settings=settings).q[0]
    x = ELASTIC_MODEL.rest(problem.robot, floats(OptionError, "start or end", q, (len(problem.robot.axes),)))
    if np.isfinite(x).all() and room.is_valid_robot(x):
        return x
    raise OptionError(
        f"rrt-connect finds no valid robot for frame {frame + 1} of {problem.name or 'the problem'}: in the "
        f"lumen but for {settings.contact_allowed:g} mm, and {settings.stability_margin or 0:g} from the snap; "
        f"tubes that fit the lumen (ctr-nlp design) may do"
    )


def _search_path(ompl: Any, room: SearchSpace, ends: Array, seconds: float, seed: int) -> Array | None:
    """Search a path between the points `ends` (2, 2d + 2), and shorten it; None where none is found in time.

    The path has points (n, 2d + 2), mm. seconds: time limit.
    """
    base = ompl.base
    geometric = ompl.geometric
    util = ompl.util
    util.noOutputHandler()
    # Before anything of OMPL is created: generators take their seeds when they are made. The limits are times, so
    # that equal seeds need not give equal paths.
    util.RNG.setSeed(seed)
    size = ends.shape[1]
    space = base.RealVectorStateSpace(size)
    bounds = base.RealVectorBounds(size)
    for i, (low, high) in enumerate(zip(*room.bounds(ends), strict=True)):
        bounds.setLow(i, float(low))
        bounds.setHigh(i, float(high))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()
    setup.setStateValidityChecker(lambda state: room.is_valid_point(np.array([state[i] for i in range(size)])))
    information.setStateValidityCheckingResolution(RRT_RESOLUTION)
    states = [space.allocState() for _ in ends]
    for state, values in zip(states, ends, strict=True):
        for i, value in enumerate(values):
            state[i] = float(value)
    setup.setStartAndGoalStates(*states)
    planner = geometric.RRTConnect(information)
    planner.setRange(RRT_RANGE_MM)
    setup.setPlanner(planner)
    setup.solve(seconds)
    # An approximate path, which ends near the goal, does not count.
    if not setup.haveExactSolutionPath():
        return None
    setup.simplifySolution(RRT_SHORTENING_S)
    path = setup.getSolutionPath()
    return np.array([[path.getState(k)[i] for i in range(size)] for k in range(path.getStateCount())])


def _resample_path(room: SearchSpace, path: Array, frames: int) -> Array:
    """Return unknowns (frames, 2d + 2) at points spaced evenly along a path of points (n, 2d + 2), mm."""
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    at = np.linspace(0.0, along[-1], frames)
    places = np.column_stack([np.interp(at, along, column) for column in path.T])
    return np.array([room.unknowns(place) for place in places])
