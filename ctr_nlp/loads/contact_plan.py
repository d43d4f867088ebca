"""Plans that lean on a wall: the limit is a force, and no longer a depth.

A plan that keeps off the wall is found first, as usual. On the wall its robot is another one: where it touches,
the wall holds it back. From the equilibria on the wall along that motion, the motion is improved
(contact_program.py). The result is replayed in sub-steps on the wall, and judged by the forces, shapes and margins
found there.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.loads.contact_equilibria import ContactEquilibria
from ctr_nlp.loads.contact_frames import ContactFrames
from ctr_nlp.loads.contact_neighbours import ContactNeighbours
from ctr_nlp.loads.contact_program import ContactSolution, contact_chain, solve_contact_chain
from ctr_nlp.loads.contact_rods import ContactState, ContactStates
from ctr_nlp.loads.tissue import (
    AIRWAY_WALL_STIFFNESS_N_PER_MM2,
    CONTACT_FORCE_ALLOWED_N,
    MAX_CONTACT_FORCE_N,
    MAX_WALL_STIFFNESS_N_PER_MM2,
    MIN_WALL_STIFFNESS_N_PER_MM2,
)
from ctr_nlp.loads.winkler_wall import PLANNED_TOE_DEPTH_MM, WinklerWall
from ctr_nlp.models import KINEMATIC_MODELS, Snap
from ctr_nlp.models.loads import Load, check_moduli
from ctr_nlp.models.protocol import STABILITY_SUBSTEPS_PER_FRAME, subdivide_motion
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms.arrival import find_arrival, with_arrival
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.paths.walls import WallGeometry
from ctr_nlp.plan.motion_evaluation import name_clearances, wall_clearances
from ctr_nlp.plan.plan import PHYSICAL_MODEL, Plan
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.plan.verdicts import FORCE_SLACK_FRACTION, MARGIN_SLACK
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.robot import Robot
from ctr_nlp.solvers.frame.adapter import KKT_TOLERANCE
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.value_checks import number
from ctr_nlp.typing import Array, Flags

PLANNED_FORCE_FRACTION = 0.85
"""Fraction of the allowed force that planning aims at: penalties yield a little, and so do sub-steps between
frames."""
MARGIN_ADDED_AT_SNAP = 0.3
"""Stability margin that the two frames between which the robot snaps are asked for in addition."""
SOFT_WALL_SHARE = 0.1
"""Part of the wall's stiffness with which a search begins."""
LEAST_SOFT_GAIN = 0.01
"""Part of the objective that iterations on the soft wall must gain to go on: another search follows."""
LEAST_HARDENING_RATIO = 1.01
"""Ratio of two stiffnesses, one after the other, below which no equilibrium is looked for on the harder wall."""
MAX_ROUNDS = 5
"""Most times that a motion is solved again where it fails between frames, with more margin or a lower limit of
forces."""
MAX_REPLAYED_TURN_RAD = 0.3
"""Angle in rad up to which tubes' tips may turn against each other between the wall of the search, which gets
stiff gradually, and the wall itself; farther, the robot is on another branch. Branches are a rad and more apart.
"""


@dataclass(frozen=True)
class ContactReplay:
    """A robot on a wall, moved through T frames in sub-steps; NaN from the frame on in which it snaps.

    shape (T, 101, 3), mm; tip_direction (T, 3). margin, margin_between (T,): in frames, and the least in the
    sub-steps to them. clearance, clearance_between (T, W, 101), mm. force, along (T, K) and direction (T, K, 3):
    of the wall on each piece, N, and where, mm. place, place_between (T,): largest force at one place, N. states:
    of the frames, as far as they are known.
    """

    shape: Array
    tip_direction: Array
    margin: Array
    margin_between: Array
    clearance: Array
    clearance_between: Array
    force: Array
    along: Array
    direction: Array
    place: Array
    place_between: Array
    states: tuple[ContactState, ...]

    @property
    def in_equilibrium(self) -> Flags:
        """Frames (T,) in which the robot has not snapped."""
        return np.asarray(np.isfinite(self.margin))


