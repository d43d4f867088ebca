"""Sampling-based planning within a lumen: RRT-Connect on the elastic model, by the library OMPL.

Kuffner, LaValle, RRT-Connect: An Efficient Approach to Single-Query Path Planning, ICRA 2000; Sucan, Moll,
Kavraki, The Open Motion Planning Library, IEEE Robotics & Automation Magazine 19(4), 2012. The trees grow in the
unknowns of the model, of which each is an equilibrium: a path along which the margin is held is one that the robot
really takes. Valid is what keeps the limits and the margin and does not touch the wall. The path leads from an
answer for the target's first frame to one for its last, knows nothing of the frames between, and is made shorter
afterwards.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.frames import FrameResult
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.models import MODELS
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.reference.descent import extensions, fractions
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.passes import Progress
from ctr_nlp.support.extras import needed
from ctr_nlp.support.values import number
from ctr_nlp.target.lumen import outer_radii
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array

SECONDS, SHORTENING = 60.0, 10.0
"""s for the search, and for making its path shorter."""
RANGE, RESOLUTION = 20.0, 0.005
"""mm of a branch of the tree at most, and the part of the space's extent between two looks along it."""
SIDEWAYS = 0.5
"""rad by which tilts may differ from the first frame's."""
SAMPLES, APART = SIGMA[::2], 0.05
"""Where the wall is looked for, and mm that stay free there, as it is taken at half millimetres of the path."""
MM = 20.0, 40.0, 50.0
"""What a radian of a tube, the whole room of an outer tube and a radian of tilt count as, mm."""
ELASTIC = MODELS["elastic"]


class Room:
    """The space that the tree grows in: unknowns with fractions for extensions, in mm; what is valid there."""

    def __init__(self, problem: Problem, margin: float) -> None:
        """Raises OptionError of a problem without a wall."""
        if problem.sampled_lumen is None:
            name = problem.name or "the problem"
            raise OptionError(f"rrt-connect plans within a lumen, and {name} has none with a radius")
        self.robot, self._margin, self.looked = problem.robot, margin, 0
        table = problem.sampled_lumen.table
        self._tree, self._radius = cKDTree(table[:, :3]), table[:, 3]
        d = self.robot.d
        turn, room, tilt = MM
        self._scale = np.concatenate([np.full(d, turn), np.full(d - 1, room), [1.0], np.full(2, tilt)])

    def place(self, x: Array) -> Array:
        """The point (2d + 2,) of unknowns x (2d + 2,)."""
        d = self.robot.d
        parts = fractions(self.robot, x[d : 2 * d])[:-1]
        return np.asarray(self._scale * np.concatenate([x[:d], parts, x[2 * d - 1 :]]))

    def unknowns(self, place: Array) -> Array:
        """The x (2d + 2,) of a point."""
        d, values = self.robot.d, place / self._scale
        beta = extensions(self.robot, values[d : 2 * d - 1], values[2 * d - 1])
        return np.concatenate([values[:d], beta, values[2 * d :]])

    def bounds(self, known: Array) -> tuple[Array, Array]:
        """Of points, (2d + 2,) each, around those that are known (n, 2d + 2), the first of them the start."""
        d, (low, high) = self.robot.d, (self.robot.lower, self.robot.upper)
        beta, theta = slice(d, 2 * d - 1), slice(2 * d, None)
        low, high = (np.where(np.isfinite(each), each, sign * np.pi) for each, sign in ((low, -1), (high, 1)))
        low[:d], high[:d], low[beta], high[beta] = -np.pi, np.pi, 0.0, 1.0
        middle = known[0, theta] / self._scale[theta]
        low[theta] = np.maximum(low[theta], middle - SIDEWAYS)
        high[theta] = np.minimum(high[theta], middle + SIDEWAYS)
        return np.minimum(low * self._scale, known.min(axis=0)), np.maximum(high * self._scale, known.max(axis=0))

    def valid(self, place: Array) -> bool:
        """Whether the robot is free of the wall, stable and within its limits at a point."""
        self.looked += 1
        return self.holds(self.unknowns(place))

    def holds(self, x: Array) -> bool:
        """The same at unknowns x (2d + 2,)."""
        d, robot = self.robot.d, self.robot
        points = ELASTIC.points(robot, x[None], SAMPLES)[0]
        distance, nearest = self._tree.query(points)
        over = distance + outer_radii(robot, x[None, d : 2 * d], SAMPLES)[0] - self._radius[nearest]
        return bool(over.max() < -APART and ELASTIC.margins(robot, x[None])[0] > self._margin and self._within(x))

    def _within(self, x: Array) -> bool:
        """Whether motors are within limits that the space does not know: those of tubes' angles."""
        robot, d = self.robot, self.robot.d
        if not np.isfinite([robot.lower[:d], robot.upper[:d]]).any():
            return True
        q = ELASTIC.configuration(robot, x[None])[0]
        return bool((q >= robot.lower).all() and (q <= robot.upper).all())


