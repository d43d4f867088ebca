"""Drives of a steered robot: a kinematic model and a steerer on it, which may still have to be compiled."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import dataclass

from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.models import KINEMATIC_MODELS, Model, model_with_load, suits
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.models.loads import Load
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.planning.steerer import Steerer
from ctr_nlp.typing import Array

INTERIM_MODEL = "dominant"
"""Model for steering while the requested one is compiled: its steps need no compiled code."""
COMPILATION_POLL_S = 0.5
"""Time between two checks whether something has been compiled."""


@dataclass(frozen=True)
class Drive:
    """A model and a steerer on it. within_lumen: whether the steerer keeps the robot within the lumen."""

    model: Model
    steerer: Steerer
    within_lumen: bool

    @classmethod
    def interim(cls, problem: Problem, q: Array, dt: float, settings: Settings) -> Drive:
        """Return a drive that is ready at once: the simplest model without a wall, interpreted until it is
        compiled.

        problem: whose robot is steered. q (2d + 2,): configuration in which it stands. dt: time of a step, s.
        settings: weights of steering. Raises OptionError where nothing can be compiled at all, and where that
        model does not describe the robot.
        """
        if why := cache.unavailable_reason():
            raise OptionError(f"live steering needs a C compiler: {why}")
        steerer = Steerer(problem.robot, q, dt, settings, INTERIM_MODEL, wait=False)
        return cls(KINEMATIC_MODELS[INTERIM_MODEL], steerer, within_lumen=False)


class PendingDrive:
    """A requested drive, made in a thread of its own as soon as its programs have been compiled.

    drive: None until then. error: why there will be none, None where nothing failed.
    """

    def __init__(self, problem: Problem, model: Model, q: Array, dt: float, settings: Settings) -> None:
        """Start to compile, in a process of its own that outlives this one.

        problem: robot and lumen. model: what to steer on. q (2d + 2,): where the robot stands. dt: time of a step,
        s. settings: weights of steering.
        """
        self.model = model
        self.within_lumen = problem.wall is not None and settings.contact_weight > 0
        self.drive: Drive | None = None
        self.error: CtrError | None = None
        self._asked = (problem, q, dt, settings)
        self._dropped = threading.Event()
        threading.Thread(target=self._wait, daemon=True).start()

    def cancel(self) -> None:
        """Give up waiting: nobody needs the drive any more."""
        self._dropped.set()

    def _wait(self) -> None:
        """Look for the compiled programs until they are there or nobody needs them."""
        problem, q, dt, settings = self._asked
        try:
            while not self._dropped.is_set():
                at = problem.robot, q, dt, settings, self.model, problem.lumen, problem.walls
                steerer = Steerer.create_if_compiled(*at)
                if steerer is not None:
                    # The last step of this thread. The session, in another one, looks at `drive` between its
                    # steps, and sees all of it or None.
                    self.drive = Drive(self.model, steerer, self.within_lumen)
                    return
                time.sleep(COMPILATION_POLL_S)
        except CtrError as error:
            self.error = error


def suitable_models(problem: Problem, load: Load | None = None) -> list[str]:
    """Return the names of the models that describe a problem's robot, with its load, if any."""
    if load is None:
        return [name for name in KINEMATIC_MODELS if suits(problem.robot, name)]
    with suppress(CtrError):
        model_with_load(Loaded.name, load).check(problem.robot)
        return [Loaded.name]
    return []