def replay_on_wall(
    equilibria: ContactEquilibria, wall: WallGeometry, q: Array, substeps: int = STABILITY_SUBSTEPS_PER_FRAME
) -> ContactReplay:
    """Move a robot on a wall through configurations, in sub-steps linear in q.

    Parameters
    ----------
    equilibria : ContactEquilibria
        Of the robot on the wall, without a load.
    wall : WallGeometry
        The wall, from which clearances are measured.
    q : (T, 2d + 2) array
        Configurations, rad and mm.
    substeps : int
        Steps from frame to frame.

    Returns
    -------
    ContactReplay
        Shapes, margins and forces.
    """
    robot = equilibria.robot
    way = subdivide_motion(q, substeps)
    states = equilibria.follow_motion(way.q, np.tile(Load().numbers(robot.d), (len(way.q), 1)))
    frames = way.frames[: len(states)]
    last_of = np.flatnonzero(np.diff(way.frames, append=-1)[: len(states)] != 0)
    count = len(q)

    def by_frame(values: Array) -> Array:
        """Return values (M, ..) of sub-steps in the frames that were reached, (T, ..)."""
        found = np.full((count, *values.shape[1:]), np.nan)
        found[frames[last_of]] = values[last_of]
        return found

    def worst(values: Array, choose: np.ufunc) -> Array:
        """Return the least or largest values (M, ..) of the sub-steps to each frame, (T, ..)."""
        found = np.full((count, *values.shape[1:]), np.nan)
        choose.at(found, frames, values)
        found[~np.isin(np.arange(count), frames[last_of])] = np.nan
        return found

    if not states:
        raise OptionError("in the first frame the robot has no equilibrium on the wall; begin farther outside")
    every = ContactStates.stack(states)
    pieces = equilibria.forces(every)
    shapes = equilibria.shapes(every, SIGMA_GRID)
    margins = equilibria.margins(every)
    clearance = wall_clearances(robot, wall, robot.split(every.q)[1], shapes)
    place = pieces.at_places.max(axis=1, initial=0.0)
    means = every.pushes[:, :, 0]
    size = np.linalg.norm(means, axis=2, keepdims=True)
    return ContactReplay(
        shape=by_frame(shapes),
        tip_direction=by_frame(every.axes[:, 2]),
        margin=by_frame(margins),
        margin_between=worst(margins, np.fmin),
        clearance=by_frame(clearance),
        clearance_between=worst(clearance, np.fmin),
        force=by_frame(pieces.force),
        along=by_frame(pieces.along),
        direction=by_frame(means / np.where(size > 0, size, 1.0)),
        place=by_frame(place),
        place_between=worst(place, np.fmax),
        states=tuple(states[k] for k in last_of),
    )


