"""A robot that is not there: one drawn from the plan's tolerances, which follows the motors and is measured."""

from __future__ import annotations

from collections.abc import Sequence

from ctr_nlp.hardware.sensing.source import Source
from ctr_nlp.loops.feed import Fault, Feed
from ctr_nlp.loops.plant import Plant
from ctr_nlp.loops.sensors import Reading, Sensors
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot.draws import drawn
from ctr_nlp.typing import Array


class SimulatedRobot(Source):
    """The draw of a seed, on the model that a plan is evaluated on; faults: as of Feed."""

    def __init__(self, plan: Plan, sensors: Sensors, seed: int, faults: Sequence[Fault] = ()) -> None:
        self.plant = Plant(plan.robot, drawn(plan.robot, 1, seed), plan.evaluated_on)
        self._feed = Feed(self.plant, sensors, seed, faults=faults)

    def open(self) -> None:
        """Nothing is opened."""

    def led(self, places: Array) -> None:
        """As Source."""
        for q in places:
            self.plant.moved(q, 0.0)

    def take(self, q: Array, now: float) -> list[Reading]:
        """As Source."""
        self.plant.moved(q, now)
        return self._feed.arrived(now)

    def close(self) -> None:
        """Nothing was opened."""
