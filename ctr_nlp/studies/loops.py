"""Plans on robots that differ from what they were made for, with feedback and without."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ctr_nlp.loops.anew.replanner import Replanner, problem_of, settings_of
from ctr_nlp.loops.anew.replanning import LEAD, Replanning
from ctr_nlp.loops.closed import closed_loop, open_loop
from ctr_nlp.loops.feed import Feed
from ctr_nlp.loops.plant import Plant
from ctr_nlp.loops.sensors import Sensors
from ctr_nlp.loops.sensors.points import ShapePoints, TipPosition
from ctr_nlp.loops.tracker import Tracker
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Tolerances
from ctr_nlp.robot.draws import Draws, drawn
from ctr_nlp.steer.robust.plan import solve_robust
from ctr_nlp.studies.identified import identified

DRAWS, SEED = 100, 20260101
"""Number and seed of the robots that every plan is run on; nothing was tuned on these."""
NOISE = 0.5
"""Noise of every coordinate that is measured, mm."""
PLACES = 1 / 6, 1 / 3, 1 / 2, 2 / 3, 5 / 6
"""Places of the shape that are measured beside the tip, sigma."""
OFF = Tolerances(0.1, 0.1, motor_zero=0.05)
"""Tolerances that robots differ by."""
PLAY, BENDING = 0.05, 2.0
"""rad by which every tube stays behind its motor, and mm by which the tip is bent, in the cases that have them."""


@dataclass(frozen=True)
class Case:
    """A case of the study: the sensors, and what robots have beyond the differences OFF: play, rad, and bending,
    mm.
    """

    tip_alone: bool = False
    play: float = 0.0
    bending: float = 0.0

    @property
    def sensors(self) -> Sensors:
        """Sensors of the tip and, unless it is alone, of points of the shape."""
        tip = TipPosition(NOISE)
        return Sensors(tip) if self.tip_alone else Sensors(tip, ShapePoints(PLACES, NOISE))


CASES: Mapping[str, Case] = {
    "tip and 5 points": Case(),
    "tip alone": Case(tip_alone=True),
    "with play": Case(play=PLAY),
    "with bending": Case(bending=BENDING),
}


@dataclass(frozen=True)
class Looped:
    """A plan on robots in one case. planned: its e3, mm; opened, closed: mean e3 of all over that; kept: of those
    neither lost nor stopped, with feedback. lost_open, lost, stopped: of so many draws; told: of those that were
    lost with feedback, of how many the operator was told. cycle, slowest: median and 99 % quantile of one cycle,
    ms. replanned: the share of replannings whose motion then led; replanning: the median time of one, s; late: the
    share that took longer than LEAD.
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


AS_PLANNED, REPLANNED, IDENTIFIED = HOWS = "as planned", "replanned", "identified"
"""How a plan is led: as it is; planned anew, for OFF before it begins, and for what is known while it goes on;
planned anew for what was known of a robot after it was measured in free space."""


def looped(
    name: str, plan: Plan, case: str, draws: int = DRAWS, seed: int = SEED, how: str = AS_PLANNED
) -> Looped:
    """Run a plan on `draws` robots, sampled with a seed, with feedback and without; raises as Tracker.

    name: of the plan. case: of CASES; where it has a play, all tubes have it whole. how: of HOWS; what open loops
    play, and errors are told as parts of, is the plan as it was given. Raises as Replanner, too.
    """
    at, led = CASES[case], planned_for(plan, OFF) if how == REPLANNED else plan
    replanner = None if how == AS_PLANNED else Replanner(plan)
    tolerances = replace(OFF, rotation_lag=at.play)
    robots = drawn(replace(plan.robot, tolerances=tolerances), draws, seed)
    robots = replace(robots, lags=np.full_like(robots.lags, at.play))
    runs, seconds = [], list[float]()
    for k, bent in zip(range(draws), _bent(at.bending, draws, seed), strict=True):
        own = plan.robot, robots[k : k + 1], plan.evaluated_on
        opened, plant = open_loop(plan, Plant(*own, bending=bent)), Plant(*own, bending=bent)
        tracker = _tracker(led, at, tolerances, own[1], seed + k, replanner if how == IDENTIFIED else None)
        replanning = Replanning(replanner, plan.time) if replanner is not None and how == REPLANNED else None
        runs.append((opened, closed_loop(led, plant, Feed(plant, at.sensors, seed + k), tracker, replanning)))
        seconds += runs[-1][1].seconds.tolist()
    planned, anew = e3(plan) or np.nan, [each for _, run in runs for each in run.planned]
    kept = [run.e3 for _, run in runs if not (run.lost or run.stopped)]
    return Looped(
        plan=name,
        case=case,
        planned=planned,
        opened=float(np.mean([run.e3 for run, _ in runs])) / planned,
        closed=float(np.mean([run.e3 for _, run in runs])) / planned,
        kept=float(np.mean(kept)) / planned if kept else float("nan"),
        lost_open=sum(run.lost > 0 for run, _ in runs),
        lost=sum(run.lost > 0 for _, run in runs),
        stopped=sum(run.stopped for _, run in runs),
        told=sum(run.lost > 0 and bool(run.notes) for _, run in runs),
        draws=draws,
        cycle=1e3 * float(np.quantile(seconds, 0.5)),
        slowest=1e3 * float(np.quantile(seconds, 0.99)),
        replanned=float(np.mean([each.leads for each in anew])) if anew else 0.0,
        replanning=float(np.median([each.seconds for each in anew])) if anew else 0.0,
        late=float(np.mean([each.seconds > LEAD for each in anew])) if anew else 0.0,
    )


def _tracker(
    plan: Plan, at: Case, tolerances: Tolerances, draw: Draws, seed: int, replanner: Replanner | None
) -> Tracker:
    """Make the tracker of one robot along a plan; with a replanner, the robot is measured in free space first and
    planned for anew.
    """
    if replanner is None:
        return Tracker(plan, at.sensors, tolerances)
    places = np.append([] if at.tip_alone else PLACES, 1.0)
    known = identified(plan.robot, tolerances, draw, plan.evaluated_on, places, NOISE, seed)
    tracker = Tracker(plan, at.sensors, tolerances, known)
    begun = tracker.beginning
    whole = replanner(begun)
    if whole is not None:
        tracker.go_on(begun, whole)
    return tracker


def planned_for(plan: Plan, tolerances: Tolerances) -> Plan:
    """Plan for all robots within other tolerances, from a plan for those of its own; raises as solve_robust."""
    problem = replace(problem_of(plan), robot=replace(plan.robot, tolerances=tolerances))
    return solve_robust(problem, initial=[plan.q], settings=settings_of(plan))


def _bent(size: float, draws: int, seed: int) -> Iterator[tuple[float, float]]:
    """Yield for every robot by what it is bent, (x, y) mm: `size` in a random direction."""
    for turn in np.random.default_rng([seed, 7]).uniform(0.0, 2 * np.pi, draws).tolist():
        yield size * np.cos(turn), size * np.sin(turn)