def solve_on_wall(
    problem: Problem,
    limit: float = CONTACT_FORCE_ALLOWED_N,
    *,
    stiffness: float = AIRWAY_WALL_STIFFNESS_N_PER_MM2,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    initial: Plan | None = None,
    progress: Callable[..., None] | None = None,
) -> Plan:
    """Plan a motion whose robot may lean on the wall, up to a force at each place.

    The wall is an elastic (Winkler) foundation without friction; see :func:`wall_forces`. The robot is nominal and
    bears no other load. All frames are one program, which is solved as one without a wall is
    (contact_program.py): ``plan.kkt`` has the residual of each frame.

    Parameters
    ----------
    problem : Problem
        Robot and target, with a wall; the robot needs Young's moduli in MPa.
    limit : float
        Largest force of the wall on one place, 10 mm of the robot, N.
    stiffness : float
        Stiffness of the wall, N/mm for every mm of the robot; by default that of an airway.
    settings : Settings
        Weight of the tip's arrival, stability margin and thresholds.
    initial : Plan, optional
        Plan of the same problem to begin with; by default :func:`solve_horizon` finds one.
    progress : callable, optional
        Called as ``progress(done, total, note)``.

    Returns
    -------
    Plan
        The motion, with shapes and margins of the robot on the wall, and the wall's forces (``plan.wall_force``).
        Returned also where the limit is exceeded: check ``plan.verdicts.within_wall``. Ctrl-C ends the search with
        what was found until then.

    Raises
    ------
    LoadError
        A tube has no Young's modulus in MPa.
    OptionError
        `limit` or `stiffness` is out of its range, the problem has no wall, or a body to keep out of; or the robot
        snaps on the wall along the motion to begin with.

    Examples
    --------
    The tubes of the named problems have no moduli in MPa; those of nitinol have about 60,000:

    >>> from dataclasses import replace
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.models.loads import with_modulus
    >>> problem = ctr.named_problem("bronchus", frames=20)
    >>> problem = replace(problem, robot=with_modulus(problem.robot, 60_000))
    >>> plan = ctr.solve_on_wall(problem, limit=0.2)  # doctest: +SKIP
    """
    check_contact_request(problem, limit, stiffness)
    wall = problem.wall
    assert wall is not None
    begin = time.perf_counter()
    with deferred_interrupt() as interrupted:
        start = solve_horizon(problem, settings=settings, progress=progress) if initial is None else initial
        equilibria = ContactEquilibria(problem.robot, WinklerWall(wall, stiffness), Load())
        model = KINEMATIC_MODELS[PHYSICAL_MODEL]
        count = problem.frames
        least = 0.0 if settings.stability_margin is None else settings.stability_margin
        # A stiff wall would push the robot of a plan that goes through it to somewhere else, from where no search
        # leads back. The search begins on a soft wall, with a limit as low in proportion, which is then hardened.
        soft = _searched_on(problem, SOFT_WALL_SHARE * stiffness)
        frames = ContactFrames(
            problem,
            soft,
            np.full(count, least),
            find_arrival(with_arrival((), settings, model)),
            _states_along(soft, start.q),
        )
        planned = np.full(count, PLANNED_FORCE_FRACTION * limit)

        def solve() -> tuple[ContactSolution, ContactReplay]:
            """Solve with the margins and the limit as they are, from the equilibria as they are, and replay."""
            found = search(planned)
            return found, replay_on_wall(equilibria, wall, np.stack([state.q for state in found.states]))

        def search(allowed: Array, least_gain: float = 0.0) -> ContactSolution:
            """Solve from the equilibria as they are, with forces up to `allowed` (T,) N at each place.

            least_gain: as of solve_contact_chain.
            """
            chain = contact_chain(frames, allowed, float(start.options["motion_weight"]))
            return solve_contact_chain(chain, show, least_gain, interrupted)

        def show(done: int, objective: float) -> None:
            if progress is not None:
                progress(done, done, f"on the wall, objective {objective:.4g} mm²")

        solution = search(SOFT_WALL_SHARE * planned, LEAST_SOFT_GAIN)
        frames = replace(
            frames,
            equilibria=_searched_on(problem, stiffness),
            states=harden(problem, ContactStates.stack(solution.states), SOFT_WALL_SHARE * stiffness, stiffness),
        )
        tried = list[tuple[JudgedReplay, ContactSolution, ContactReplay]]()
        for _ in range(1 + MAX_ROUNDS):
            solution, replay = solve()
            judged = judge_replay(solution, replay, least, limit)
            tried.append((judged, solution, replay))
            if judged.is_good or interrupted():
                break
            # Both frames around a sub-step that fails get more margin, as in plans without contact, or a lower
            # limit.
            more = np.maximum(judged.missing_margin, np.append(judged.missing_margin[1:], 0.0))
            planned = planned / np.maximum(judged.force_ratio, np.append(judged.force_ratio[1:], 1.0))
            frames = replace(frames, margin=frames.margin + 1.2 * more, states=list(solution.states))
        stopped = interrupted()
    _, solution, replay = min(tried, key=lambda each: each[0].rank)
    plan = _plan_of(start, solution, replay, problem, limit, stiffness, time.perf_counter() - begin)
    return replace(plan, meta=plan.meta | {"interrupted": stopped})


