"""One robot that is moved step by step, as its motors are, and stays on its branch of equilibria.

In contrast to Model.follow, the motion need not be known beforehand: simulators and controllers move a Walker.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.typing import Array


class Walker(ABC):
    """A robot at rest at q (2d + 2,), in an equilibrium with unknowns x (n_x,). One object a thread."""

    q: Array
    x: Array

    @abstractmethod
    def move_to(self, q: Array) -> list[Array]:
        """Move linearly to q (2d + 2,).

        Returns the angles (d,) in rad by which the tips jumped, an entry for each snap on the way. If no
        equilibrium is found at q, x is NaN from then on.
        """

    @abstractmethod
    def change_tubes(self, numbers: Array, x: Array | None = None) -> list[Array]:
        """Continue as a robot of other numbers (d, 8) at the same q, as when an estimate of them changes.

        x (n_x,): approximate unknowns afterwards; None for the present ones. Returns the tips' jumps (d,) in rad,
        an entry for each snap.
        """

    def change_load(self, load: Array) -> list[Array]:
        """Continue under another load (17 + 3d,) of the same kind, in the order of loads.Load.numbers.

        Returns the tips' jumps (d,) in rad, an entry for each snap. Raises OptionError where the model has no
        loads.
        """
        raise OptionError("this model does not support loads in step-by-step motion")

    @abstractmethod
    def margin(self) -> float:
        """The stability margin; NaN where nothing can be unstable."""

    def copy(self) -> Walker:
        """Return another walker in the same state, for the same thread."""
        # A shallow copy suffices: walkers replace their states and never change them in place.
        return copy.copy(self)


class ConfigurationWalker(Walker):
    """A robot on a model whose unknowns are the configuration itself, with one shape for each."""

    def __init__(self, q: Array) -> None:
        self.q = self.x = np.array(q, dtype=float)

    def move_to(self, q: Array) -> list[Array]:
        """Move to q (2d + 2,), which needs no search for an equilibrium; never a snap."""
        self.q = self.x = np.array(q, dtype=float)
        return []

    def change_tubes(self, numbers: Array, x: Array | None = None) -> list[Array]:
        """Do nothing: other numbers change the shape, but neither q nor x, which is q. numbers, x: ignored."""
        return []

    def margin(self) -> float:
        """NaN, since nothing can be unstable."""
        return float("nan")
