"""Tubes for many ends within walls, chosen by their last frames.

Whether an end can be reached is decided in the last frame: only where one configuration keeps off the wall and
brings the tip to the target is there a motion to plan. Tubes for many ends are therefore designed on last frames
alone, one a task, which is a hundred times faster than on motions. They grow: the joint program is solved for the
ends that the tubes reach and for the few that they miss by least, and what reaches more is kept. Ends that are far
out of reach never count; in a design for all ends they would draw the tubes away from the others.

Several robots are chosen one after the other, each for the ends that none before it reaches. This greedy rule
covers at least 1 - 1/e of what the best set of the same robots would (Nemhauser, Wolsey and Fisher, Mathematical
Programming 14, 1978).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ctr_nlp.exceptions import CtrError
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.ocp.settings import ARRIVAL_WEIGHT
from ctr_nlp.paths.problem import Problem
from ctr_nlp.planning.last_frame import LastFrame, solve_last_frame, solve_last_frame_near
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.motions import at_frames
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.robust.tolerance_scenarios import tips_of, unknowns_of
from ctr_nlp.solvers.motion.chain_solution import COLD_START_BARRIER_MM2
from ctr_nlp.solvers.scenarios import SharedSolution
from ctr_nlp.support.interrupt import deferred_interrupt, end_if_interrupted
from ctr_nlp.support.pool import Jobs, run_in_parallel
from ctr_nlp.tube_design.search import (
    INITIAL_STEP_COST_MM2,
    REPLANNED_BARRIER_MM2,
    WALL_ROUNDS,
    Candidate,
    DesignSearch,
    Motions,
    nominal_scenario,
)
from ctr_nlp.tube_design.starts import generate_start_tubes
from ctr_nlp.typing import Array, Flags

ADDED_TASKS = 2
"""Tasks out of reach, the nearest ones, for which tubes are designed beside those within reach."""
MAX_ADDED_EXCESS_MM = 2.5
"""Excess of contact and distance, mm, beyond which a task is too far out of reach to be added."""
MAX_GROWTH_ROUNDS = 12
"""Largest number of rounds in which tubes grow."""
MIN_EXCESS_GAIN_MM = 0.2
"""Reduction of the sum of all excesses, mm, each up to MAX_ADDED_EXCESS_MM, for which tubes that reach no further
end are kept.
"""
REACHING_STARTS = 3
"""Tubes from which those of each robot grow."""
ROUNDS_WITHIN_WALLS = ((1.0, REPLANNED_BARRIER_MM2),)
"""Like WALL_ROUNDS, from tubes whose last frames are within walls."""

Start = tuple[str, Array, int | None]
"""Name and unknowns (P,) of tubes to start from, and the number of a task for which they are designed alone before
they grow; None to grow at once.
"""


@dataclass(frozen=True, eq=False)
class ReachingTubes:
    """Tubes, with the last frames of all tasks on them.

    Attributes
    ----------
    start : str
        Name of the tubes from which they grew.
    p : ndarray
        Unknowns (P,) of the tubes.
    last_frames : tuple of (LastFrame or None)
        The best last frame of each task; None where none was solved.
    solution : SharedSolution or None
        Solution of the last round in which they grew, where there was one.
    """

    start: str
    p: Array
    last_frames: tuple[LastFrame | None, ...]
    solution: SharedSolution | None = None

    @cached_property
    def excess(self) -> Array:
        """How far each task is out of reach (n,), mm; infinite where its last frame was not solved."""
        return np.array([np.inf if one is None else one.excess for one in self.last_frames])

    @property
    def within_reach(self) -> Flags:
        """Whether each task is within reach, (n,)."""
        return self.excess == 0

    @property
    def results(self) -> list[FrameResult | None]:
        """The configurations of the last frames."""
        return [None if one is None else one.result for one in self.last_frames]

    def score(self, wanted: Flags) -> tuple[int, float]:
        """Return how many of the wanted tasks are within reach, and less the excess of the others, mm."""
        return int((self.within_reach & wanted).sum()), -float(
            np.minimum(self.excess, MAX_ADDED_EXCESS_MM)[wanted].sum()
        )

    def as_candidate(self, search: DesignSearch, *, only_reached: bool = False) -> Candidate:
        """Return the tubes with their last frames as motions of one frame; errors are NaN where there is none.

        only_reached: leave out the tasks that are out of reach.
        """
        rest = FrameResult(np.zeros(2 * search.tubes.robot.d + 2), success=False)
        results = [
            rest if one is None else one.result
            for one, near in zip(self.last_frames, self.within_reach, strict=True)
            if near or not only_reached
        ]
        found = _candidate(search, self.p, results)
        error = np.sqrt([one.objective for one in results])
        return replace(
            found, start=self.start, motions=replace(found.motions, error=error), solution=self.solution
        )

    def improves_on(self, other: ReachingTubes, wanted: Flags) -> bool:
        """Return whether these tubes reach more wanted tasks than others, or as many and the rest nearly."""
        (count, near), (count_before, near_before) = self.score(wanted), other.score(wanted)
        return count > count_before or (count == count_before and near > near_before + MIN_EXCESS_GAIN_MM)


def at_last_frames(search: DesignSearch) -> DesignSearch:
    """Return a search on the last frames of its tasks, with the frame half-way before each.

    Parameters
    ----------
    search : DesignSearch
        The search over motions.

    Returns
    -------
    DesignSearch
        Tasks of two frames each.
    """
    priorities = search.priorities
    if priorities.arrival_weight is None:
        # On models that cannot snap it is 0 by default, and no end would come within reach.
        priorities = replace(priorities, arrival_weight=ARRIVAL_WEIGHT)
    return replace(search, tasks=tuple(map(_last_two_frames, search.tasks)), priorities=priorities)


def search_of_reached(search: DesignSearch, tubes: ReachingTubes) -> DesignSearch:
    """Return a search for the tasks alone that tubes reach.

    Parameters
    ----------
    search : DesignSearch
        Of all tasks.
    tubes : ReachingTubes
        The tubes.

    Returns
    -------
    DesignSearch
        With fewer tasks.
    """
    return replace(
        search, tasks=tuple(task for task, near in zip(search.tasks, tubes.within_reach, strict=True) if near)
    )


def find_last_frames(
    search: DesignSearch,
    p: Array,
    known: Sequence[FrameResult | None] | None = None,
    searched: Flags | None = None,
) -> ReachingTubes:
    """Find the last frame of every task on given tubes.

    Parameters
    ----------
    search : DesignSearch
        From `at_last_frames`.
    p : ndarray
        Unknowns (P,) of the tubes.
    known : sequence of (FrameResult or None), optional
        Configurations near which a last frame is looked for first, task by task.
    searched : ndarray of bool, optional
        Tasks (n,) for which a search follows where this does not end well; by default all.

    Returns
    -------
    ReachingTubes
        The tubes with the best last frames.
    """
    count = len(search.tasks)
    robot = search.tubes.robot_of(p)
    near = [None] * count if known is None else known
    wide = np.ones(count, dtype=bool) if searched is None else searched
    found = [
        _find_last_frame(search, task, one, bool(more))
        for task, one, more in zip(search.tasks_on(robot), near, wide, strict=True)
    ]
    return ReachingTubes("these tubes", p, tuple(found))


def _find_last_frame(
    search: DesignSearch, task: Problem, near: FrameResult | None, more: bool
) -> LastFrame | None:
    """Return the best last frame of a task: near a known one or, with `more` and where that does not end well,
    of a search; None where none is solved, or after Ctrl-C.
    """
    if search.stop() or (near is None and not more):
        return None
    try:
        frames = NlpFrames.of(task, model=search.model, settings=search.settings)
        one = None if near is None else solve_last_frame_near(frames, near)
        others = solve_last_frame(frames) if more and (one is None or one.excess > 0) else []
    except CtrError:  # on these tubes, the model does not apply or the path is too long
        return None
    return min((each for each in (one, *others) if each is not None), key=lambda each: each.rank, default=None)


def grow_tubes(search: DesignSearch, wanted: Flags, start: Start) -> ReachingTubes | None:
    """Grow tubes until they come to no more of the wanted ends.

    Parameters
    ----------
    search : DesignSearch
        From `at_last_frames`.
    wanted : ndarray of bool
        Tasks (n,) that count.
    start : Start
        Where to start from.

    Returns
    -------
    ReachingTubes or None
        The tubes, with the last frames of all tasks; None where no last frame of that task was solved.
    """
    name, p, first = start
    with deferred_interrupt() as interrupted:
        search = replace(search, stop=interrupted)
        if first is not None:
            alone = _design_for_one(search, first, p)
            if alone is None:
                return None
            p = alone
        found = find_last_frames(search, p)
        tried = np.zeros(len(search.tasks), dtype=bool)
        fresh = True
        for _ in range(MAX_GROWTH_ROUNDS):
            near = wanted & ~found.within_reach & ~tried & (found.excess < MAX_ADDED_EXCESS_MM)
            added = [k for k in np.argsort(found.excess, kind="stable").tolist() if near[k]][:ADDED_TASKS]
            if interrupted() or (fresh and not added):
                break
            if not added:
                # Far ends were left out in between, and some may have come near.
                found = _search_again(search, found)
                fresh, tried[:] = True, False
                continue
            group = [*np.flatnonzero(wanted & found.within_reach).tolist(), *added]
            grown = _design_for_last_frames(search, group, found, wanted)
            if grown is not None and grown.improves_on(found, wanted):
                found, fresh = grown, False
                tried[:] = False
            else:
                tried[added] = True
        return replace(found if fresh else _search_again(search, found), start=name)


def _search_again(search: DesignSearch, found: ReachingTubes) -> ReachingTubes:
    """Return the same tubes with the last frames of all tasks, searched for where they do not end well."""
    return replace(find_last_frames(search, found.p, found.results), solution=found.solution)


def choose_reaching_tubes(
    search: DesignSearch, count: int, seed: int, jobs: Jobs = 1, progress: Progress | None = None
) -> list[ReachingTubes]:
    """Choose tubes of several robots, one after the other, each for the ends that none before it reaches.

    Parameters
    ----------
    search : DesignSearch
        The search over the tasks' motions, in which walls count.
    count : int
        Number of robots.
    seed : int
        Seed of the tubes and tasks to start from.
    jobs : int or distributed.Client
        Number of processes, or the cluster, on which starts are grown.
    progress : callable, optional
        Called as ``progress(done, total, note)`` after each robot.

    Returns
    -------
    list of ReachingTubes
        One a robot, in the order in which they were chosen.

    Raises
    ------
    KeyboardInterrupt
        Ctrl-C was pressed.
    """
    last = at_last_frames(search)
    chosen = list[ReachingTubes]()
    left = np.ones(len(last.tasks), dtype=bool)
    for number in range(count):
        # Where nothing is left, one more robot is for those that reach everything with more room.
        wanted = left if left.any() else np.ones_like(left)
        # Each robot has random tubes of its own.
        own_seed = int(np.random.default_rng([seed, number]).integers(2**31))
        if chosen:
            starts = _next_starts(last, own_seed, chosen[-1], wanted)
        else:
            starts = _first_starts(last, own_seed, REACHING_STARTS)
        grown = _grow_all(last, wanted, starts, jobs)
        end_if_interrupted()
        # Tubes chosen before are there as well, so that a robot is never worse than one of these.
        best = max([*grown, *chosen] or [find_last_frames(last, starts[0][1])], key=lambda one: one.score(wanted))
        chosen.append(best)
        left = left & ~best.within_reach
        if progress is not None:
            note = f"tubes of robot {number + 1}, {int((~left).sum())} of {len(left)} ends within reach"
            progress(number + 1, count, note)
    return chosen


def grow_from_starts(
    search: DesignSearch, count: int, seed: int, jobs: Jobs = 1, progress: Progress | None = None
) -> list[ReachingTubes]:
    """Grow tubes of one robot for all tasks, from the given robot's own and from random ones.

    Parameters
    ----------
    search : DesignSearch
        From `at_last_frames`.
    count : int
        Number of starts.
    seed : int
        Seed of the tubes and tasks to start from.
    jobs : int or distributed.Client
        Number of processes, or the cluster.
    progress : callable, optional
        Called as ``progress(done, total, note)`` after each start.

    Returns
    -------
    list of ReachingTubes
        Those that reach most ends first; none where no start led to any, and after Ctrl-C some may be missing.
    """
    wanted = np.ones(len(search.tasks), dtype=bool)
    starts = _first_starts(search, seed, count)
    grown = _grow_all(search, wanted, starts, jobs, progress)
    return sorted(grown, key=lambda one: one.score(wanted), reverse=True)


def _grow_all(
    search: DesignSearch, wanted: Flags, starts: Sequence[Start], jobs: Jobs, progress: Progress | None = None
) -> list[ReachingTubes]:
    """Return the tubes that grow from starts, in their order."""
    found = dict[int, ReachingTubes | None]()
    for number, one in run_in_parallel(partial(grow_tubes, search.portable, wanted), starts, jobs):
        found[number] = one
        if progress is not None:
            within = "none" if one is None else int(one.within_reach.sum())
            note = f"tubes from {starts[number][0]}, {within} of {len(wanted)} ends within reach"
            progress(len(found), len(starts), note)
    return [one for number in sorted(found) if (one := found[number]) is not None]


def _first_starts(search: DesignSearch, seed: int, count: int) -> list[Start]:
    """Return tubes that those of a first robot grow from: the given robot's own, where they satisfy the rules, and
    random ones, each for a random task to begin with.
    """
    tubes = generate_start_tubes(search.tubes, seed)
    name, own = next(tubes)
    found: list[Start] = [(name, own, None)] if search.tubes.satisfies_rules(own) else []
    tasks = itertools.cycle(np.random.default_rng(seed).permutation(len(search.tasks)).tolist())
    others = itertools.islice(tubes, count - len(found))
    return [*found, *((name, p, task) for (name, p), task in zip(others, tasks, strict=False))]


def _next_starts(search: DesignSearch, seed: int, before: ReachingTubes, left: Flags) -> list[Start]:
    """Return tubes that those of a further robot grow from: those of the robot before and random ones, each for
    one of the tasks that are left to begin with, the nearest first.
    """
    tubes = generate_start_tubes(search.tubes, seed)
    next(tubes)
    nearest = [k for k in np.argsort(before.excess, kind="stable").tolist() if left[k]]
    starts = [(before.start, before.p), *itertools.islice(tubes, REACHING_STARTS - 1)]
    return [(name, p, task) for (name, p), task in zip(starts, itertools.cycle(nearest), strict=False)]


def _design_for_one(search: DesignSearch, number: int, p: Array) -> Array | None:
    """Return tubes (P,) for the last frame of one task, from given ones; None where none was solved."""
    own = replace(search, tasks=(search.tasks[number],))
    robot = search.tubes.robot_of(p)
    try:
        (task,) = own.tasks_on(robot)
        frames = NlpFrames.of(task, model=search.model, settings=search.settings)
        near = frames.search(task.frames - 1)[0]
    except CtrError:
        return None
    if not near.success:
        return None
    single = _at_single_frames(own)
    found = _candidate(single, p, [near])
    # Random tubes are deep within the wall, where the joint program fails: the shape alone leads near it.
    shaped = single.shape_alone.run_round(found, nominal_scenario, INITIAL_STEP_COST_MM2, COLD_START_BARRIER_MM2)
    return None if shaped is None else _run_rounds(single, shaped, WALL_ROUNDS).p


def _design_for_last_frames(
    search: DesignSearch, group: Sequence[int], found: ReachingTubes, wanted: Flags
) -> ReachingTubes | None:
    """Return tubes designed for the last frames of some tasks, from known ones; None where the joint program
    fails.

    Last frames are searched for where wanted ends were near before; all others are only followed.
    """
    known = [one for k in group if (one := found.last_frames[k]) is not None]
    single = _at_single_frames(replace(search, tasks=tuple(search.tasks[k] for k in group)))
    begun = _candidate(single, found.p, [one.result for one in known])
    designed = _run_rounds(single, begun, ROUNDS_WITHIN_WALLS)
    if designed is begun:
        return None
    near = found.results
    robot = search.tubes.robot_of(designed.p)
    x = unknowns_of(search.model, robot, designed.motions.phi[:, 0], designed.motions.q)
    for k, q, unknowns in zip(group, designed.motions.q, x, strict=True):
        near[k] = FrameResult(q, x=unknowns if search.model.several_equilibria else None)
    searched = wanted & (found.excess < MAX_ADDED_EXCESS_MM)
    return replace(find_last_frames(search, designed.p, near, searched), solution=designed.solution)


def _run_rounds(search: DesignSearch, begun: Candidate, rounds: Sequence[tuple[float, float]]) -> Candidate:
    """Solve jointly for tubes and last frames, in rounds of a part of the wall's weight and a first barrier, mm^2;
    return `begun` itself where no round succeeds.
    """
    found = begun
    for part, barrier in rounds:
        again = search.with_wall_part(part).run_round(found, nominal_scenario, INITIAL_STEP_COST_MM2, barrier)
        if again is not None:
            found = again
    return found


def _candidate(search: DesignSearch, p: Array, results: Sequence[FrameResult]) -> Candidate:
    """Return tubes with one configuration a task, from which a round of single frames begins."""
    robot = search.tubes.robot_of(p)
    q = np.stack([one.q for one in results])
    x = np.stack([one.q if one.x is None else one.x for one in results])
    tips = tips_of(search.model, robot, x)
    return Candidate("last frames", p, Motions(q, tips[:, None], np.ones(len(q))))


def _last_two_frames(task: Problem) -> Problem:
    """Return a task on its last frame and the one half-way before it; itself where there are no more."""
    stride = task.frames // 2
    picked = np.array([task.frames - 1 - stride, task.frames - 1])
    return task if task.frames == 2 else at_frames(task, picked, stride)


def _at_single_frames(search: DesignSearch) -> DesignSearch:
    """Return a search on the last frame of each task alone."""
    tasks = (at_frames(task, np.array([task.frames - 1]), 1) for task in search.tasks)
    return replace(search, tasks=tuple(tasks))
