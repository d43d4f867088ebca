"""Plans executed on perturbed robots, with feedback (closed loop) and without (open loop).

Each robot is a Monte Carlo sample of the tolerances. A run counts by its e3 relative to the plan's own, and by
whether the robot failed, that is snapped or left its branch of equilibria.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from identification import identify_robot

from ctr_nlp.identify.closed_loop.feed import Feed
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.replanning.replanner import Replanner, problem_of, settings_of
from ctr_nlp.identify.closed_loop.replanning.replanning import REPLANNING_LEAD_S, Replanning
from ctr_nlp.identify.closed_loop.runs import closed_loop, open_loop
from ctr_nlp.identify.closed_loop.sensors import Sensors
from ctr_nlp.identify.closed_loop.sensors.points import ShapePointSensor, TipPositionSensor
from ctr_nlp.identify.closed_loop.tracker import Tracker
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Tolerances
from ctr_nlp.robot.samples import RobotSamples, sample_robots
from ctr_nlp.robust.plan import solve_robust

CLOSED_LOOP_SAMPLES, CLOSED_LOOP_SEED = 100, 20260101
"""Number and seed of the sampled robots on which every plan is run; nothing was tuned on these."""
STUDY_SENSOR_NOISE_MM = 0.5
"""Standard deviation of every measured coordinate, mm."""
SENSED_SHAPE_SIGMA = 1 / 6, 1 / 3, 1 / 2, 2 / 3, 5 / 6
"""Normalised arc lengths of the points that are measured beside the tip."""
PLANT_TOLERANCES = Tolerances(0.1, 0.1, motor_zero=0.05)
"""Tolerances from which the robots are sampled."""
STUDY_BACKLASH_RAD, STUDY_TIP_BENDING_MM = 0.05, 2.0
"""Backlash of every tube, rad, and bending of the tip, mm, in the cases that have them."""


@dataclass(frozen=True)
class ClosedLoopCase:
    """A case of the study: sensors, and deviations of the robots beyond PLANT_TOLERANCES.

    tip_alone: whether only the tip is measured. play: backlash of every tube, rad. bending: of the tip, mm.
    """

    tip_alone: bool = False
    play: float = 0.0
    bending: float = 0.0

    @property
    def sensors(self) -> Sensors:
        """Sensors of the tip and, unless it is alone, of points of the shape."""
        tip = TipPositionSensor(STUDY_SENSOR_NOISE_MM)
        return (
            Sensors(tip)
            if self.tip_alone
            else Sensors(tip, ShapePointSensor(SENSED_SHAPE_SIGMA, STUDY_SENSOR_NOISE_MM))
        )


CLOSED_LOOP_CASES: Mapping[str, ClosedLoopCase] = {
    "tip and 5 points": ClosedLoopCase(),
    "tip alone": ClosedLoopCase(tip_alone=True),
    "with play": ClosedLoopCase(play=STUDY_BACKLASH_RAD),
    "with bending": ClosedLoopCase(bending=STUDY_TIP_BENDING_MM),
}


@dataclass(frozen=True)
class ClosedLoopResult:
    """Result of running a plan on sampled robots in one case.

    planned: e3 of the plan, mm. opened, closed: mean e3 over all robots relative to that, without and with
    feedback; kept: with feedback, of robots that neither failed nor were stopped. lost_open, lost, stopped: robots
    that failed without feedback, failed with it, or were stopped, of so many draws (samples); told: robots that
    failed with feedback about which the operator was informed. cycle, slowest: median and 99 % quantile of the
    time of one control cycle, ms. replanned: share of re-planned motions that were adopted; replanning: median
    time of one, s; late: share that took longer than REPLANNING_LEAD_S.
    """

    plan: str
    case: str
    planned: float
    opened: float
    closed: float
    kept: float
    lost_open: int
    lost: int
    stopped: int
    told: int
    draws: int
    cycle: float
    slowest: float
    replanned: float
    replanning: float
    late: float


AS_PLANNED, REPLANNED, IDENTIFIED = REPLANNING_MODES = "as planned", "replanned", "identified"
"""Which motion is followed: the plan; one re-planned for PLANT_TOLERANCES before the run, and for the estimate
during it; one re-planned for the estimate after a robot was measured in free space.
"""


def run_closed_loops(
    name: str,
    plan: Plan,
    case: str,
    samples: int = CLOSED_LOOP_SAMPLES,
    seed: int = CLOSED_LOOP_SEED,
    replanning_mode: str = AS_PLANNED,
) -> ClosedLoopResult:
    """Run a plan on sampled robots, with feedback and without.

    name: of the plan. case: of CLOSED_LOOP_CASES; its backlash applies in full to all tubes. samples, seed: number
    of robots, and the seed with which they are sampled. replanning_mode: of REPLANNING_MODES. Without feedback the
    given plan is executed, and all errors are relative to its own. Raises as Tracker and Replanner.
    """
    at = CLOSED_LOOP_CASES[case]
    led = replan_for_tolerances(plan, PLANT_TOLERANCES) if replanning_mode == REPLANNED else plan
    replanner = None if replanning_mode == AS_PLANNED else Replanner(plan)
    # The tracker knows that there may be backlash up to the given one; every robot has all of it, the worst case.
    tolerances = replace(PLANT_TOLERANCES, rotation_lag=at.play)
    robots = sample_robots(replace(plan.robot, tolerances=tolerances), samples, seed)
    robots = replace(robots, backlash=np.full_like(robots.backlash, at.play))
    runs = []
    seconds = list[float]()
    # Both loops meet the same robot. seed + k: noise differs between robots, and is the same in every mode.
    for k, bent in zip(range(samples), _bending_offsets(at.bending, samples, seed), strict=True):
        own = plan.robot, robots[k : k + 1], plan.evaluated_model
        opened = open_loop(plan, Plant(*own, bending=bent))
        plant = Plant(*own, bending=bent)
        tracker = _make_tracker(
            led, at, tolerances, own[1], seed + k, replanner if replanning_mode == IDENTIFIED else None
        )
        replanning = (
            Replanning(replanner, plan.time) if replanner is not None and replanning_mode == REPLANNED else None
        )
        runs.append((opened, closed_loop(led, plant, Feed(plant, at.sensors, seed + k), tracker, replanning)))
        seconds += runs[-1][1].seconds.tolist()
    planned = e3(plan) or np.nan
    anew = [each for _, run in runs for each in run.replannings]
    kept = [run.e3 for _, run in runs if not (run.first_failed_frame or run.stopped)]
    return ClosedLoopResult(
        plan=name,
        case=case,
        planned=planned,
        opened=float(np.mean([run.e3 for run, _ in runs])) / planned,
        closed=float(np.mean([run.e3 for _, run in runs])) / planned,
        kept=float(np.mean(kept)) / planned if kept else float("nan"),
        lost_open=sum(run.first_failed_frame > 0 for run, _ in runs),
        lost=sum(run.first_failed_frame > 0 for _, run in runs),
        stopped=sum(run.stopped for _, run in runs),
        told=sum(run.first_failed_frame > 0 and bool(run.notes) for _, run in runs),
        draws=samples,
        cycle=1e3 * float(np.quantile(seconds, 0.5)),
        slowest=1e3 * float(np.quantile(seconds, 0.99)),
        replanned=float(np.mean([each.adopted_plan for each in anew])) if anew else 0.0,
        replanning=float(np.median([each.seconds for each in anew])) if anew else 0.0,
        late=float(np.mean([each.seconds > REPLANNING_LEAD_S for each in anew])) if anew else 0.0,
    )


def _make_tracker(
    plan: Plan,
    at: ClosedLoopCase,
    tolerances: Tolerances,
    sample: RobotSamples,
    seed: int,
    replanner: Replanner | None,
) -> Tracker:
    """Make the tracker of one robot, `sample`, along a plan.

    at: the case. tolerances: prior knowledge of the robot. seed: of the noise. replanner: where given, the robot
    is measured in free space first, and the motion is re-planned for the estimate.
    """
    if replanner is None:
        return Tracker(plan, at.sensors, tolerances)
    places = np.append([] if at.tip_alone else SENSED_SHAPE_SIGMA, 1.0)
    known = identify_robot(
        plan.robot, tolerances, sample, plan.evaluated_model, places, STUDY_SENSOR_NOISE_MM, seed
    )
    tracker = Tracker(plan, at.sensors, tolerances, known)
    begun = tracker.motion_start
    whole = replanner(begun)
    if whole is not None:
        tracker.switch_reference(begun, whole)
    return tracker


def replan_for_tolerances(plan: Plan, tolerances: Tolerances) -> Plan:
    """Re-plan for all robots within `tolerances`, with the plan as initial guess; raises as solve_robust."""
    problem = replace(problem_of(plan), robot=replace(plan.robot, tolerances=tolerances))
    return solve_robust(problem, initial=[plan.q], settings=settings_of(plan))


def _bending_offsets(size: float, samples: int, seed: int) -> Iterator[tuple[float, float]]:
    """Yield the bending (x, y), mm, of every robot's tip: of length `size` in a random direction."""
    # A stream of its own: [seed, 7] is independent of the stream of `seed`, from which the robots are sampled.
    for turn in np.random.default_rng([seed, 7]).uniform(0.0, 2 * np.pi, samples).tolist():
        yield size * np.cos(turn), size * np.sin(turn)