class JudgedReplay(NamedTuple):
    """How far a motion on a wall falls short of what was asked for, in T frames.

    missing_margin (T,): stability margin below what was asked for, on the way to each frame. force_ratio (T,): the
    largest force at a place over its limit there, 1 at least. lost: frames from the first on in which the robot is
    not where the plan has it.
    """

    missing_margin: Array
    force_ratio: Array
    lost: int

    @property
    def is_good(self) -> bool:
        """Whether nothing is missing."""
        return bool(self.missing_margin.max() <= MARGIN_SLACK and self.force_ratio.max() <= 1)

    @property
    def rank(self) -> tuple[float, ...]:
        """Numbers in the order in which they count among motions: the less the better."""
        return (
            self.lost,
            max(float(self.force_ratio.max()), 1.0 + FORCE_SLACK_FRACTION),
            float(self.missing_margin.max()),
        )


def judge_replay(solution: ContactSolution, replay: ContactReplay, least: float, limit: float) -> JudgedReplay:
    """Judge a robot that was moved along a solution; least: stability margin asked for; limit: of forces, N."""
    kept = np.logical_and.accumulate(is_on_planned_branch(solution, replay))
    missing = np.where(kept, np.maximum(least - replay.margin_between, 0.0), 0.0)
    if not kept.all():
        # There the branch turns far. Beyond, nothing is known, and nothing more can be asked for.
        missing[kept.argmin()] = MARGIN_ADDED_AT_SNAP
    ratio = np.where(kept, np.maximum(replay.place_between / limit, 1.0), 1.0)
    return JudgedReplay(missing, ratio, int((~kept).sum()))


def is_on_planned_branch(solution: ContactSolution, replay: ContactReplay) -> Flags:
    """Return the frames (T,) in which the robot that was moved along a solution is where the solution has it."""
    planned, reached = (
        np.array([state.angles - state.angles[-1] for state in states])
        for states in (solution.states, replay.states)
    )
    found = np.zeros(len(planned), dtype=bool)
    known = np.flatnonzero(replay.in_equilibrium)
    found[known] = abs(reached - planned[known]).max(axis=1) < MAX_REPLAYED_TURN_RAD
    return found


def _searched_on(problem: Problem, stiffness: float) -> ContactEquilibria:
    """Return the equilibria among which motions are searched: on a wall whose law has no corners."""
    assert problem.wall is not None
    return ContactEquilibria(
        problem.robot, WinklerWall(problem.wall, stiffness, PLANNED_TOE_DEPTH_MM), Load(), searched=True
    )


def harden(problem: Problem, states: ContactStates, soft: float, hard: float) -> list[ContactState]:
    """Return equilibria on a wall of stiffness `hard` that have the shapes of states on one of stiffness `soft`.

    Their tips keep their angles (contact_neighbours.py), and their motors hold them against the larger forces.
    OptionError where that fails.
    """
    ratio = hard / soft
    while soft < hard:
        harder = min(soft * ratio, hard)
        nearby = ContactNeighbours(_searched_on(problem, harder))
        # At the same shape forces grow as the stiffness does.
        guess = states._replace(pushes=states.pushes * harder / soft)
        found = [each for each in nearby.settle(guess, nearby.slopes(guess, SIGMA_GRID[-1:])) if each is not None]
        if len(found) == len(guess.q):
            soft, states = harder, ContactStates.stack(found)
        elif ratio < LEAST_HARDENING_RATIO:
            raise OptionError(
                f"on a wall of {harder:.3g} N/mm² the robot has no equilibrium near the motion that was found on "
                "a softer one; give `initial`, or a softer wall"
            )
        else:
            ratio = ratio**0.5
    return [states.row(j) for j in range(len(states.q))]


