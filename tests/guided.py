"""Closed loops in virtual time: a plan of two tubes on the emulated controller, with a robot drawn for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bench import REACH, World
from emulator.firmware import Firmware
from emulator.wire import WireFault as WireFault
from loops_of import ROBOT, SENSORS, made_plan
from near_fold import plan_through

from ctr_nlp.hardware.axis import Axis
from ctr_nlp.hardware.description import Connection, Hardware
from ctr_nlp.hardware.guiding.loop import ClosedLoop, final_estimate, initial_estimate
from ctr_nlp.hardware.guiding.replay import Replay, replay_session
from ctr_nlp.hardware.journal import read_journal
from ctr_nlp.hardware.playing.results import Result
from ctr_nlp.hardware.playing.session import play_plan, resume
from ctr_nlp.hardware.sensing.simulated import SimulatedRobot
from ctr_nlp.identify.closed_loop.feed import SensorFault
from ctr_nlp.identify.closed_loop.tracker import Note, Tracker
from ctr_nlp.plan.plan import Plan


def level_plan() -> Plan:
    """The plan of two tubes without a tilt, since the controller has no arm."""
    q = made_plan().q.copy()
    q[:, -2:] = 0.0
    return plan_through(q, ROBOT.with_locked_tilt())


def two_tubes() -> Hardware:
    """Two slides that count down from their switches, and two turns, on a Grbl controller."""
    slides = [Axis(f"beta_{i + 1}", "XY"[i], "mm", (-REACH[2], 0.0), 50.0, 200.0, sign=-1) for i in range(2)]
    turns = [Axis(f"alpha_{i + 1}", "AB"[i], "deg", (-360.0, 360.0), 600.0, 2000.0) for i in range(2)]
    return Hardware((*slides, *turns), None, Connection("grbl", "wire:", homing="cycle"), approach=1.0)


def roomy() -> Firmware:
    """A controller whose slides may all go as far as the longest."""
    return Firmware({20: 1} | {130 + i: REACH[2] for i in range(3)}, homed=True)


class Loops:
    """A world whose plan is played in closed loops, one session after the other; notes: what was told."""

    def __init__(self, folder: Path, plan: Plan, seed: int = 1, faults: Sequence[SensorFault] = ()) -> None:
        self.world = World(folder, plan, two_tubes(), roomy())
        self.seed, self.faults, self.notes = seed, faults, list[Note]()

    def loop(self, known: Any = None) -> ClosedLoop:
        """Another one, of the same robot."""
        self.robot = SimulatedRobot(self.world.plan, SENSORS, self.seed, self.faults)
        return ClosedLoop(Tracker(self.world.plan, SENSORS, prior=known), self.robot, self.notes.append)

    def begin(self, wire: tuple[WireFault, ...] = (), callback: Callable[..., None] | None = None) -> Result:
        """Play from the first frame."""
        self.world.latest = self.world.player(wire)
        self.latest = self.loop()
        return play_plan(
            self.world.latest, self.world.plan, self.world.hardware, callback=callback, loop=self.latest
        )

    def resume(self, callback: Callable[..., None] | None = None) -> Result:
        """Go on."""
        records = read_journal(self.world.path)
        self.world.latest = self.world.player()
        self.latest = self.loop(final_estimate(records))
        world = self.world
        return resume(world.latest, world.plan, world.hardware, records, callback=callback, loop=self.latest)

    def replayed(self) -> Replay:
        """The last session again, from its journal."""
        records = read_journal(self.world.path)
        tracker = Tracker(self.world.plan, SENSORS, prior=initial_estimate(records))
        return replay_session(self.world.plan, self.world.hardware, records, tracker)

    def away(self) -> float:
        """Root mean square distance of the robot's shapes from the planned ones where it was as long, mm."""
        moved, plan, d = self.robot.plant.history, self.world.plan, self.world.plan.robot.d
        lengths = np.array([each.q[2 * d - 1] for each in moved])
        nearest = [moved[int(abs(lengths - q[2 * d - 1]).argmin())].shape for q in plan.q]
        return float(np.sqrt(((np.array(nearest) - plan.shape) ** 2).sum(axis=-1).mean()))
