"""Runs of plans on simulated plants, in closed and in open loop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import process_time

import numpy as np

from ctr_nlp.identify.closed_loop.feed import Feed
from ctr_nlp.identify.closed_loop.observer import Innovation
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.replanning.replanning import Replanning, ReplanningOutcome
from ctr_nlp.identify.closed_loop.tracker import Note, Tracker, TrackerState
from ctr_nlp.plan.measures import rms_over_sigma
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.sample_motions import MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags


@dataclass(frozen=True, eq=False)
class LoopRun(ReadOnlyValue):
    """Result of running a plan of T frames on a plant.

    q (T, 2d + 2): commanded configurations of the motors. shape (T, 101, 3): of the plant, mm. e2 (T,): root mean
    square over sigma of its distance from the target, mm. first_failed_frame, first_snap_frame: frame, from 1, in
    which the plant first leaves the planned branch, or snaps; 0 where none. means, deviations (T, k): of the
    estimated differences; empty in open loop. seconds (T,): process time of each cycle. innovations: of all
    readings. notes: messages to the operator. stopped: whether the tracker stopped. replannings: outcomes of
    re-planning.
    """

    q: Array
    shape: Array
    e2: Array
    first_failed_frame: int
    first_snap_frame: int
    means: Array
    deviations: Array
    seconds: Array
    innovations: tuple[Innovation, ...] = ()
    notes: tuple[Note, ...] = ()
    stopped: bool = False
    replannings: tuple[ReplanningOutcome, ...] = ()

    @property
    def e3(self) -> float:
        """Root mean square over frames of e2, mm."""
        return float(np.sqrt((self.e2**2).mean()))


def open_loop(plan: Plan, plant: Plant) -> LoopRun:
    """Run a plan on a plant without feedback."""
    for q, time in zip(plan.q, plan.time, strict=True):
        plant.move_to(q, float(time))
    nothing = np.zeros((len(plan.q), 0))
    return _run(plan, plant, nothing, nothing, np.zeros(len(plan.q)))


def closed_loop(
    plan: Plan, plant: Plant, feed: Feed, tracker: Tracker, replanning: Replanning | None = None
) -> LoopRun:
    """Run a plan on a plant with feedback; plant, feed and tracker can be used once.

    feed: readings of the plant. tracker: of the plan. replanning: re-plans the rest of the motion; None for none.
    Raises as Tracker.
    """
    q = tracker.reference.motors[0]
    means = list[Array]()
    deviations = list[Array]()
    seconds = list[float]()
    for frame, time in enumerate(plan.time.tolist()):
        plant.move_to(q, time)
        if replanning is not None:
            replanning.update_plan(tracker, frame + 1, q[None])
        readings = feed.take_readings(time)
        begin = process_time()
        q = tracker.step(frame, q, time, readings)
        seconds.append(process_time() - begin)
        means.append(tracker.observer.mean)
        deviations.append(np.sqrt(tracker.observer.covariance.diagonal()))
    found = _run(plan, plant, np.array(means), np.array(deviations), np.array(seconds), tracker)
    return found if replanning is None else replace(found, replannings=tuple(replanning.outcomes))


def _run(
    plan: Plan, plant: Plant, means: Array, deviations: Array, seconds: Array, tracker: Tracker | None = None
) -> LoopRun:
    shape, x = (np.array([getattr(moved, name) for moved in plant.history]) for name in ("shape", "x"))
    snapped = next((k for k, moved in enumerate(plant.history, start=1) if moved.jumps), 0)
    away = shape - plan.target
    meant = (
        plan.evaluated_model.follow(plan.robot, plan.q).x
        if tracker is None
        else _reference_equilibria(tracker, plan)
    )
    lost = next((k for k, far in enumerate(_on_another_branch(plan, x, meant), start=1) if far), 0)
    lost = min(lost, snapped) if lost and snapped else lost or snapped
    e2 = rms_over_sigma(np.linalg.norm(away, axis=-1))
    q = np.array([moved.q for moved in plant.history])
    found = LoopRun(q, shape, e2, lost, snapped, means, deviations, seconds)
    if tracker is None:
        return found
    stopped = tracker.state is TrackerState.STOPPED
    return replace(found, innovations=tuple(tracker.innovations), notes=tuple(tracker.notes), stopped=stopped)


def _reference_equilibria(tracker: Tracker, plan: Plan) -> Array:
    """Return the unknowns (T, n_x) of the equilibria in which the robot should be in each frame.

    A stopped robot should stay where it is, and is compared with that from then on: otherwise every robot that is
    stopped in time would count as failed as soon as the plan has moved on.
    """
    x = tracker.reference.x
    if tracker.state is not TrackerState.STOPPED:
        return x
    stopped = int(np.searchsorted(plan.time, tracker.notes[-1].time - 1e-9))
    return np.concatenate([x[: stopped + 1], np.repeat(x[stopped : stopped + 1], len(x) - stopped - 1, axis=0)])


def _on_another_branch(plan: Plan, x: Array, meant: Array) -> Flags:
    """Return the frames (T,) in which the plant is on another branch than planned.

    x, meant: (T, n_x), unknowns of the plant and of the planned equilibria. The criterion is that of
    plan/sample_motions.py.
    """
    if not plan.evaluated_model.several_equilibria:
        return np.zeros(len(x), dtype=bool)
    apart = abs(x - meant)[:, : plan.robot.d - 1].max(axis=1, initial=0.0)
    found: Flags = ~(apart <= MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD)
    return found