def check_contact_request(problem: Problem, limit: float, stiffness: float) -> None:
    """Raise OptionError or LoadError unless a problem's robot can be planned on its wall."""
    number(
        OptionError,
        "contact_force",
        limit,
        lambda x: 0 < x <= MAX_CONTACT_FORCE_N,
        f"lie in (0, {MAX_CONTACT_FORCE_N:g}]",
        " N",
    )
    number(
        OptionError,
        "stiffness of the wall",
        stiffness,
        lambda x: MIN_WALL_STIFFNESS_N_PER_MM2 <= x <= MAX_WALL_STIFFNESS_N_PER_MM2,
        f"lie in [{MIN_WALL_STIFFNESS_N_PER_MM2:g}, {MAX_WALL_STIFFNESS_N_PER_MM2:g}] N/mm²",
        " N/mm²",
    )
    check_moduli(problem.robot)
    if problem.wall is None:
        raise OptionError(
            f"contact_force is {limit:g} N, and {problem.name} has no wall to lean on; give a path with radii, "
            "a mask or a mesh"
        )
    if any(body.keep_out for body in problem.walls):
        raise OptionError(
            f"contact_force is {limit:g} N, and {problem.name} has bodies to keep out of; the robot would lean on "
            "them, too: leave one of them out"
        )


def _states_along(equilibria: ContactEquilibria, q: Array) -> list[ContactState]:
    """Return the equilibria on the wall along a motion q (T, 2d + 2).

    Where the robot snaps on the way, the frame is reached without a history instead; OptionError where that fails.
    """
    loads = np.tile(Load().numbers(equilibria.robot.d), (len(q), 1))
    states = list[ContactState]()
    while len(states) < len(q):
        found = equilibria.follow_motion(q[len(states) :], loads[len(states) :])
        if not found:
            raise OptionError(
                f"on the wall the robot has no equilibrium in frame {len(states) + 1} of the plan to begin with; "
                "give `initial`, or a softer wall"
            )
        states += found
    return states


def _plan_of(
    start: Plan,
    solution: ContactSolution,
    replay: ContactReplay,
    problem: Problem,
    limit: float,
    stiffness: float,
    seconds: float,
) -> Plan:
    """Return the plan of a solution that was replayed on the wall; start: the plan that it began with."""
    robot: Robot = problem.robot
    q = np.stack([state.q for state in solution.states])
    alpha, beta, theta = robot.split(q)
    free = Simulator(robot, KINEMATIC_MODELS[PHYSICAL_MODEL])(q)
    known = replay.in_equilibrium
    snaps = list[dict[str, Any]]()
    if not known.all():
        j = int(known.argmin())
        # Which tubes jump, and how far, is not known: nobody knows where the robot comes to rest.
        snaps = [Snap(frame=j + 1, tubes=(), jump=None)._asdict() | {"tubes": []}]
    same = is_on_planned_branch(solution, replay)
    failures = {str(j + 1): "on the wall, the robot is on another branch" for j in np.flatnonzero(~same)}
    solved = solution.kkt <= KKT_TOLERANCE
    if not solved.all():
        failures |= {"all": f"the search on the wall ended before it had converged ({solution.status})"}
    meta: dict[str, Any] = dict(start.meta) | {
        "wall_contact": {"limit_N": limit, "stiffness_N_per_mm2": stiffness},
        "snaps": snaps,
        "solve_s": seconds,
        "failures": failures,
    }
    return replace(
        start,
        alpha=alpha,
        beta=beta,
        theta=theta,
        success=same & solved,
        objective=solution.costs,
        kkt=solution.kkt,
        solve_time=np.full(len(alpha), np.nan),
        shape=replay.shape,
        tip_direction=replay.tip_direction,
        stability=replay.margin,
        stability_between=replay.margin_between,
        **name_clearances(replay.clearance, replay.clearance_between),
        wall_force=replay.force,
        wall_force_along=replay.along,
        wall_force_direction=replay.direction,
        place_force=replay.place,
        place_force_between=replay.place_between,
        stability_without_wall=free.stability,
        meta=meta,
        drawn=None,
    )
