"""What moves the robot: a model on which it is seen, and a steerer. Those wanted may still be being compiled."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import dataclass

from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.loads import Load
from ctr_nlp.models import MODELS, Model, suits, under
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.steer import Steerer
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

QUICK = "dominant"
"""The model that is steered on while the one that is wanted is compiled: its steps need no compiled code."""
POLL = 0.5
"""s between two looks at whether something has been compiled."""


@dataclass(frozen=True)
class Drive:
    """A model, and a steerer on it; walled: whether the steerer keeps the robot within the lumen."""

    model: Model
    steerer: Steerer
    walled: bool

    @classmethod
    def at_once(cls, problem: Problem, q: Array, dt: float, settings: Settings) -> Drive:
        """One for which nobody waits: on the simplest model, without a wall, interpreted until it is compiled.

        Raises OptionError where nothing can be compiled at all, and where that model does not describe the robot.
        """
        if why := cache.missing():
            raise OptionError(f"live steering needs a C compiler: {why}")
        steerer = Steerer(problem.robot, q, dt, settings, QUICK, wait=False)
        return cls(MODELS[QUICK], steerer, walled=False)


class Awaited:
    """The drive that is wanted, made in a thread of its own as soon as its programs have been compiled.

    found: the drive on the model, None until then. failed: why there will be none, None where nothing failed.
    """

    def __init__(self, problem: Problem, model: Model, q: Array, dt: float, settings: Settings) -> None:
        """Begin; the programs are compiled by a process of their own, which outlives this one."""
        self.model, self.walled = model, problem.lumen is not None and settings.contact_weight > 0
        self.found: Drive | None = None
        self.failed: CtrError | None = None
        self._asked, self._dropped = (problem, q, dt, settings), threading.Event()
        threading.Thread(target=self._wait, daemon=True).start()

    def drop(self) -> None:
        """Nobody wants it any more."""
        self._dropped.set()

    def _wait(self) -> None:
        problem, q, dt, settings = self._asked
        try:
            while not self._dropped.is_set():
                steerer = Steerer.soon(problem.robot, q, dt, settings, self.model, problem.lumen)
                if steerer is not None:
                    self.found = Drive(self.model, steerer, self.walled)
                    return
                time.sleep(POLL)
        except CtrError as error:
            self.failed = error


def fit(problem: Problem, load: Load | None = None) -> list[str]:
    """The models that describe a problem's robot, which bears a load, by name."""
    if load is None:
        return [name for name in MODELS if suits(problem.robot, name)]
    with suppress(CtrError):
        under(Loaded.name, load).check(problem.robot)
        return [Loaded.name]
    return []
