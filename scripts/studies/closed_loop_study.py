"""Plans on robots that differ from what they were made for, with feedback and without."""

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
"""Number and seed of the robots that every plan is run on; nothing was tuned on these."""
STUDY_SENSOR_NOISE_MM = 0.5
"""Noise of every coordinate that is measured, mm."""
SENSED_SHAPE_SIGMA = 1 / 6, 1 / 3, 1 / 2, 2 / 3, 5 / 6
"""Places of the shape that are measured beside the tip, sigma."""
PLANT_TOLERANCES = Tolerances(0.1, 0.1, motor_zero=0.05)
"""Tolerances that robots differ by."""
STUDY_BACKLASH_RAD, STUDY_TIP_BENDING_MM = 0.05, 2.0
"""rad by which every tube stays behind its motor, and mm by which the tip is bent, in the cases that have them."""


@dataclass(frozen=True)
class ClosedLoopCase:
    """A case of the study: the sensors, and what robots have beyond the differences PLANT_TOLERANCES: play, rad,
    and bending, mm.
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
    """A plan on robots in one case. planned: its e3, mm; opened, closed: mean e3 of all over that; kept: of those
    neither lost nor stopped, with feedback. lost_open, lost, stopped: of so many draws; told: of those that were
    lost with feedback, of how many the operator was told. cycle, slowest: median and 99 % quantile of one cycle,
    ms. replanned: the share of replannings whose motion then led; replanning: the median time of one, s; late: the
    share that took longer than REPLANNING_LEAD_S.
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
"""How a plan is led: as it is; planned anew, for PLANT_TOLERANCES before it begins, and for what is known while it
goes on; planned anew for what was known of a robot after it was measured in free space.
"""


def run_closed_loops(
    name: str,
    plan: Plan,
    case: str,
    samples: int = CLOSED_LOOP_SAMPLES,
    seed: int = CLOSED_LOOP_SEED,
    replanning_mode: str = AS_PLANNED,
) -> ClosedLoopResult:
    """Run a plan on `samples` robots, sampled with a seed, with feedback and without; raises as Tracker.

    name: of the plan. case: of CLOSED_LOOP_CASES; where it has a play, all tubes have it whole. replanning_mode:
    of REPLANNING_MODES; what open loops play, and errors are told as parts of, is the plan as it was given. Raises
    as Replanner, too.
    """
    at = CLOSED_LOOP_CASES[case]
    led = replan_for_tolerances(plan, PLANT_TOLERANCES) if replanning_mode == REPLANNED else plan
    replanner = None if replanning_mode == AS_PLANNED else Replanner(plan)
    tolerances = replace(PLANT_TOLERANCES, rotation_lag=at.play)
    robots = sample_robots(replace(plan.robot, tolerances=tolerances), samples, seed)
    robots = replace(robots, backlash=np.full_like(robots.backlash, at.play))
    runs = []
    seconds = list[float]()
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
    """Make the tracker of one robot along a plan; with a replanner, the robot is measured in free space first and
    planned for anew.
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
    """Plan for all robots within other tolerances, from a plan for those of its own; raises as solve_robust."""
    problem = replace(problem_of(plan), robot=replace(plan.robot, tolerances=tolerances))
    return solve_robust(problem, initial=[plan.q], settings=settings_of(plan))


def _bending_offsets(size: float, samples: int, seed: int) -> Iterator[tuple[float, float]]:
    """Yield for every robot by what it is bent, (x, y) mm: `size` in a random direction."""
    for turn in np.random.default_rng([seed, 7]).uniform(0.0, 2 * np.pi, samples).tolist():
        yield size * np.cos(turn), size * np.sin(turn)