def rrt_connect(
    problem: Problem,
    settings: Settings | None = None,
    *,
    seconds: float = SECONDS,
    seed: int = 1,
    progress: Progress | None = None,
) -> Plan:
    """A path through the lumen to the pose of the last frame, as a plan with frames evenly along it.

    seconds: of the search at most. Where nothing is found no frame counts as solved, and the robot stands still.
    Raises OptionError where the problem has no wall, no frame's answer is free of it, or OMPL is not installed.
    """
    del progress
    number(OptionError, "seconds", seconds, lambda value: 0.1 <= value <= 1e5, "lie in [0.1, 1e5]", " s")
    ompl = needed("ompl")
    settings = settings or Settings()
    room = Room(problem, settings.stability_margin or 0.0)
    begin = time.perf_counter()
    start, goal = (_free(problem, room, settings, frame) for frame in (0, problem.frames - 1))
    build = time.perf_counter() - begin
    path = _searched(ompl, room, np.array([room.place(start), room.place(goal)]), seconds, seed)
    found = path is not None
    x = np.repeat(start[None], problem.frames, axis=0) if path is None else _spread(room, path, problem.frames)
    why = {} if found else {str(j + 1): f"no path was found within {seconds:g} s" for j in range(problem.frames)}
    unknown = np.full(problem.frames, np.nan)
    meta = {
        "formulation": "rrt-connect",
        "model": ELASTIC.name,
        "solver": "ompl",
        "options": settings.options() | {"seconds": seconds, "seed": seed, "direction": "forward"},
        "build_s": build,
        "search_s": time.perf_counter() - begin - build,
        "interrupted": False,
        "contact_weight": None,
        "iterations": room.looked,
        "failures": why,
    }
    q, solved = ELASTIC.configuration(problem.robot, x), np.full(problem.frames, found)
    q[:, : problem.robot.d] = np.unwrap(q[:, : problem.robot.d], axis=0)
    return plan_from_configurations(
        problem, q, meta, success=solved, solve_time=unknown, objective=unknown, kkt=unknown, planned=x
    )


def _free(problem: Problem, room: Room, settings: Settings, frame: int) -> Array:
    """The unknowns (2d + 2,) of the best answer for a frame that is free of the wall."""
    answers: list[FrameResult] = NlpFrames.of(problem, model=ELASTIC, settings=settings).search(frame)
    for answer in answers:
        if answer.success and answer.x is not None and room.holds(answer.x):
            return answer.x
    raise OptionError(
        f"rrt-connect finds no answer for frame {frame + 1} of {problem.name or 'the problem'} that is free of "
        f"the wall and holds the margin; tubes that fit the lumen (ctr-nlp design) may have one"
    )


def _searched(ompl: Any, room: Room, ends: Array, seconds: float, seed: int) -> Array | None:
    """Points (n, 2d + 2) of a path between two, made shorter; None where none is found in time."""
    base, geometric, util = ompl.base, ompl.geometric, ompl.util
    util.noOutputHandler()
    util.RNG.setSeed(seed)
    size = ends.shape[1]
    space, bounds = base.RealVectorStateSpace(size), base.RealVectorBounds(size)
    for i, (low, high) in enumerate(zip(*room.bounds(ends), strict=True)):
        bounds.setLow(i, float(low))
        bounds.setHigh(i, float(high))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()
    setup.setStateValidityChecker(lambda state: room.valid(np.array([state[i] for i in range(size)])))
    information.setStateValidityCheckingResolution(RESOLUTION)
    states = [space.allocState() for _ in ends]
    for state, values in zip(states, ends, strict=True):
        for i, value in enumerate(values):
            state[i] = float(value)
    setup.setStartAndGoalStates(*states)
    planner = geometric.RRTConnect(information)
    planner.setRange(RANGE)
    setup.setPlanner(planner)
    setup.solve(seconds)
    if not setup.haveExactSolutionPath():
        return None
    setup.simplifySolution(SHORTENING)
    path = setup.getSolutionPath()
    return np.array([[path.getState(k)[i] for i in range(size)] for k in range(path.getStateCount())])


def _spread(room: Room, path: Array, frames: int) -> Array:
    """The unknowns (frames, 2d + 2) at places evenly along a path of points (n, 2d + 2)."""
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    at = np.linspace(0.0, along[-1], frames)
    places = np.column_stack([np.interp(at, along, column) for column in path.T])
    return np.array([room.unknowns(place) for place in places])
