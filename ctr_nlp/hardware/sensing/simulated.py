"""A simulated robot, sampled within the plan's tolerances, which follows the motors and is measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_nlp.hardware.sensing.source import Source
from ctr_nlp.identify.closed_loop.feed import Feed, SensorFault
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.sensors import Reading, Sensors
from ctr_nlp.models import Model, model_named
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot.samples import RobotSamples, sample_robots
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.typing import Array

ROBOT_DIFFERENCE_LABELS = {
    "curvature": ("curvature", 100.0, " %"),
    "bending_stiffness": ("bending stiffness", 100.0, " %"),
    "torsional_ratio": ("torsional ratio", 100.0, " %"),
    "curved_length": ("curved length", 1.0, " mm"),
    "motor_zero": ("motor zero", 1.0, " rad"),
}
"""Label, factor and unit in which the differences of a sampled robot are printed."""


class SimulatedRobot(Source):
    """A sample of the plan's robot within its tolerances, moved by the motors and measured by sensors.

    Parameters
    ----------
    plan : Plan
        Gives the robot and the tolerances.
    sensors : Sensors
        Quantities that are measured, and their noise.
    seed : int
        Seed of the sample and of the noise; the same seed gives the same robot.
    faults : sequence of SensorFault, optional
        Faults of the sensors; see Feed.
    model : str or Model, optional
        Model of the robot. By default it is elastic, with the load with which the plan is evaluated, whatever
        model the plan was made with: tubes twist and can snap although a plan knows nothing of that.
    """

    def __init__(
        self,
        plan: Plan,
        sensors: Sensors,
        seed: int,
        faults: Sequence[SensorFault] = (),
        model: str | Model | None = None,
    ) -> None:
        if model is None:
            model = "elastic" if plan.evaluated_load is None else plan.evaluated_model
        self._model = model_named(model)
        self._sample = sample_robots(plan.robot, 1, seed)
        self._seed = seed
        self._plan = plan
        self.plant = Plant(plan.robot, self._sample, self._model)
        self._feed = Feed(self.plant, sensors, seed, faults=faults)

    def __str__(self) -> str:
        """Return model, seed, and by how much the tubes differ, outermost first, in one line."""
        told = "; ".join(_differences(self._sample)) or "exactly as described"
        return f"a simulated robot on the {self._model.name} model, seed {self._seed}: {told}"

    def open(self) -> None:
        """Do nothing, since nothing needs to be opened."""

    def apply_past_motion(self, configurations: Array) -> None:
        """Move the robot through past configurations; without any, it comes to rest in the plan's first frame.

        configurations: q (n, 2d + 2). The first equilibrium takes up to a second where programs are not compiled
        yet. It is found here, before anything moves: within the motion, the player would stop because it was held
        up.
        """
        for q in configurations if len(configurations) else self._plan.q[:1]:
            self.plant.move_to(q, 0.0)

    def take(self, q: Array, now: float) -> list[Reading]:
        """Move the robot and return the readings by now, oldest first.

        q: (2d + 2,) of the motors. now: s of the clock.
        """
        self.plant.move_to(q, now)
        return self._feed.take_readings(now)

    def close(self) -> None:
        """Do nothing, since nothing was opened."""


def _differences(sample: RobotSamples) -> list[str]:
    """Return phrases that say by how much one sample differs from the robot described, one a quantity."""
    columns = {name: sample.deviations[0, :, k] for k, name in enumerate(DEVIATION_NAMES)}
    told = [
        f"{name} {', '.join(f'{factor * value:+.3g}' for value in columns[key])}{unit}"
        for key, (name, factor, unit) in ROBOT_DIFFERENCE_LABELS.items()
        if np.any(columns[key])
    ]
    if sample.backlash.any():
        told.append(f"rotation lag {', '.join(f'{lag:.3g}' for lag in sample.backlash[0])} rad")
    if sample.forces.any():
        told.append(f"tip force {', '.join(f'{force:+.3g}' for force in sample.forces[0])} N along x, y, z")
    return told
